"""Packing of points into an R-tree-like hierarchy: all leaf nodes on one level, nodes full where they can be.

[Fig12] inserts into an R-tree; a tree known whole is better packed from the top (Lee and Lee, "OMT:
Overlap minimizing top-down bulk loading", 2003): cut along the longest edge, at a multiple of the leaf
size, until every part is one child.
"""

import numba as nb
import numpy as np


@nb.njit(nogil=True, cache=True)
def _longest_edge(points, order, lo, hi):
    """The axis along which points[order[lo:hi]] extend farthest; the lower axis on a tie."""
    axis, widest = 0, np.int64(-1)
    for k in range(3):
        least, most = points[order[lo], k], points[order[lo], k]
        for i in range(lo + 1, hi):
            least = min(least, points[order[i], k])
            most = max(most, points[order[i], k])
        if np.int64(most) - np.int64(least) > widest:
            axis, widest = k, np.int64(most) - np.int64(least)
    return axis


@nb.njit(nogil=True, cache=True)
def _cut(points, order, lo, hi, at):
    """Reorder order[lo:hi] so that the `at - lo` least along the longest edge stand first.

    Ties go by rank (the number in `order`), so the two sets are a function of the points alone.
    """
    axis = _longest_edge(points, order, lo, hi)
    keys = np.empty(hi - lo, np.int64)
    for i in range(lo, hi):
        keys[i - lo] = (np.int64(points[order[i], axis]) << 32) | np.int64(order[i])
    keys = np.partition(keys, at - lo)
    for i in range(lo, hi):
        order[i] = keys[i - lo] & 0xFFFFFFFF


@nb.njit(nogil=True, cache=True)
def _cut_into(points, order, lo, hi, leaf, parts, ends):
    """Cut order[lo:hi] into `parts` runs of as equal whole leaves as can be; writes their ends, in order.

    Halving: a stack of (lo, hi, parts), the left part on top, so ends come out in order.
    """
    stack = np.empty((parts + 1, 3), np.int64)
    stack[0, 0], stack[0, 1], stack[0, 2] = lo, hi, parts
    depth, found = 1, 0
    while depth > 0:
        depth -= 1
        a, b, k = stack[depth, 0], stack[depth, 1], stack[depth, 2]
        if k == 1:
            ends[found] = b
            found += 1
            continue
        leaves = (b - a + leaf - 1) // leaf
        left = k // 2
        middle = a + (leaves * left // k) * leaf
        _cut(points, order, a, b, middle)
        stack[depth, 0], stack[depth, 1], stack[depth, 2] = middle, b, k - left
        stack[depth + 1, 0], stack[depth + 1, 1], stack[depth + 1, 2] = a, middle, left
        depth += 2


@nb.njit(nogil=True, cache=True)
def pack_tree(points, leaf, degree):
    """Pack points (n, 3) int32, 1 <= n < 2^31, into a tree.

    leaf: most points a leaf node, degree: most children an inner node.
    Returns (order (n,) int64: the points in leaf-node order; begin, end (t,) int64: each node's run in
    `order`; count (t,) uint8: children, or points of a leaf node; levels (h + 1,) int64: first node of
    each level, and t). Nodes stand level by level from the root, children in order.
    """
    n = points.shape[0]
    leaves = (n + leaf - 1) // leaf
    height, capacity = 0, np.int64(1)  # capacity: leaf nodes below one node of this level
    while capacity < leaves:
        capacity *= degree
        height += 1
    order = np.arange(n)
    most = (
        4 * leaves + height + 1
    )  # degree 2 is the worst: a level for 2^l leaves has at most 2 leaves / 2^l + 1
    begin, end = np.empty(most, np.int64), np.empty(most, np.int64)
    count = np.empty(most, np.uint8)
    levels = np.empty(height + 2, np.int64)
    ends = np.empty(degree, np.int64)
    begin[0], end[0] = 0, n
    levels[0], total = 0, 1
    for level in range(height):
        capacity //= degree
        first, past = levels[level], total
        levels[level + 1] = past
        for node in range(first, past):
            a, b = begin[node], end[node]
            held = (b - a + leaf - 1) // leaf
            parts = (held + capacity - 1) // capacity
            _cut_into(points, order, a, b, leaf, parts, ends)
            count[node] = parts
            for part in range(parts):
                begin[total], end[total] = a, ends[part]
                a = ends[part]
                total += 1
    levels[height + 1] = total
    for node in range(levels[height], total):
        count[node] = end[node] - begin[node]
    return order, begin[:total].copy(), end[:total].copy(), count[:total].copy(), levels


@nb.njit(nogil=True, cache=True)
def sort_leaves(points, order, begin, end, first_leaf, axis, block_low):
    """Sort every leaf node's points along the longest edge of their box, ties by rank.

    points: (n, 3) int32.  order: (n,) int64, reordered in place.  begin, end: (t,) runs of the nodes, leaf
    nodes from row first_leaf on. Writes axis (t,) uint8 and block_low (t, 3) int64 of the leaf nodes.
    """
    for node in range(first_leaf, begin.shape[0]):
        lo, hi = begin[node], end[node]
        along = _longest_edge(points, order, lo, hi)
        axis[node] = along
        keys = np.empty(hi - lo, np.int64)
        for i in range(lo, hi):
            keys[i - lo] = (np.int64(points[order[i], along]) << 32) | np.int64(order[i])
        keys.sort()
        for i in range(lo, hi):
            order[i] = keys[i - lo] & 0xFFFFFFFF
        for k in range(3):
            least = np.int64(points[order[lo], k])
            for i in range(lo + 1, hi):
                least = min(least, np.int64(points[order[i], k]))
            block_low[node, k] = least
