"""Closest points by descent of a bounding sphere hierarchy, and nearest boxes of a point; exact.

In a search over several voxels, each voxel is a box, and a tree over the boxes, in their given
order, finds the nearest.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ....schemas.kernels.record_rows import LANES
from ....schemas.runtime import compiling as nb
from ..points.voxel_records import U, read_leaf

FAR = np.int64(1) << np.int64(62)


class NodeSpheres(NamedTuple):
    """Bounds of an opened record (schemas/archive/voxel.py Nodes).

    center: (3, n) uint16.
    radius: (n,) uint16.
    unit: int64, voxel steps per unit in the top hierarchy.
    """

    center: NDArray[np.uint16]
    radius: NDArray[np.uint16]
    unit: np.int64


# Differences are clamped to this before they are squared: three squares then fit into int32. A
# clamped difference is larger than any distance that this path searches for.
_CLAMP = 26754
# Factor that lowers a bound by more than its float64 rounding error.
_BOUND_FACTOR = 1 - 1e-14


@nb.njit(nogil=True, inline="always")
def _nearest_lane(lanes, held, x, y, z, found):
    """Return the least non-zero squared distance of points from (x, y, z), at most `found`; int64.

    lanes: (3, LANES), the first `held` are points.
    """
    if found <= _CLAMP * _CLAMP:
        # Cast to int32 at every step, because numba widens to int64: eight lanes per instruction.
        far = np.int32(_CLAMP)
        qx, qy, qz = np.int32(x), np.int32(y), np.int32(z)
        least = np.int32(0x7FFFFFFF)
        for j in range(held):
            dx = np.int32(min(max(np.int32(lanes[U(0), j] - qx), -far), far))
            dy = np.int32(min(max(np.int32(lanes[U(1), j] - qy), -far), far))
            dz = np.int32(min(max(np.int32(lanes[U(2), j] - qz), -far), far))
            d2 = np.int32(np.int32(dx * dx) + np.int32(np.int32(dy * dy) + np.int32(dz * dz)))
            least = np.int32(min(least, d2 if d2 > 0 else np.int32(0x7FFFFFFF)))
        return min(found, np.int64(least))
    for j in range(held):
        dx, dy, dz = lanes[U(0), j] - x, lanes[U(1), j] - y, lanes[U(2), j] - z
        d2 = dx * dx + dy * dy + dz * dz
        if d2 > 0:
            found = min(found, d2)
    return found


@nb.njit(nogil=True, inline="always")
def _query_leaf(leaves, node, queries, a, b, lanes, best):
    """Lower best[a:b] by the points of a leaf node; return the greatest of them."""
    held, cell, farthest = read_leaf(leaves, node, lanes), U(leaves.cell[node]), np.int64(0)
    x = np.int64(leaves.cell_low[U(0), cell]) + np.int64(leaves.block_low[U(0), node])
    y = np.int64(leaves.cell_low[U(1), cell]) + np.int64(leaves.block_low[U(1), node])
    z = np.int64(leaves.cell_low[U(2), cell]) + np.int64(leaves.block_low[U(2), node])
    for q in range(U(a), U(b)):
        found = _nearest_lane(
            lanes, held, queries[q, U(0)] - x, queries[q, U(1)] - y, queries[q, U(2)] - z, best[q]
        )
        best[q] = found
        farthest = max(farthest, found)
    return farthest


@nb.njit(nogil=True, cache=True)
def closest_in_record(leaves, spheres, queries, groups, start_leaf, best):
    """Lower best (q,) int64 to the squared distance of the closest *distinct* point of a record.

    queries: (q, 3) int64 [voxel steps], at most 2^31 from any point.
    groups: (g + 1,) int64; queries groups[i] to groups[i + 1] are processed together and should lie
    close to each other.
    start_leaf: (g,) int64, the leaf node that contains a group, which is visited first, or -1.
    best: the known upper bound on entry, FAR for none.
    Points at FAR or beyond are not found. A point equal to its query is skipped: duplicates are not
    neighbours (NUMERICS.md case 28). A node is pruned when it is certainly farther from the group's
    box than the largest best of its queries.
    """
    center, radius, unit = spheres
    stack, bounds = np.empty(1280, np.int64), np.empty(1280, np.float64)  # 80 levels of at most 16 children
    lanes = np.empty((3, LANES), np.int32)
    for g in range(groups.shape[0] - 1):
        a, b = groups[g], groups[g + 1]
        lx, ly, lz = queries[a, 0], queries[a, 1], queries[a, 2]
        hx, hy, hz = lx, ly, lz
        farthest = np.int64(0)
        for q in range(a, b):
            lx, hx = min(lx, queries[q, 0]), max(hx, queries[q, 0])
            ly, hy = min(ly, queries[q, 1]), max(hy, queries[q, 1])
            lz, hz = min(lz, queries[q, 2]), max(hz, queries[q, 2])
            farthest = max(farthest, best[q])
        if start_leaf[g] >= 0:
            farthest = _query_leaf(leaves, U(start_leaf[g]), queries, a, b, lanes, best)
        reach = np.sqrt(np.float64(farthest))
        stack[0], bounds[0], depth = 0, 0.0, 1
        while depth > 0:
            depth -= 1
            node = U(stack[depth])
            if bounds[depth] > reach:
                continue
            if leaves.is_leaf[node]:
                if np.int64(node) != start_leaf[g]:
                    farthest = _query_leaf(leaves, node, queries, a, b, lanes, best)
                    reach = np.sqrt(np.float64(farthest))
                continue
            nearest, least = depth, np.inf
            for child in range(U(leaves.first[node]), U(leaves.first[node]) + U(leaves.count[node])):
                scale, cell = np.int64(1), leaves.cell[child]
                x, y, z = (
                    np.int64(center[U(0), child]),
                    np.int64(center[U(1), child]),
                    np.int64(center[U(2), child]),
                )
                if cell < 0:
                    scale, x, y, z = unit, x * unit, y * unit, z * unit
                else:
                    low = leaves.cell_low
                    x, y, z = x + low[U(0), U(cell)], y + low[U(1), U(cell)], z + low[U(2), U(cell)]
                dx = np.float64(max(lx - x, x - hx, 0))
                dy = np.float64(max(ly - y, y - hy, 0))
                dz = np.float64(max(lz - z, z - hz, 0))
                bound = np.sqrt(dx * dx + dy * dy + dz * dz) * _BOUND_FACTOR - np.float64(
                    np.int64(radius[child]) * scale
                )
                if bound <= reach:
                    if bound < least:
                        nearest, least = depth, bound
                    stack[depth], bounds[depth] = child, bound
                    depth += 1
            # Visit the closest child first: its points prune most of the others.
            if least < np.inf:
                last = depth - 1
                stack[nearest], stack[last] = stack[last], stack[nearest]
                bounds[nearest], bounds[last] = bounds[last], bounds[nearest]


# Boxes per box of the next level.
BOX_DEGREE = 8
# Differences from here on count as FAR: their squares would overflow.
_MAX_DIFFERENCE = 1 << 31


class BoxTree(NamedTuple):
    """Boxes level by level, up to a single root; each encloses BOX_DEGREE boxes of the level below.

    low, high: (t, 3) int64, inclusive corners.
    starts: (levels + 1,) int64, where each level begins; level 0 holds the given boxes.
    """

    low: NDArray[np.int64]
    high: NDArray[np.int64]
    starts: NDArray[np.int64]


def make_box_tree(low: NDArray[np.int64], high: NDArray[np.int64]) -> BoxTree:
    """Build the tree over boxes low, high (v, 3), v >= 1."""
    lows, highs = [low], [high]
    while len(lows[-1]) > 1:
        cuts = np.arange(0, len(lows[-1]), BOX_DEGREE)
        lows.append(np.minimum.reduceat(lows[-1], cuts))
        highs.append(np.maximum.reduceat(highs[-1], cuts))
    starts = np.cumsum([0, *map(len, lows)]).astype(np.int64)
    return BoxTree(np.concatenate(lows), np.concatenate(highs), starts)


@nb.njit(nogil=True, inline="always")
def _box_distance2(low, high, box, x, y, z):
    """Return the squared distance of (x, y, z) from a box, at most FAR."""
    gx = max(low[box, 0] - x, x - high[box, 0], 0)
    gy = max(low[box, 1] - y, y - high[box, 1], 0)
    gz = max(low[box, 2] - z, z - high[box, 2], 0)
    if gx >= _MAX_DIFFERENCE or gy >= _MAX_DIFFERENCE or gz >= _MAX_DIFFERENCE:
        return FAR
    # Compare in float64 first: three squares below 2^62 may sum to more than int64 holds.
    if np.float64(gx) * gx + np.float64(gy) * gy + np.float64(gz) * gz > 1.1 * FAR:
        return FAR
    return min(gx * gx + gy * gy + gz * gz, FAR)


@nb.njit(nogil=True, cache=True)
def near_boxes(tree, queries, own, best, after, rows, distances):
    """Find the boxes nearer to each query than best, nearest first; on a tie the first box.

    tree: BoxTree.
    queries: (q, 3) int64.
    own: (q,) int64, a box to exclude.
    best: (q,) int64, squared distances; where it is FAR, only one box is found.
    after: (q, 2) int64, squared distance and number of the last box of the previous call, to
    continue after it; -1, -1 for the first call.
    Writes rows and distances (q, k) int64, with rows -1 after the last, and writes the last box
    found into `after`. Boxes at a distance of FAR or more are not found.
    """
    stack = np.empty((128, 2), np.int64)
    levels = tree.starts.shape[0] - 1
    for q in range(queries.shape[0]):
        x, y, z = queries[q, 0], queries[q, 1], queries[q, 2]
        most = 1 if best[q] >= FAR else rows.shape[1]
        rows[q, :] = -1
        held = 0
        stack[0, 0], stack[0, 1] = levels - 1, 0
        depth = 1
        while depth > 0:
            depth -= 1
            level, item = stack[depth, 0], stack[depth, 1]
            d2 = _box_distance2(tree.low, tree.high, tree.starts[level] + item, x, y, z)
            if d2 >= best[q] or (held == most and d2 > distances[q, held - 1]):
                continue
            if level > 0:
                end = min((item + 1) * BOX_DEGREE, tree.starts[level] - tree.starts[level - 1])
                for child in range(item * BOX_DEGREE, end):
                    stack[depth, 0], stack[depth, 1] = level - 1, child
                    depth += 1
                continue
            if item == own[q] or d2 < after[q, 0] or (d2 == after[q, 0] and item <= after[q, 1]):
                continue
            at = held
            while at > 0 and (
                distances[q, at - 1] > d2 or (distances[q, at - 1] == d2 and rows[q, at - 1] > item)
            ):
                at -= 1
            if at == most:
                continue
            held = min(held + 1, most)
            for i in range(held - 1, at, -1):
                rows[q, i], distances[q, i] = rows[q, i - 1], distances[q, i - 1]
            rows[q, at], distances[q, at] = item, d2
        if held:
            after[q, 0], after[q, 1] = distances[q, held - 1], rows[q, held - 1]
