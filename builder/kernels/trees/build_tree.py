"""Bounding sphere hierarchies of many sets of points in one call, and the hierarchy over a voxel's cells.

`build_cells` builds the hierarchies of a voxel's cells; an avatar is built as one cell. The top
hierarchy over the cells is bounded in a stream: from cell summaries, then from the points once. The
extreme points of the cells below a node give an estimate of a good centre; the cells' spreads give
the slab's direction. Neither needs the points again. Radius and slab do: every cell's points pass
once, in any order, and a node's bounds grow to hold them. The result is the same whether a voxel is
held in memory or read block by block.

Rows of `nodes`, a tuple of arrays as in schemas/archive/voxel.py `Nodes`: center, radius, normal, slab,
count, axis, block_low.
"""

import numpy as np

from ....schemas.kernels import compiling as nb
from .bounding_sphere import (
    LARGE_STEPS,
    SMALL_SET,
    SMALL_STEPS,
    SPREAD,
    ball_center,
    bound_run,
    bound_space,
    ceil_sqrt,
    extent_along,
    farthest2,
    join_spread,
    leaf_spread,
    stored_direction,
)
from .pack_tree import ROWS, longest_edge, most_nodes, pack_points, pack_space, sort_run

# The extreme points along these directions, two each, represent a cell in the estimate of the
# centre of a sphere around many cells.
DIRECTIONS = np.array(
    [[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1], [1, 1, -1], [1, -1, 1], [1, -1, -1]], np.int64
)
EXTREMES = 14


@nb.njit(nogil=True, cache=True)
def tree_space(n, leaf, degree):
    """Allocate the work space of `build_tree` for trees of up to n points."""
    most = most_nodes(n, leaf)
    runs = (np.empty(most, np.int64), np.empty(most, np.int64), np.empty(64, np.int64))
    return pack_space(n, degree), bound_space(n), runs, np.empty((most, SPREAD)), np.empty(3)


@nb.njit(nogil=True, cache=True)
def tree_rows(n, leaf):
    """Allocate the int64 node rows that `build_tree` writes for one tree of up to n points."""
    most = most_nodes(n, leaf)
    return (
        np.empty((most, 3), np.int64),
        np.empty(most, np.int64),
        np.empty((most, 3), np.int64),
        np.empty((most, 2), np.int64),
        np.empty(most, np.uint8),
        np.empty(most, np.uint8),
        np.empty((most, 3), np.int64),
    )


@nb.njit(nogil=True, cache=True)
def build_tree(own, n, leaf, degree, with_slab, highest, space, nodes, spread):
    """Build the hierarchy of the first n points of own (4, >= n) and bound its nodes.

    own, leaf, degree: see `pack_points`.
    with_slab, highest: see `bound_run`.
    space: of `tree_space`; its runs hold the result's runs afterwards.
    nodes: of `tree_rows`.
    Moves the points into leaf-node order; the points of a leaf node are sorted along the longest
    edge of their box, ties by rank. Writes rows of nodes, level by level from the root, and spread
    (SPREAD,) of all points. Returns (number of rows, level of the leaf nodes).
    """
    packing, bounding, runs, spreads, guess = space
    begin, end, levels = runs
    center, radius, normal, slab, count, axis, block_low = nodes
    height = pack_points(own, n, leaf, degree, packing, begin, end, count, levels)
    total, leaves = levels[height + 1], levels[height]
    for node in range(total):
        axis[node] = 0
        for k in range(3):
            block_low[node, k] = 0
    for node in range(leaves, total):
        lo, hi = np.uint64(begin[node]), np.uint64(end[node])
        along = longest_edge(own, lo, hi)[0]
        sort_run(own, packing[0], lo, hi, along)
        axis[node] = along
        for k in range(np.uint64(3)):
            least = own[k, lo]
            for i in range(lo, hi):
                least = min(least, own[k, i])
            block_low[node, k] = least
        leaf_spread(own, lo, hi, spreads[node])
    for level in range(height - 1, -1, -1):
        child = levels[level + 1]
        for node in range(levels[level], levels[level + 1]):
            join_spread(spreads, child, np.int64(count[node]), spreads[node])
            child += np.int64(count[node])
    for k in range(np.uint64(3)):
        for i in range(np.uint64(n)):
            bounding[0][k, i] = np.float32(own[k, i])
    for node in range(total):
        lo, hi = np.uint64(begin[node]), np.uint64(end[node])
        radius[node] = bound_run(
            own,
            bounding,
            lo,
            hi,
            highest,
            spreads[node],
            with_slab,
            guess,
            center[node],
            normal[node],
            slab[node],
        )
    for k in range(SPREAD):
        spread[k] = spreads[0, k]
    return total, height


