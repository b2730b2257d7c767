"""Points of a scene's archives for a floor plan, up to a number of points.

Voxels nearest to the poses of interest are read first. Those beyond the budget are left as boxes.
"""

from collections.abc import Sequence
from contextlib import ExitStack
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...builder.voxel.record_points import voxel_points
from ...schemas.archive.archive import Archive
from ...schemas.errors import CorruptError
from ..archives.placed_archive import PlacedArchive
from ..archives.rigid_transform import transform_boxes, transform_points

_Floats = NDArray[np.float64]

# Poses of interest by whose distance voxels are ordered, at most.
_MAX_POSES = 256


class PlanPoints(NamedTuple):
    """Content of a region of a scene.

    points: (n, 3) of the voxels that were read, world [m].  boxes: (m, 2, 3), low and high corner
    of the points of each other voxel, world [m].
    """

    points: _Floats
    boxes: _Floats


def read_plan_points(
    archives: Sequence[PlacedArchive], low: _Floats, high: _Floats, near: _Floats, most: int
) -> PlanPoints:
    """Read the points of a scene in the box low, high (3,) of the world [m].

    near: (k, 3), k >= 1: voxels that are nearest to one of these positions are read first [m].
    most: number of points in the voxels that are read. A voxel that cannot be read is left as a
    box. Raise BadRequestError if the scene is closed.
    """
    with ExitStack() as stack:
        stores = [stack.enter_context(archive.take()).store for archive in archives]
        opened = [store.archive for store in stores]
        each = [_boxes(archive, placed) for archive, placed in zip(opened, archives, strict=True)]
        boxes = np.concatenate(each)
        which = np.repeat(np.arange(len(each)), [len(found) for found in each])
        rows = np.concatenate([np.arange(len(found)) for found in each])
        counts = np.concatenate([archive.voxels["rows"][:, 2].astype(np.int64) for archive in opened])
        inside = np.flatnonzero(((boxes[:, 0] <= high) & (boxes[:, 1] >= low)).all(axis=1))
        order = inside[np.argsort(_distance(boxes[inside], near), kind="stable")]
        read = np.cumsum(counts[order]) <= most
        blocks, left = [np.empty((0, 3))], order[~read].tolist()
        for k in order[read].tolist():
            placed, archive, row = archives[which[k]], opened[which[k]], int(rows[k])
            try:
                voxel, links = archive.read_voxel(row)
            except (CorruptError, OSError):
                left.append(k)
                continue
            lattice = archive.header.lattice
            steps = (
                voxel_points(voxel, links) + archive.coordinates[row].astype(np.int64) * lattice.voxel_steps
            )
            points = lattice.to_world(steps)
            points = points[~stores[which[k]].hides(points)]
            points = points if placed.pose is None else transform_points(placed.pose, points)
            blocks.append(points[((points >= low) & (points <= high)).all(axis=1)])
        return PlanPoints(np.concatenate(blocks), boxes[left])


def _boxes(archive: Archive, placed: PlacedArchive) -> _Floats:
    """Return the box (v, 2, 3) around the points of each voxel, world [m]."""
    lattice, voxels = archive.header.lattice, archive.voxels
    base = archive.coordinates.astype(np.int64) * lattice.voxel_steps
    low, high = (lattice.to_world(base + voxels[side]) for side in ("low", "high"))
    if placed.pose is not None:
        low, high = transform_boxes(placed.pose, low, high)
    return np.stack([low, high], axis=1)


def _distance(boxes: _Floats, near: _Floats) -> _Floats:
    """Return the distance from the middle of each box (m, 2, 3) to the nearest position (m,) [m]."""
    middle = boxes.mean(axis=1)
    chosen = near[:: -(-len(near) // _MAX_POSES)]
    found = np.full(len(middle), np.inf)
    for position in chosen:
        found = np.minimum(found, np.linalg.norm(middle - position, axis=1))
    return found
