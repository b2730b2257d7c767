"""The radius class of a point, from where its closest distinct points are; exact over integers."""

import numba as nb
import numpy as np


@nb.njit(nogil=True, cache=True)
def nearest_of_all(points, limit2, k, best):
    """Write best (n, k) int64: the squared distances of the k closest distinct points, ascending; beyond limit2: -1."""
    for i in range(points.shape[0]):
        held = 0
        for j in range(points.shape[0]):
            d2 = np.int64(0)
            for axis in range(3):
                apart = np.int64(points[i, axis]) - np.int64(points[j, axis])
                d2 += apart * apart
            if d2 == 0 or d2 > limit2 or (held == k and d2 >= best[i, k - 1]):
                continue
            at = min(held, k - 1)
            while at > 0 and best[i, at - 1] > d2:
                best[i, at] = best[i, at - 1]
                at -= 1
            best[i, at] = d2
            held = min(held + 1, k)
        for j in range(held, k):
            best[i, j] = -1
