"""Messages about what a scene looks like: its voxels near a place, and the points of one of them.

Viewers draw with them. Collisions do not depend on them: what a tile leaves out is still touched.
"""

from collections.abc import Sequence
from typing import Annotated, Literal

import msgspec
import numpy as np
from numpy.typing import ArrayLike

from ..errors import BadRequestError
from .arrays import Poses, Positions
from .requests import Count, Length, Request

# Most voxels that an answer lists, and the least detail: of 4^8 points, one.
MAX_LISTED_VOXELS, MAX_DETAIL = 1 << 16, 8
# From this detail on, the points may be those of the archive's level of detail (FORMAT.md).
LEVEL_DETAIL = 3
# Largest level of `TileRequest.level`.
MAX_SPHERE_LEVEL = 79

Voxels = np.ndarray[tuple[int, Literal[3]], np.dtype[np.int32]]
Offsets = np.ndarray[tuple[int, Literal[3]], np.dtype[np.uint16]]
Colours = np.ndarray[tuple[int, Literal[3]], np.dtype[np.uint8]]
Coordinate = Annotated[int, msgspec.Meta(ge=-(1 << 31), lt=1 << 31)]
Vector = tuple[float, float, float]


class VoxelsRequest(Request, frozen=True):
    """List voxels, nearest first.

    place: world [m].  reach: farthest distance of a voxel's box from it [m]; null: any.
    limit: of the voxels listed.
    """

    place: Vector
    reach: Length | None = None
    limit: Annotated[int, msgspec.Meta(ge=1, le=MAX_LISTED_VOXELS)] = 4096

    def __post_init__(self) -> None:
        Request.__post_init__(self)
        if not np.isfinite(self.place).all():
            raise BadRequestError(f"place {self.place}: expected finite numbers")


class VoxelsAnswer(msgspec.Struct, frozen=True):
    """Voxels near a place, nearest first; of equal distances by archive and voxel.

    total: voxels within reach, also those beyond the limit.
    archive: (v,), number of the archive in the scene.  voxel: (v, 3), coordinates of the voxel in
    the archive's grid.
    low, high: (v, 3), corners of the box around its points, in the archive's frame [m].
    points: (v,).  bytes: (v,), of its record.  resident: (v,), whether it is in memory.
    poses: (a, 4, 4), archive to world, of all archives.  edges: (a,), of their voxels [m].
    """

    total: int
    archive: np.ndarray[tuple[int], np.dtype[np.uint16]]
    voxel: Voxels
    low: Positions
    high: Positions
    points: np.ndarray[tuple[int], np.dtype[np.uint64]]
    bytes: np.ndarray[tuple[int], np.dtype[np.uint64]]
    resident: np.ndarray[tuple[int], np.dtype[np.bool_]]
    poses: Poses
    edges: np.ndarray[tuple[int], np.dtype[np.float64]]


class TileRequest(Request, frozen=True):
    """Read what one voxel looks like.

    archive, voxel: as in `VoxelsAnswer`.
    detail: 0 for all points; k: of every 4^k points in the order of the hierarchy, one. The points
    of a detail are among those of the next finer one, except from LEVEL_DETAIL to the finer one:
    from there on they are about as many of the archive's level of detail, if it has one.
    level: null for points; a number: the bounding spheres of the hierarchy at this level instead, 0
    for the root. Leaf nodes above the level are included.
    """

    archive: Count
    voxel: tuple[Coordinate, Coordinate, Coordinate]
    detail: Annotated[int, msgspec.Meta(ge=0, le=MAX_DETAIL)] = 0
    level: Annotated[int, msgspec.Meta(ge=0, le=MAX_SPHERE_LEVEL)] | None = None

    def __post_init__(self) -> None:
        Request.__post_init__(self)
        if not all(-(1 << 31) <= each < 1 << 31 for each in self.voxel):
            raise BadRequestError(f"voxel {self.voxel}: expected integers of 32 bits")


class TileAnswer(msgspec.Struct, frozen=True):
    """Points or spheres of one voxel.

    pose: (1, 4, 4), tile to world.  step: of the lattice of `points` [m].
    total: points of the voxel.  radius: that the scene gives a point, its mean [m].
    points: (n, 3), from the voxel's low corner, in units of `step`; the centres of spheres.
    spheres: (n,), radii of spheres in units of `step`, rounded up; empty for points.
    Columns that the archive keeps, else empty: rgb: (n, 3).  intensity: (n,).  classification: (n,).
    scan: (n,), number of the scan among the archive's sources. They are empty for spheres.
    """

    pose: Poses
    step: float
    total: int
    radius: float
    points: Offsets
    spheres: np.ndarray[tuple[int], np.dtype[np.uint16]]
    rgb: Colours
    intensity: np.ndarray[tuple[int], np.dtype[np.float32]]
    classification: np.ndarray[tuple[int], np.dtype[np.uint8]]
    scan: np.ndarray[tuple[int], np.dtype[np.uint16]]


def voxels_request(place: ArrayLike, reach: float | None, limit: int) -> VoxelsRequest:
    """Return the request of `Scene.voxels` and `Client.voxels`. Raise BadRequestError."""
    values = np.asarray(place, np.float64)
    if values.shape != (3,):
        raise BadRequestError(f"place of shape {values.shape}: expected (3,)")
    x, y, z = values.tolist()
    return VoxelsRequest((x, y, z), reach, limit)


def tile_request(archive: int, voxel: Sequence[int], detail: int, level: int | None) -> TileRequest:
    """Return the request of `Scene.tile` and `Client.tile`. Raise BadRequestError."""
    if len(voxel) != 3:
        raise BadRequestError(f"voxel of {len(voxel)} numbers: expected 3")
    i, j, k = (int(each) for each in voxel)
    return TileRequest(archive, (i, j, k), detail, level)
