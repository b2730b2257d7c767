"""Hierarchy over a voxel's cells, bounded in a stream: from cell summaries, then the points once.

The extreme points of the cells below a node give an estimate of a good centre; the cells' spreads
give the slab's direction. Neither needs the points again. Radius and slab do: every cell's points
pass once, in any order, and a node's bounds grow to hold them. The result is the same whether a
voxel is held in memory or read block by block.
"""

import numpy as np

from ....schemas.kernels import compiling as nb
from .bounding_sphere import (
    LARGE_STEPS,
    SMALL_SET,
    SMALL_STEPS,
    SPREAD,
    ball_center,
    bound_space,
    ceil_sqrt,
    extent_along,
    farthest2,
    join_spread,
    stored_direction,
)
from .build_tree import DIRECTIONS, EXTREMES


@nb.njit(nogil=True, cache=True)
def _join_extremes(extremes, first, count, found):
    """Write the extreme points (EXTREMES, 3) of the rows first to first + count of extremes.

    extremes: (n, EXTREMES, 3).
    """
    for d in range(EXTREMES // 2):
        least, most = np.int64(1) << 62, -(np.int64(1) << 62)
        for i in range(first, first + count):
            for side in range(2):
                along = np.int64(0)
                for k in range(3):
                    along += DIRECTIONS[d, k] * np.int64(extremes[i, 2 * d + side, k])
                if (along < least) if side == 0 else (along > most):
                    for k in range(3):
                        found[2 * d + side, k] = extremes[i, 2 * d + side, k]
                    if side == 0:
                        least = along
                    else:
                        most = along


@nb.njit(nogil=True, cache=True)
def _stored_center(guess, unit, highest, center):
    """Write the stored centre (3,) [units] nearest to an estimate (3,) [steps]."""
    for k in range(3):
        center[k] = min(max(np.int64(np.rint(guess[k] / float(unit))), 0), highest)


@nb.njit(nogil=True, cache=True)
def _guess_center(extremes, first, count, own, space, unit, highest, center):
    """Write an estimated centre (3,) [units] of the points that some rows of extremes represent.

    first, count: the rows of extremes.
    own: (3, n) int32 [steps], filled with all the rows' points.
    space: of `bound_space`, for as many points.
    A ball around the box's centre holds any points with a radius of at most 0.87 of `highest`. It
    replaces an estimate that cannot guarantee a radius of `highest`.
    """
    points = space[0]
    n = EXTREMES * count
    for i in range(count):
        for e in range(EXTREMES):
            for k in range(3):
                own[k, EXTREMES * i + e] = extremes[first + i, e, k]
                points[k, EXTREMES * i + e] = np.float32(extremes[first + i, e, k])
    box, guess = np.empty((2, 3), np.int64), np.empty(3)
    for k in range(3):
        box[0, k] = box[1, k] = own[k, 0]
        for i in range(n):
            box[0, k], box[1, k] = min(box[0, k], np.int64(own[k, i])), max(box[1, k], np.int64(own[k, i]))
        guess[k] = float(box[0, k] + box[1, k]) * 0.5
    steps = SMALL_STEPS if n <= SMALL_SET else LARGE_STEPS
    ball_center(space, np.uint64(0), np.uint64(n), steps, guess)
    _stored_center(guess, unit, highest, center)
    corner = np.int64(0)
    for k in range(3):
        away = max(abs(box[0, k] - center[k] * unit), abs(box[1, k] - center[k] * unit))
        corner += away * away
    if (ceil_sqrt(corner) + unit - 1) // unit > highest:
        for k in range(3):
            guess[k] = float(box[0, k] + box[1, k]) * 0.5
        _stored_center(guess, unit, highest, center)


@nb.njit(nogil=True, cache=True)
def guess_bounds(tree, spreads, extremes, unit, highest, with_slab, center, normal, reach2, slab):
    """Choose centres and directions of a tree over cells; initialise its radii and slabs.

    tree: (begin, count, levels) of `pack_tree` over c cells.
    spreads (c, SPREAD), extremes (c, EXTREMES, 3) int32: of the cells in the tree's order, see
    build_tree.py.
    unit: of stored centres and radii [steps].
    highest: greatest stored coordinate.
    Writes int64, t rows: center (t, 3) [units], normal (t, 3), reach2 (t,) greatest squared
    distance from the centre [steps], slab (t, 2). reach2 and slab cover the extreme points only;
    `grow_bounds` can only enlarge them.
    """
    begin, count, levels = tree
    t, leaves = begin.shape[0], levels[levels.shape[0] - 2]
    most = np.int64(0)
    for node in range(t):
        most = max(most, np.int64(count[node]))
    own, space = np.empty((3, EXTREMES * most), np.int32), bound_space(EXTREMES * most)
    node_spreads, node_extremes = np.empty((t, SPREAD)), np.empty((t, EXTREMES, 3), np.int32)
    guess = np.empty(3)
    for level in range(levels.shape[0] - 2, -1, -1):
        child = levels[level + 1]
        for node in range(levels[level], levels[level + 1]):
            held = np.int64(count[node])
            if node >= leaves:
                below_spreads, below_extremes, first = spreads, extremes, begin[node]
            else:
                below_spreads, below_extremes, first = node_spreads, node_extremes, child
            join_spread(below_spreads, first, held, node_spreads[node])
            _join_extremes(below_extremes, first, held, node_extremes[node])
            _guess_center(below_extremes, first, held, own, space, unit, highest, center[node])
            child += held
            stored_direction(node_spreads[node], with_slab, guess, normal[node])
            x, y, z = center[node, 0] * unit, center[node, 1] * unit, center[node, 2] * unit
            n = np.uint64(EXTREMES * held)
            reach2[node] = farthest2(own, np.uint64(0), n, x, y, z)
            slab[node, 0], slab[node, 1] = extent_along(own, np.uint64(0), n, normal[node], x, y, z)


@nb.njit(nogil=True, cache=True)
def grow_bounds(xyz, starts, low, boxes, above, center, normal, unit, reach2, slab):
    """Enlarge the bounds of the nodes above some cells to hold those cells' points.

    xyz: (3, n) uint16 from their cell's corner, cell by cell.
    starts: (k + 1,) int64.
    low: (k, 3) int64 corners.
    boxes: (k, 2, 3) int64, least and greatest coordinates of the cells' points from the voxel's
    corner.
    above: (h, k) int64, the node of each level that holds the cell.
    center, normal, unit: see `guess_bounds`.
    Raises reach2 and widens slab where the points require it; the points of a cell whose box lies
    within both are not read.
    """
    for cell in range(low.shape[0]):
        lo, hi = np.uint64(starts[cell]), np.uint64(starts[cell + 1])
        for level in range(above.shape[0]):
            node = above[level, cell]
            corner, least, most = np.int64(0), np.int64(0), np.int64(0)
            for k in range(3):
                a, b = boxes[cell, 0, k] - center[node, k] * unit, boxes[cell, 1, k] - center[node, k] * unit
                away = max(abs(a), abs(b))
                corner += away * away
                least += min(normal[node, k] * a, normal[node, k] * b)
                most += max(normal[node, k] * a, normal[node, k] * b)
            x, y, z = (
                center[node, 0] * unit - low[cell, 0],
                center[node, 1] * unit - low[cell, 1],
                center[node, 2] * unit - low[cell, 2],
            )
            if corner > reach2[node]:
                reach2[node] = max(reach2[node], farthest2(xyz, lo, hi, x, y, z))
            if least < slab[node, 0] or most > slab[node, 1]:
                least, most = extent_along(xyz, lo, hi, normal[node], x, y, z)
                slab[node, 0], slab[node, 1] = min(slab[node, 0], least), max(slab[node, 1], most)


@nb.njit(nogil=True, cache=True)
def leaf_rows(xyz, starts, leaf_starts, count, block_low, points):
    """Write the points (n, 3) uint16 of some cells relative to their leaf nodes' low corners.

    xyz, starts: as in `grow_bounds`.
    leaf_starts: (k,) int64, each cell's first leaf node in count (m,) and block_low (m, 3).
    """
    for cell in range(leaf_starts.shape[0]):
        at, node = np.uint64(starts[cell]), leaf_starts[cell]
        end = np.uint64(starts[cell + 1])
        while at < end:
            past = at + np.uint64(count[node])
            for k in range(np.uint64(3)):
                low = block_low[node, k]
                for i in range(at, past):
                    points[i, k] = xyz[k, i] - low
            at = past
            node += 1


@nb.njit(nogil=True, cache=True)
def take_runs(values, starts, chosen, taken):
    """Write the runs values[..., starts[i]:starts[i + 1]] of the chosen i, concatenated, into taken.

    values, taken: (w, n).
    """
    to = np.uint64(0)
    for run in chosen:
        lo, hi = np.uint64(starts[run]), np.uint64(starts[run + 1])
        for k in range(np.uint64(values.shape[0])):
            for i in range(hi - lo):
                taken[k, to + i] = values[k, lo + i]
        to += hi - lo
