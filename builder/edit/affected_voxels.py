"""Voxels that a change of an archive affects: their points change, or their radius classes may."""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from ...schemas.archive.archive import Archive
from ..passes.radius_classes import class_limits

# Offsets of a grid block and of its neighbours.
AROUND = np.stack(np.meshgrid(*[np.arange(-1, 2)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)


def affected_voxels(
    archive: Archive, boxes: Mapping[int, NDArray[np.int64]]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the index rows of voxels to rebuild, and of voxels whose points are needed for that.

    boxes: key -> box of the points that change. With radius classes, points within neighbour
    distance of each other affect each other's class.
    """
    lattice, keys = archive.header.lattice, archive.voxels["key"]
    changes = np.isin(keys, np.array(list(boxes), np.uint64))
    if not archive.header.radius_class:
        rows = np.flatnonzero(changes)
        return rows, rows
    reach2 = class_limits(lattice.step).reach2
    corner = archive.coordinates * lattice.voxel_steps
    held = np.stack([corner + archive.voxels["low"], corner + archive.voxels["high"]], axis=1)
    changed = np.stack(list(boxes.values()))
    rebuilt = changes | within_reach(held, changed, reach2)
    read = rebuilt | within_reach(held, np.concatenate([held[rebuilt], changed]), reach2)
    return np.flatnonzero(rebuilt), np.flatnonzero(read)


def within_reach(held: NDArray[np.int64], boxes: NDArray[np.int64], reach2: int) -> NDArray[np.bool_]:
    """Return a mask of the boxes within a squared distance of any of the others.

    held: (v, 2, 3).  boxes: the others, (b, 2, 3). Corners are inclusive. Both sets are sorted into
    the blocks of a grid, and only boxes of neighbouring blocks are compared. A block is as long as
    the longest box plus the reach; boxes in other blocks are therefore too far away.
    """
    found = np.zeros(len(held), bool)
    if not len(held) or not len(boxes):
        return found
    farther = int(reach2**0.5) + 1  # larger gaps are clamped, which keeps squares small
    block = farther + 1 + max(int((each[:, 1] - each[:, 0]).max()) + 1 for each in (held, boxes))
    corners = np.concatenate([held[:, 0], boxes[:, 0]])
    block = max(
        block, int((corners.max(axis=0) - corners.min(axis=0)).max()) >> 20
    )  # their numbers fit 64 bits
    of_held, of_boxes = held[:, 0] // block, boxes[:, 0] // block
    least = np.minimum(of_held.min(axis=0), of_boxes.min(axis=0)) - 1
    _, size_y, size_z = (int(n) for n in np.maximum(of_held.max(axis=0), of_boxes.max(axis=0)) - least + 2)

    def numbered(blocks: NDArray[np.int64]) -> NDArray[np.int64]:
        x, y, z = (blocks - least).T
        return (x * size_y + y) * size_z + z

    place = numbered(of_held)
    order = np.argsort(place, kind="stable")
    place = place[order]
    by_block = np.argsort(numbered(of_boxes), kind="stable")
    starts = np.flatnonzero(np.diff(numbered(of_boxes)[by_block], prepend=-1))
    for here in np.split(by_block, starts[1:]):
        around = numbered(of_boxes[here[0]] + AROUND)
        first, past = np.searchsorted(place, around), np.searchsorted(place, around, side="right")
        left = np.concatenate([order[a:b] for a, b in zip(first.tolist(), past.tolist(), strict=True)])
        for low, high in boxes[here]:
            left = left[~found[left]]
            if not len(left):
                break
            gap = np.maximum(np.maximum(held[left, 0] - high, low - held[left, 1]), 0)
            gap = np.minimum(gap, farther + 1)
            found[left[(gap * gap).sum(axis=1) <= reach2]] = True
    return found
