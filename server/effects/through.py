"""`through`: named boxes where contact is ignored, such as a door known to open, or a portal.

The scan points in them, borders included, are left out of what is served (server/left_out.py): every question answers
as of a scan that never had them. No frame is asked anything, so this effect has no runner.
"""

from functools import partial

from numpy.typing import ArrayLike

from ...schemas.effects import Through
from ..left_out import LeftOut
from ..store import OpenStore, Store


def store_without(effect: Through, pose: ArrayLike | None = None, normals: float | None = None) -> OpenStore:
    """What opens an archive's folder without the points in the boxes, for `Scene.open(..., open_store=...)`.

    pose: (4, 4) where the archive lies in the world, as boxes are world boxes; None: at the identity.  normals: as
    `Store` takes it.
    """
    boxes = [(box.low, box.high) for box in effect.boxes]
    return partial(Store, open_archive=partial(LeftOut, boxes=boxes, pose=pose), normals=normals)
