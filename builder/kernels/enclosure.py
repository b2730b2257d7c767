"""Does every bound enclose the points below it? The check behind `solidcloud validate --deep`."""

import numba as nb
import numpy as np


@nb.njit(nogil=True, cache=True)
def first_loose_node(center, radius, normal, slab, first, count, is_leaf, order, points):
    """The first node, in `order`, whose sphere or slab does not enclose all points below it; -1 when all do.

    center (n, 3), radius (n,), normal (n, 3), slab (n, 2): int64, one frame [steps].  order: (n,) int64, children
    before parents.  points: (p, 3) int64. The points below a node are one run, as children are contiguous.
    """
    n = center.shape[0]
    begin, end = np.empty(n, np.int64), np.empty(n, np.int64)
    for at in range(n):
        node = order[at]
        a, held = np.int64(first[node]), np.int64(count[node])
        if is_leaf[node]:
            begin[node], end[node] = a, a + held
        else:
            begin[node], end[node] = begin[a], end[a + held - 1]
        flat = normal[node, 0] == 0 and normal[node, 1] == 0 and normal[node, 2] == 0
        for i in range(begin[node], end[node]):
            dx, dy, dz = (
                points[i, 0] - center[node, 0],
                points[i, 1] - center[node, 1],
                points[i, 2] - center[node, 2],
            )
            if dx * dx + dy * dy + dz * dz > radius[node] * radius[node]:
                return node
            along = normal[node, 0] * dx + normal[node, 1] * dy + normal[node, 2] * dz
            if not flat and (along < slab[node, 0] or along > slab[node, 1]):
                return node
    return -1
