"""Packing of points into an R-tree-like hierarchy: leaf nodes on one level, nodes as full as possible.

[Fig12] inserts into an R-tree. A tree whose points are all known is better packed from the top (Lee
and Lee, "OMT: Overlap minimizing top-down bulk loading", 2003): split along the longest edge, at a
multiple of the leaf size, until every part is one child.

The points are moved while they are split, and every loop runs over consecutive memory. `ranked` holds
x, y, z and rank in rows; its final order is the order of the leaf nodes. Loop indices are uint64,
see schemas/kernels/record_rows.py.
"""

import numpy as np

from ....schemas.runtime import compiling as nb

# Maximum bins of the histogram in which a median is located.
BINS = 256
# Rows of `ranked`: x, y, z [steps], and the original index of the point.
ROWS = 4
RANK = np.uint64(3)


@nb.njit(nogil=True, cache=True)
def longest_edge(ranked, lo, hi):
    """Return the axis of greatest extent of points [lo, hi), its least coordinate and its extent.

    ranked: (4, n). On a tie the lower axis is returned.
    """
    axis, low, widest = np.uint64(0), np.int64(0), np.int64(-1)
    for k in range(np.uint64(3)):
        least, most = ranked[k, lo], ranked[k, lo]
        for i in range(lo, hi):
            least, most = min(least, ranked[k, i]), max(most, ranked[k, i])
        if np.int64(most) - np.int64(least) > widest:
            axis, low, widest = np.uint64(k), np.int64(least), np.int64(most) - np.int64(least)
    return axis, low, widest


