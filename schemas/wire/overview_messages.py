"""Messages of `overview`: a sample of all points of a scene, for a viewer's first picture."""

from typing import Annotated, Literal

import msgspec
import numpy as np

from .arrays import Poses, Positions
from .requests import Request
from .tile_messages import Colours

# Most points of an overview. Each takes at most 22 bytes as MessagePack, and less than 90 as JSON,
# so that an answer is smaller than the largest message.
MAX_OVERVIEW_POINTS = 200_000

Vectors = np.ndarray[tuple[int, Literal[3]], np.dtype[np.float32]]


class OverviewRequest(Request, frozen=True):
    """Sample the points of all archives of a scene.

    limit: of the points returned. An archive's share is proportional to its points.
    """

    limit: Annotated[int, msgspec.Meta(ge=1, le=MAX_OVERVIEW_POINTS)] = 100_000


class OverviewAnswer(msgspec.Struct, frozen=True):
    """Sample of the points of a scene, archive after archive, and what the archives hold.

    total: points of the scene.  radius: that the scene gives a point, its mean [m].
    columns: those of rgb, intensity, classification and scan that any archive keeps.
    intensities: the least and the greatest in the sample; null without finite ones.
    classes: classifications that occur in the sample, ascending.
    poses: (a, 4, 4), archive to world.  edges: (a,), of voxels [m].
    low, high: (a, 3), corners of the box around the archive's points, in the archive's frame [m].
    archive_points, archive_voxels, archive_scans: (a,), how many each archive has.
    starts: (a + 1,), the points of archive i are those from starts[i] to starts[i + 1].
    previewed: (a,), whether the sample is that of the archive's preview. Otherwise it is of the
    points of some voxels, and the others show nothing.
    points: (n, 3), from the archive's `low`, in the archive's frame [m].
    Empty if no archive keeps the column, 0 for points of an archive that does not keep it:
    rgb: (n, 3).  intensity: (n,).  classification: (n,).
    scan: (n,), number of the scan among the archive's sources.
    """

    total: int
    radius: float
    columns: list[str]
    intensities: tuple[float, float] | None
    classes: list[int]
    poses: Poses
    edges: np.ndarray[tuple[int], np.dtype[np.float64]]
    low: Positions
    high: Positions
    archive_points: np.ndarray[tuple[int], np.dtype[np.uint64]]
    archive_voxels: np.ndarray[tuple[int], np.dtype[np.uint32]]
    archive_scans: np.ndarray[tuple[int], np.dtype[np.uint32]]
    starts: np.ndarray[tuple[int], np.dtype[np.uint32]]
    previewed: np.ndarray[tuple[int], np.dtype[np.bool_]]
    points: Vectors
    rgb: Colours
    intensity: np.ndarray[tuple[int], np.dtype[np.float32]]
    classification: np.ndarray[tuple[int], np.dtype[np.uint8]]
    scan: np.ndarray[tuple[int], np.dtype[np.uint16]]
