"""Bounding sphere hierarchies of many sets of points in one call, and the hierarchy over a voxel's cells.

`build_cells` builds the hierarchies of a voxel's cells; an avatar is built as one cell. The top
hierarchy over the cells is bounded in a stream: from cell summaries, then from the points once. The
extreme points of the cells below a node give an estimate of a good centre, and the cells' moments
give the slab's direction, both without the points. Radius and slab need the points: those of every
cell are read once, in any order, and a node's bounds grow to enclose them. The result is the same
whether a voxel is held in memory or read block by block.

Rows of `nodes`, a tuple of arrays as in schemas/archive/voxel.py `Nodes`: center, radius, normal,
slab, count, axis, block_low.
"""

import numpy as np

from ....schemas.runtime import compiling as nb
from .bounding_sphere import (
    LARGE_STEPS,
    MOMENTS,
    SMALL_SET,
    SMALL_STEPS,
    ball_center,
    bound_points,
    bound_workspace,
    ceil_sqrt,
    extent_along,
    greatest_distance2,
    join_moments,
    leaf_moments,
    stored_direction,
)
from .pack_tree import ROWS, longest_edge, max_nodes, pack_points, pack_workspace, sort_run

# The extreme points along these directions, two each, represent a cell in the estimate of the
# centre of a sphere around many cells.
DIRECTIONS = np.array(
    [[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1], [1, 1, -1], [1, -1, 1], [1, -1, -1]], np.int64
)
EXTREMES = 14


@nb.njit(nogil=True, cache=True)
def tree_workspace(n, leaf, degree):
    """Allocate the workspace of `build_tree` for trees of up to n points."""
    most = max_nodes(n, leaf)
    runs = (np.empty(most, np.int64), np.empty(most, np.int64), np.empty(64, np.int64))
    return pack_workspace(n, degree), bound_workspace(n), runs, np.empty((most, MOMENTS)), np.empty(3)


