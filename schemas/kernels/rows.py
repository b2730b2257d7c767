"""Deltas of the points inside their leaf nodes: along the axis they are sorted by, from one to the next."""

import numba as nb
import numpy as np


@nb.njit(nogil=True, cache=True)
def delta_along(points, first, count, axis):
    """Points (p, 3) uint16 with the sort axis of each run replaced by steps from the point before it.

    first, count, axis: (r,) int64, the runs (leaf nodes); along `axis` a run ascends. Returns a new array.
    """
    deltas = points.copy()
    for run in range(first.shape[0]):
        a, k = first[run], axis[run]
        for i in range(a + 1, a + count[run]):
            deltas[i, k] = points[i, k] - points[i - 1, k]
    return deltas


@nb.njit(nogil=True, cache=True)
def undo_delta_along(points, first, count, axis):
    """Undo `delta_along` in place; sums wrap modulo 2^16. Runs must lie inside points, axis be 0 to 2."""
    for run in range(first.shape[0]):
        a, k = first[run], axis[run]
        total = np.int64(points[a, k])
        for i in range(a + 1, a + count[run]):
            total = (total + np.int64(points[i, k])) & 0xFFFF
            points[i, k] = total
