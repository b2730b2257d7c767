"""Effect `through`: named boxes where contact is ignored, such as a door or a portal.

A door is one that is known to open. The scan points in the boxes, borders included, are masked in
what is served (server/archives/masked_archive.py): every query answers as for a scan that never had them. This
effect has no part in a frame and therefore no runner.
"""

from functools import partial

from numpy.typing import ArrayLike

from ....schemas.scene.effect_table import Through
from ...archives.masked_archive import MaskedArchive
from ...residency.voxel_store import OpenStore, VoxelStore


def store_without(effect: Through, pose: ArrayLike | None = None, normals: float | None = None) -> OpenStore:
    """Return a function that opens an archive's folder without the points in the boxes.

    It is for `Scene.open(..., open_store=...)`.
    pose: (4, 4), the archive's pose in the world, because boxes are in world coordinates; None: the
    identity.  normals: as for `VoxelStore`.
    """
    boxes = [(box.low, box.high) for box in effect.boxes]
    return partial(VoxelStore, open_archive=partial(MaskedArchive, boxes=boxes, pose=pose), normals=normals)