@nb.njit(nogil=True, cache=True)
def tree_rows(n, leaf):
    """Allocate the int64 node rows that `build_tree` writes for one tree of up to n points."""
    most = max_nodes(n, leaf)
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
def build_tree(ranked, n, leaf, degree, with_slab, highest, workspace, nodes, moments):
    """Build the hierarchy of the first n points of ranked (4, >= n) and bound its nodes.

    ranked, leaf, degree: see `pack_points`.
    with_slab, highest: see `bound_points`.
    workspace: of `tree_workspace`; its runs hold the result's runs afterwards.
    nodes: of `tree_rows`.
    Moves the points into leaf-node order; the points of a leaf node are sorted along the longest
    edge of their box, ties by rank. Writes rows of nodes, level by level from the root, and moments
    (MOMENTS,) of all points. Returns (number of rows, level of the leaf nodes).
    """
    packing, bounding, runs, moment_rows, guess = workspace
    begin, end, levels = runs
    center, radius, normal, slab, count, axis, block_low = nodes
    height = pack_points(ranked, n, leaf, degree, packing, begin, end, count, levels)
    total, leaves = levels[height + 1], levels[height]
    for node in range(total):
        axis[node] = 0
        for k in range(3):
            block_low[node, k] = 0
    for node in range(leaves, total):
        lo, hi = np.uint64(begin[node]), np.uint64(end[node])
        along = longest_edge(ranked, lo, hi)[0]
        sort_run(ranked, packing[0], lo, hi, along)
        axis[node] = along
        for k in range(np.uint64(3)):
            least = ranked[k, lo]
            for i in range(lo, hi):
                least = min(least, ranked[k, i])
            block_low[node, k] = least
        leaf_moments(ranked, lo, hi, moment_rows[node])
    for level in range(height - 1, -1, -1):
        child = levels[level + 1]
        for node in range(levels[level], levels[level + 1]):
            join_moments(moment_rows, child, np.int64(count[node]), moment_rows[node])
            child += np.int64(count[node])
    for k in range(np.uint64(3)):
        for i in range(np.uint64(n)):
            bounding[0][k, i] = np.float32(ranked[k, i])
    for node in range(total):
        lo, hi = np.uint64(begin[node]), np.uint64(end[node])
        radius[node] = bound_points(
            ranked,
            bounding,
            lo,
            hi,
            highest,
            moment_rows[node],
            with_slab,
            guess,
            center[node],
            normal[node],
            slab[node],
        )
    for k in range(MOMENTS):
        moments[k] = moment_rows[0, k]
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
def extreme_points(ranked, n, low, extremes):
    """Write the extreme points (EXTREMES, 3) of the first n of ranked along DIRECTIONS, plus low (3,).

    Each direction gives its least, then its greatest point.
    """
    for d in range(EXTREMES // 2):
        a, b, c = DIRECTIONS[d, 0], DIRECTIONS[d, 1], DIRECTIONS[d, 2]
        least, most = np.int64(1) << 62, -(np.int64(1) << 62)
        for i in range(np.uint64(n)):
            along = a * np.int64(ranked[0, i]) + b * np.int64(ranked[1, i]) + c * np.int64(ranked[2, i])
            key = (along << 32) + np.int64(i)
            least, most = min(least, key), max(most, key)
        for side in range(2):
            chosen = np.uint64((least if side == 0 else most) & 0xFFFFFFFF)
            for k in range(np.uint64(3)):
                extremes[2 * d + side, k] = low[k] + np.int64(ranked[k, chosen])


@nb.njit(nogil=True, cache=True)
def build_cells(
    points, starts, low, leaf, degree, with_slab, highest, nodes, row_counts, xyz, rank, moment_rows, extremes
):
    """Build the hierarchies of cells, one after the other; return the number of rows.

    points: (n, 3) int32 [voxel steps], cell by cell, in canonical order.
    starts: (c + 1,) int64, first point of each cell, and n.
    low: (c, 3) int64, the cells' corners.
    leaf, degree, with_slab, highest: see `build_tree`.
    Writes rows of nodes, cell by cell, level by level; row_counts (c,), the number of rows of each
    cell; xyz (3, n) uint16, the points in leaf-node order, from their cell's corner; rank (n,)
    int32, each point's index in `points`; moment_rows (c, MOMENTS) and extremes (c, EXTREMES, 3)
    int32 of the cells' points, from the voxel's corner.
    """
    largest = np.int64(0)
    for cell in range(low.shape[0]):
        largest = max(largest, starts[cell + 1] - starts[cell])
    ranked = np.empty((ROWS, largest), np.int32)
    workspace, rows = tree_workspace(largest, leaf, degree), tree_rows(largest, leaf)
    row = 0
    for cell in range(low.shape[0]):
        first = np.uint64(starts[cell])
        n = np.uint64(starts[cell + 1]) - first
        x, y, z = np.int32(low[cell, 0]), np.int32(low[cell, 1]), np.int32(low[cell, 2])
        for i in range(n):
            ranked[0, i] = points[first + i, 0] - x
            ranked[1, i] = points[first + i, 1] - y
            ranked[2, i] = points[first + i, 2] - z
            ranked[3, i] = i
        total, _ = build_tree(
            ranked, np.int64(n), leaf, degree, with_slab, highest, workspace, rows, moment_rows[cell]
        )
        _store_rows(rows, total, nodes, row)
        for k in range(3):
            moment_rows[cell, 1 + k] += float(low[cell, k])
        extreme_points(ranked, n, low[cell], extremes[cell])
        for k in range(np.uint64(3)):
            for i in range(n):
                xyz[k, first + i] = ranked[k, i]
        for i in range(n):
            rank[first + i] = np.int32(first + np.uint64(ranked[3, i]))
        row_counts[cell] = total
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
def _guess_center(extremes, first, count, xyz, workspace, unit, highest, center):
    """Write an estimated centre (3,) [units] of the points that some rows of extremes represent.

    first, count: the rows of extremes.
    xyz: (3, n) int32 [steps], filled with all the rows' points.
    workspace: of `bound_workspace`, for as many points.
    A ball around the box's centre holds any points with a radius of at most 0.87 of `highest`. It
    replaces an estimate that cannot guarantee a radius of `highest`.
    """
    points = workspace[0]
    n = EXTREMES * count
    for i in range(count):
        for e in range(EXTREMES):
            for k in range(3):
                xyz[k, EXTREMES * i + e] = extremes[first + i, e, k]
                points[k, EXTREMES * i + e] = np.float32(extremes[first + i, e, k])
    box, guess = np.empty((2, 3), np.int64), np.empty(3)
    for k in range(3):
        box[0, k] = box[1, k] = xyz[k, 0]
        for i in range(n):
            box[0, k], box[1, k] = (
                min(box[0, k], np.int64(xyz[k, i])),
                max(box[1, k], np.int64(xyz[k, i])),
            )
        guess[k] = float(box[0, k] + box[1, k]) * 0.5
    steps = SMALL_STEPS if n <= SMALL_SET else LARGE_STEPS
    ball_center(workspace, np.uint64(0), np.uint64(n), steps, guess)
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
def initial_bounds(tree, moment_rows, extremes, unit, highest, with_slab, center, normal, reach2, slab):
    """Choose centres and directions of a tree over cells; initialise its radii and slabs.

    tree: (begin, count, levels) of `pack_tree` over c cells.
    moment_rows (c, MOMENTS), extremes (c, EXTREMES, 3) int32: of the cells in the tree's order, see
    build_tree.py.
    unit: of stored centres and radii [steps].
    highest: greatest stored coordinate.
    Writes int64, t rows: center (t, 3) [units], normal (t, 3), reach2 (t,) greatest squared
    distance from the centre [steps], slab (t, 2). reach2 and slab cover the extreme points only;
    `enlarge_bounds` can only enlarge them.
    """
    begin, count, levels = tree
    t, leaves = begin.shape[0], levels[levels.shape[0] - 2]
    most = np.int64(0)
    for node in range(t):
        most = max(most, np.int64(count[node]))
    xyz, workspace = np.empty((3, EXTREMES * most), np.int32), bound_workspace(EXTREMES * most)
    node_moments, node_extremes = np.empty((t, MOMENTS)), np.empty((t, EXTREMES, 3), np.int32)
    guess = np.empty(3)
    for level in range(levels.shape[0] - 2, -1, -1):
        child = levels[level + 1]
        for node in range(levels[level], levels[level + 1]):
            held = np.int64(count[node])
            if node >= leaves:
                below_moments, below_extremes, first = moment_rows, extremes, begin[node]
            else:
                below_moments, below_extremes, first = node_moments, node_extremes, child
            join_moments(below_moments, first, held, node_moments[node])
            _join_extremes(below_extremes, first, held, node_extremes[node])
            _guess_center(below_extremes, first, held, xyz, workspace, unit, highest, center[node])
            child += held
            stored_direction(node_moments[node], with_slab, guess, normal[node])
            x, y, z = center[node, 0] * unit, center[node, 1] * unit, center[node, 2] * unit
            n = np.uint64(EXTREMES * held)
            reach2[node] = greatest_distance2(xyz, np.uint64(0), n, x, y, z)
            slab[node, 0], slab[node, 1] = extent_along(xyz, np.uint64(0), n, normal[node], x, y, z)


@nb.njit(nogil=True, cache=True)
def enlarge_bounds(xyz, starts, low, boxes, above, center, normal, unit, reach2, slab):
    """Enlarge the bounds of the nodes above some cells to hold those cells' points.

    xyz: (3, n) uint16 from their cell's corner, cell by cell.
    starts: (k + 1,) int64.
    low: (k, 3) int64 corners.
    boxes: (k, 2, 3) int64, least and greatest coordinates of the cells' points from the voxel's
    corner.
    above: (h, k) int64, the node of each level that holds the cell.
    center, normal, unit: see `initial_bounds`.
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
                reach2[node] = max(reach2[node], greatest_distance2(xyz, lo, hi, x, y, z))
            if least < slab[node, 0] or most > slab[node, 1]:
                least, most = extent_along(xyz, lo, hi, normal[node], x, y, z)
                slab[node, 0], slab[node, 1] = min(slab[node, 0], least), max(slab[node, 1], most)


@nb.njit(nogil=True, cache=True)
def leaf_rows(xyz, starts, leaf_starts, count, block_low, points):
    """Write the points (n, 3) uint16 of some cells relative to their leaf nodes' low corners.

    xyz, starts: as in `enlarge_bounds`.
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
def copy_runs(values, starts, chosen, taken):
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