@nb.njit(nogil=True, cache=True)
def _nth(keys, count, nth):
    """Return the key with `nth` smaller ones among keys[:count], all distinct; reorders the keys.

    Quickselect: numba's own `partition` takes 5 s to compile.
    """
    lo, hi = 0, count - 1
    while lo < hi:
        a, b, c = keys[lo], keys[(lo + hi) // 2], keys[hi]
        pivot = max(min(a, b), min(max(a, b), c))
        i, j = lo, hi
        while i <= j:
            while keys[i] < pivot:
                i += 1
            while keys[j] > pivot:
                j -= 1
            if i <= j:
                keys[i], keys[j] = keys[j], keys[i]
                i += 1
                j -= 1
        if nth <= j:
            hi = j
        elif nth >= i:
            lo = i
        else:
            break
    return keys[nth]


@nb.njit(nogil=True, cache=True)
def _split_key(ranked, keys, bins, lo, hi, at, axis, low, extent):
    """Return the key, coordinate << 32 | rank, with `at - lo` smaller ones among the points [lo, hi).

    The points are counted into bins along the axis; the key is then selected in the one bin that
    must contain it.
    """
    wanted = np.int64(at - lo)
    limit = min(np.int64(BINS), np.int64(hi - lo))
    shift = np.int64(0)
    while extent >> shift >= limit:
        shift += 1
    for b in range(limit):
        bins[b] = 0
    for i in range(lo, hi):
        bins[(np.int64(ranked[axis, i]) - low) >> shift] += 1
    chosen, below = np.int64(0), np.int64(0)
    while below + bins[chosen] <= wanted:
        below += bins[chosen]
        chosen += 1
    if below == wanted:
        return (low + (chosen << shift)) << 32
    found = 0
    for i in range(lo, hi):
        coordinate = np.int64(ranked[axis, i])
        keys[found] = coordinate << 32 | np.int64(ranked[RANK, i])
        found += (coordinate - low) >> shift == chosen
    return _nth(keys, found, wanted - below)


@nb.njit(nogil=True, cache=True)
def _split(ranked, spare, keys, bins, lo, hi, at):
    """Move the `at - lo` least of the points [lo, hi) along the longest edge to the front.

    Ties are broken by rank: the two sets depend on the points and their ranks alone.
    """
    axis, low, extent = longest_edge(ranked, lo, hi)
    key = _split_key(ranked, keys, bins, lo, hi, at, axis, low, extent)
    left, right = lo, at
    for i in range(lo, hi):
        is_left = (np.int64(ranked[axis, i]) << 32 | np.int64(ranked[RANK, i])) < key
        to = left if is_left else right
        for q in range(np.uint64(ROWS)):
            spare[q, to] = ranked[q, i]
        left += np.uint64(is_left)
        right += np.uint64(not is_left)
    for q in range(np.uint64(ROWS)):
        for i in range(lo, hi):
            ranked[q, i] = spare[q, i]


@nb.njit(nogil=True, cache=True)
def _split_into(ranked, spare, keys, bins, stack, lo, hi, leaf, parts, ends):
    """Split the points [lo, hi) into `parts` runs with numbers of whole leaves as equal as possible.

    Writes the runs' ends in order. The split halves recursively, with a stack of (lo, hi, parts)
    and the left part on top.
    """
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
        _split(ranked, spare, keys, bins, np.uint64(a), np.uint64(b), np.uint64(middle))
        stack[depth, 0], stack[depth, 1], stack[depth, 2] = middle, b, k - left
        stack[depth + 1, 0], stack[depth + 1, 1], stack[depth + 1, 2] = a, middle, left
        depth += 2


@nb.njit(nogil=True, cache=True)
def max_nodes(n, leaf):
    """Return an upper bound on the nodes of a tree of n points in leaf nodes of `leaf`.

    Degree 2 is the worst case: a level for 2^l leaves has at most 2 leaves / 2^l + 1 nodes.
    """
    return 4 * ((n + leaf - 1) // leaf) + 64


@nb.njit(nogil=True, cache=True)
def pack_workspace(n, degree):
    """Allocate the workspace of `pack_points` for up to n points: spare, keys, bins, stack, ends."""
    return (
        np.empty((ROWS, n), np.int32),
        np.empty(n + 1, np.int64),
        np.empty(BINS, np.int64),
        np.empty((degree + 1, 3), np.int64),
        np.empty(degree, np.int64),
    )


@nb.njit(nogil=True, cache=True)
def pack_points(ranked, n, leaf, degree, workspace, begin, end, count, levels):
    """Pack the first n points of ranked into a tree; return h, the level of the leaf nodes.

    ranked: (4, >= n) int32, 1 <= n < 2^31: x, y, z of 0 to 2^23, distinct ranks.
    leaf: maximum points of a leaf node.
    degree: maximum children of an inner node.
    workspace: of `pack_workspace`.
    Moves the points into leaf-node order; inside a leaf node the order is undefined. Writes the
    nodes level by level from the root, children in order: begin, end (>= t,) int64, each node's
    run; count (>= t,) uint8, children, or points of a leaf node; levels (>= h + 2,) int64, first
    node of each level, and t.
    """
    spare, keys, bins, stack, ends = workspace
    leaves = (n + leaf - 1) // leaf
    height, capacity = 0, np.int64(1)  # capacity: maximum leaf nodes below one node of this level
    while capacity < leaves:
        capacity *= degree
        height += 1
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
            _split_into(ranked, spare, keys, bins, stack, a, b, leaf, parts, ends)
            count[node] = parts
            for part in range(parts):
                begin[total], end[total] = a, ends[part]
                a = ends[part]
                total += 1
    levels[height + 1] = total
    for node in range(levels[height], total):
        count[node] = end[node] - begin[node]
    return height


@nb.njit(nogil=True, cache=True)
def node_counts(n, leaf, degree, count, node_points):
    """Write the counts of `pack_points` for n points without the points; return t, the number of nodes.

    Splits depend on the number of points alone, and the counts are the same for any points.
    Coincident points therefore need no packing. Writes count (>= t,) as `pack_points` does, and
    node_points (>= t,) int64, the points of each node.
    """
    leaves = (n + leaf - 1) // leaf
    capacity = np.int64(1)
    while capacity < leaves:
        capacity *= degree
    stack, sizes = np.empty((degree + 1, 2), np.int64), np.empty(1, np.int64)
    sizes[0] = n
    total = 0
    while capacity > 1:
        capacity //= degree
        below, found = np.empty(min(degree * sizes.shape[0], leaves), np.int64), 0
        for size in sizes:
            parts = ((size + leaf - 1) // leaf + capacity - 1) // capacity
            count[total], node_points[total] = parts, size
            total += 1
            stack[0, 0], stack[0, 1] = size, parts
            depth = 1
            while depth > 0:
                depth -= 1
                rest, k = stack[depth, 0], stack[depth, 1]
                if k == 1:
                    below[found] = rest
                    found += 1
                    continue
                left = k // 2
                middle = ((rest + leaf - 1) // leaf * left // k) * leaf
                stack[depth, 0], stack[depth, 1] = rest - middle, k - left
                stack[depth + 1, 0], stack[depth + 1, 1] = middle, left
                depth += 2
        sizes = below[:found]
    for size in sizes:
        count[total] = node_points[total] = size
        total += 1
    return total


@nb.njit(nogil=True, cache=True)
def sort_run(ranked, spare, lo, hi, axis):
    """Sort the points [lo, hi) of ranked along an axis, ties by rank.

    Each point moves to the index given by the number of points before it.
    """
    for j in range(lo, hi):
        coordinate, rank = ranked[axis, j], ranked[RANK, j]
        before = np.int32(0)
        for i in range(lo, hi):
            is_before = (ranked[axis, i] < coordinate) | (
                (ranked[axis, i] == coordinate) & (ranked[RANK, i] < rank)
            )
            before = np.int32(before + np.int32(is_before))
        for q in range(np.uint64(ROWS)):
            spare[q, lo + np.uint64(before)] = ranked[q, j]
    for q in range(np.uint64(ROWS)):
        for i in range(lo, hi):
            ranked[q, i] = spare[q, i]


@nb.njit(nogil=True, cache=True)
def pack_tree(points, leaf, degree):
    """Pack points (n, 3) int32, 1 <= n < 2^31, coordinates 0 to 2^23, into a tree with `pack_points`.

    Returns (order (n,) int64: the points in leaf-node order; begin, end (t,) int64; count (t,)
    uint8; levels (h + 2,) int64).
    """
    n = points.shape[0]
    ranked = np.empty((ROWS, n), np.int32)
    for i in range(n):
        ranked[0, i], ranked[1, i], ranked[2, i], ranked[3, i] = (
            points[i, 0],
            points[i, 1],
            points[i, 2],
            i,
        )
    most = max_nodes(n, leaf)
    begin, end = np.empty(most, np.int64), np.empty(most, np.int64)
    count, levels = np.empty(most, np.uint8), np.empty(64, np.int64)
    height = pack_points(ranked, n, leaf, degree, pack_workspace(n, degree), begin, end, count, levels)
    total = levels[height + 1]
    return (
        ranked[RANK].astype(np.int64),
        begin[:total].copy(),
        end[:total].copy(),
        count[:total].copy(),
        levels[: height + 2].copy(),
    )
