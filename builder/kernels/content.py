"""A hash of a set of points that no order changes, for the archive's id."""

import numba as nb
import numpy as np


@nb.njit(nogil=True, cache=True)
def _mix(value):
    """The finaliser of MurmurHash3 for 64 bits (Appleby)."""
    value ^= value >> np.uint64(33)
    value *= np.uint64(0xFF51AFD7ED558CCD)
    value ^= value >> np.uint64(33)
    value *= np.uint64(0xC4CEB9FE1A85EC53)
    return value ^ (value >> np.uint64(33))


@nb.njit(nogil=True, cache=True)
def content_sum(columns, seed):
    """Sum modulo 2^64 over points of a hash of their columns (c, n) uint64; seed uint64 tells sums apart."""
    total = np.uint64(0)
    for i in range(columns.shape[1]):
        hashed = seed
        for c in range(columns.shape[0]):
            hashed = _mix(hashed ^ columns[c, i]) + seed
        total += _mix(hashed)
    return total
