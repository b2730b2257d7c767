"""Effect `through`: named boxes where contact is ignored, such as a door or a portal.

The scan points in the boxes, borders included, are masked (server/archives/masked_store.py):
every query answers as for a scan that never had them. The effect acts when a voxel is loaded and has
no runner, because it does nothing in a frame.
"""

from functools import partial

from numpy.typing import ArrayLike

from ....schemas.scene.effect_table import Through
from ...archives.masked_store import MaskedStore
from ...residency.voxel_store import OpenStore


def store_without(effect: Through, pose: ArrayLike | None = None) -> OpenStore:
    """Return a function that opens an archive's folder without the points in the boxes.

    It is for `Scene.open(..., open_store=...)`.
    pose: (4, 4), the archive's pose in the world, because boxes are in world coordinates; None: the
    identity.
    """
    boxes = [(box.low, box.high) for box in effect.boxes]
    return partial(MaskedStore, boxes=boxes, pose=pose)