@nb.njit(nogil=True, cache=True)
def _store_rows(rows, total, nodes, at):
    """Write the first `total` rows of a tree into nodes from row `at` on, narrowed to the stored types."""
    center, radius, normal, slab, count, axis, block_low = rows
    for i in range(total):
        for k in range(3):
            nodes[0][at + i, k] = center[i, k]
            nodes[2][at + i, k] = normal[i, k]
            nodes[6][at + i, k] = block_low[i, k]
        nodes[1][at + i] = radius[i]
        nodes[3][at + i, 0], nodes[3][at + i, 1] = slab[i, 0], slab[i, 1]
        nodes[4][at + i], nodes[5][at + i] = count[i], axis[i]


@nb.njit(nogil=True, cache=True)
def extreme_points(own, n, low, extremes):
    """Write the extreme points (EXTREMES, 3) of the first n of own along DIRECTIONS, plus low (3,).

    Each direction gives its least, then its greatest point.
    """
    for d in range(EXTREMES // 2):
        a, b, c = DIRECTIONS[d, 0], DIRECTIONS[d, 1], DIRECTIONS[d, 2]
        least, most = np.int64(1) << 62, -(np.int64(1) << 62)
        for i in range(np.uint64(n)):
            along = a * np.int64(own[0, i]) + b * np.int64(own[1, i]) + c * np.int64(own[2, i])
            key = (along << 32) + np.int64(i)
            least, most = min(least, key), max(most, key)
        for side in range(2):
            chosen = np.uint64((least if side == 0 else most) & 0xFFFFFFFF)
            for k in range(np.uint64(3)):
                extremes[2 * d + side, k] = low[k] + np.int64(own[k, chosen])


@nb.njit(nogil=True, cache=True)
def build_cells(
    points, starts, low, leaf, degree, with_slab, highest, nodes, held, xyz, rank, spreads, extremes
):
    """Build the hierarchies of cells, one after the other; return the number of rows.

    points: (n, 3) int32 [voxel steps], cell by cell, in canonical order.
    starts: (c + 1,) int64, first point of each cell, and n.
    low: (c, 3) int64, the cells' corners.
    leaf, degree, with_slab, highest: see `build_tree`.
    Writes rows of nodes, cell by cell, level by level; held (c,), the number of rows of each cell;
    xyz (3, n) uint16, the points in leaf-node order, from their cell's corner; rank (n,) int32,
    each point's index in `points`; spreads (c, SPREAD) and extremes (c, EXTREMES, 3) int32 of the
    cells' points, from the voxel's corner.
    """
    largest = np.int64(0)
    for cell in range(low.shape[0]):
        largest = max(largest, starts[cell + 1] - starts[cell])
    own = np.empty((ROWS, largest), np.int32)
    space, rows = tree_space(largest, leaf, degree), tree_rows(largest, leaf)
    row = 0
    for cell in range(low.shape[0]):
        first = np.uint64(starts[cell])
        n = np.uint64(starts[cell + 1]) - first
        x, y, z = np.int32(low[cell, 0]), np.int32(low[cell, 1]), np.int32(low[cell, 2])
        for i in range(n):
            own[0, i] = points[first + i, 0] - x
            own[1, i] = points[first + i, 1] - y
            own[2, i] = points[first + i, 2] - z
            own[3, i] = i
        total, _ = build_tree(own, np.int64(n), leaf, degree, with_slab, highest, space, rows, spreads[cell])
        _store_rows(rows, total, nodes, row)
        for k in range(3):
            spreads[cell, 1 + k] += float(low[cell, k])
        extreme_points(own, n, low[cell], extremes[cell])
        for k in range(np.uint64(3)):
            for i in range(n):
                xyz[k, first + i] = own[k, i]
        for i in range(n):
            rank[first + i] = np.int32(first + np.uint64(own[3, i]))
        held[cell] = total
        row += total
    return row


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
