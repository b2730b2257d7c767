"""Closest points by descent of a BSH, exact over integers."""

from typing import NamedTuple

import numba as nb
import numpy as np
from numpy.typing import NDArray

from .bounding_sphere import ceil_sqrt

FAR = np.int64(1) << np.int64(62)


class SearchTree(NamedTuple):
    """A BSH with its points, all in one integer frame.

    center: (n, 3) int64, radius: (n,) int64.  first: (n,) int32, first child, or first point of a leaf node.
    count: (n,) uint8.  is_leaf: (n,) bool.  points: (p, 3) int64.
    """

    center: NDArray[np.int64]
    radius: NDArray[np.int64]
    first: NDArray[np.int32]
    count: NDArray[np.uint8]  # type: ignore[assignment]  # hides tuple.count, which nobody calls
    is_leaf: NDArray[np.bool_]
    points: NDArray[np.int64]


@nb.njit(nogil=True, cache=True)
def _distance2(a, i, x, y, z):
    dx, dy, dz = a[i, 0] - x, a[i, 1] - y, a[i, 2] - z
    return dx * dx + dy * dy + dz * dz


@nb.njit(nogil=True, cache=True)
def closest_other(tree, queries, best):
    """Lower best (q,) int64 to the squared distance of the closest point *distinct* from each query.

    queries: (q, 3) int64, in the tree's frame. best holds what is known before, FAR for nothing. A point equal
    to its query is passed over, so duplicates are nobody's neighbour (NUMERICS.md case 28). A node is pruned
    when center distance > radius + best distance, all rounded so that nothing closer is lost.
    """
    stack = np.empty(1280, np.int64)  # 80 levels of at most 16 children
    for q in range(queries.shape[0]):
        x, y, z = queries[q, 0], queries[q, 1], queries[q, 2]
        found = best[q]
        limit = ceil_sqrt(found)
        stack[0] = 0
        depth = 1
        while depth > 0:
            depth -= 1
            node = stack[depth]
            bound = tree.radius[node] + limit
            if bound < 1 << 31 and _distance2(tree.center, node, x, y, z) > bound * bound:
                continue
            first, count = tree.first[node], int(tree.count[node])
            if tree.is_leaf[node]:
                for i in range(first, first + count):
                    d2 = _distance2(tree.points, i, x, y, z)
                    if 0 < d2 < found:
                        found = d2
                        limit = ceil_sqrt(found)
                continue
            closest, closest_d2 = -1, FAR
            for child in range(first, first + count):
                d2 = _distance2(tree.center, child, x, y, z)
                if d2 < closest_d2:
                    closest, closest_d2 = child, d2
            # The closest child is looked at first: what it holds prunes most of the others.
            for child in range(first, first + count):
                if child != closest:
                    stack[depth] = child
                    depth += 1
            stack[depth] = closest
            depth += 1
        best[q] = found


@nb.njit(nogil=True, cache=True)
def box_distance2(queries, low, high, out):
    """Write out (q,) int64: squared distance of queries (q, 3) int64 from the box [low, high] (3,)."""
    for q in range(queries.shape[0]):
        total = np.int64(0)
        for k in range(3):
            gap = max(low[k] - queries[q, k], queries[q, k] - high[k], 0)
            total += gap * gap
        out[q] = total
