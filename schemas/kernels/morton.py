"""Morton codes: three integers of up to 21 bits interleaved into one uint64, x in the lowest bit.

The bit-spreading constants are the usual ones for 21 bits per axis (Morton 1966; masks derived by
halving the gap between groups at each line).
"""

import numpy as np

from . import compiling as nb


@nb.njit(nogil=True, cache=True)
def _spread(value):
    """Move bit i of a 21-bit uint64 to bit 3 i."""
    v = value & np.uint64(0x1FFFFF)
    v = (v | (v << np.uint64(32))) & np.uint64(0x001F00000000FFFF)
    v = (v | (v << np.uint64(16))) & np.uint64(0x001F0000FF0000FF)
    v = (v | (v << np.uint64(8))) & np.uint64(0x100F00F00F00F00F)
    v = (v | (v << np.uint64(4))) & np.uint64(0x10C30C30C30C30C3)
    return (v | (v << np.uint64(2))) & np.uint64(0x1249249249249249)


@nb.njit(nogil=True, cache=True)
def _gather(code):
    """Undo `_spread`."""
    v = code & np.uint64(0x1249249249249249)
    v = (v | (v >> np.uint64(2))) & np.uint64(0x10C30C30C30C30C3)
    v = (v | (v >> np.uint64(4))) & np.uint64(0x100F00F00F00F00F)
    v = (v | (v >> np.uint64(8))) & np.uint64(0x001F0000FF0000FF)
    v = (v | (v >> np.uint64(16))) & np.uint64(0x001F00000000FFFF)
    return (v | (v >> np.uint64(32))) & np.uint64(0x1FFFFF)


@nb.njit(nogil=True, cache=True)
def morton_code(x, y, z):
    """Return the Morton code, uint64, of three uint64 below 2^21."""
    return _spread(x) | (_spread(y) << np.uint64(1)) | (_spread(z) << np.uint64(2))


@nb.njit(nogil=True, cache=True)
def morton_encode(coordinates):
    """Return the Morton codes (n,) uint64 of coordinates (n, 3) uint64, each below 2^21."""
    n = coordinates.shape[0]
    codes = np.empty(n, np.uint64)
    for i in range(n):
        codes[i] = morton_code(coordinates[i, 0], coordinates[i, 1], coordinates[i, 2])
    return codes


@nb.njit(nogil=True, cache=True)
def morton_decode(codes):
    """Return the coordinates (n, 3) uint64 of Morton codes (n,) uint64."""
    n = codes.shape[0]
    coordinates = np.empty((n, 3), np.uint64)
    for i in range(n):
        coordinates[i, 0] = _gather(codes[i])
        coordinates[i, 1] = _gather(codes[i] >> np.uint64(1))
        coordinates[i, 2] = _gather(codes[i] >> np.uint64(2))
    return coordinates
