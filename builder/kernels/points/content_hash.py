"""Order-independent hash of a set of points, for the archive's id."""

import numpy as np

from ....schemas.runtime import compiling as nb

# Points hashed at a time, column by column: the working set stays in the L1 cache, and the compiler
# vectorises the loops: 0.5 ns a point of three columns, against 16 ns point by point (one core with
# AVX-512).
CHUNK = 512


# Seeds of two independent sums of the same points. The sum of the first seed over lattice
# coordinates alone also verifies that the records hold the points of the scans.
SEEDS = np.array([0x9E3779B97F4A7C15, 0xD1B54A32D192ED03], np.uint64)


@nb.njit(nogil=True, cache=True)
def mix(value):
    """Return the 64-bit finaliser of MurmurHash3 (Appleby) of a value."""
    value ^= value >> np.uint64(33)
    value *= np.uint64(0xFF51AFD7ED558CCD)
    value ^= value >> np.uint64(33)
    value *= np.uint64(0xC4CEB9FE1A85EC53)
    return value ^ (value >> np.uint64(33))


@nb.njit(nogil=True, cache=True)
def mix_column(hashed, column, seed):
    """Mix one more column (n,) into the hashes (n,)."""
    for i in range(column.shape[0]):
        hashed[i] = mix(hashed[i] ^ column[i]) + seed


@nb.njit(nogil=True, cache=True)
def mixed_sum(hashed):
    """Return the sum modulo 2^64 of the finalised hashes."""
    total = np.uint64(0)
    for i in range(hashed.shape[0]):
        total += mix(hashed[i])
    return total


@nb.njit(nogil=True, cache=True)
def content_sum(columns, seed):
    """Return the sum modulo 2^64 over points of a hash of their columns (c, n) uint64.

    seed: uint64, makes the sums of different seeds independent.
    """
    total = np.uint64(0)
    scratch = np.empty(CHUNK, np.uint64)
    for begin in range(0, columns.shape[1], CHUNK):
        end = min(begin + CHUNK, columns.shape[1])
        hashed = scratch[: end - begin]
        hashed[:] = seed
        for c in range(columns.shape[0]):
            mix_column(hashed, columns[c, begin:end], seed)
        total += mixed_sum(hashed)
    return total
