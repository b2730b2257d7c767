"""Bounding sphere hierarchies of many sets of points in one call: a voxel's cells, or an avatar.

Rows of `nodes`, a tuple of arrays as in schemas/archive/voxel.py `Nodes`: center, radius, normal, slab,
count, axis, block_low.
"""

import numpy as np

from ....schemas.kernels import compiling as nb
from .bounding_sphere import SPREAD, bound_run, bound_space, join_spread, leaf_spread
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
