"""Morton codes: three integers of up to 21 bits interleaved into one uint64, x in the lowest bit.

The bit-spreading constants are the usual ones for 21 bits per axis (Morton 1966; masks derived by
halving the gap between groups at each line).
"""

import numpy as np
from numpy.typing import NDArray

from ..runtime import compiling as nb


def _spread(value):
    """Move bit i of a 21-bit uint64, or of each in an array, to bit 3 i."""
    v = value & np.uint64(0x1FFFFF)
    v = (v | (v << np.uint64(32))) & np.uint64(0x001F00000000FFFF)
    v = (v | (v << np.uint64(16))) & np.uint64(0x001F0000FF0000FF)
    v = (v | (v << np.uint64(8))) & np.uint64(0x100F00F00F00F00F)
    v = (v | (v << np.uint64(4))) & np.uint64(0x10C30C30C30C30C3)
    return (v | (v << np.uint64(2))) & np.uint64(0x1249249249249249)


def _gather(code):
    """Undo `_spread`."""
    v = code & np.uint64(0x1249249249249249)
    v = (v | (v >> np.uint64(2))) & np.uint64(0x10C30C30C30C30C3)
    v = (v | (v >> np.uint64(4))) & np.uint64(0x100F00F00F00F00F)
    v = (v | (v >> np.uint64(8))) & np.uint64(0x001F0000FF0000FF)
    v = (v | (v >> np.uint64(16))) & np.uint64(0x001F00000000FFFF)
    return (v | (v >> np.uint64(32))) & np.uint64(0x1FFFFF)


_spread_one = nb.njit(nogil=True, cache=True)(_spread)
_gather_one = nb.njit(nogil=True, cache=True)(_gather)


@nb.njit(nogil=True, cache=True)
def morton_code(x, y, z):
    """Return the Morton code, uint64, of three uint64 below 2^21."""
    return _spread_one(x) | (_spread_one(y) << np.uint64(1)) | (_spread_one(z) << np.uint64(2))


@nb.njit(nogil=True, cache=True)
def morton_position(code):
    """Return the coordinates x, y, z, uint64, of a Morton code."""
    return _gather_one(code), _gather_one(code >> np.uint64(1)), _gather_one(code >> np.uint64(2))


def morton_encode(coordinates: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """Return the Morton codes (n,) of coordinates (n, 3), each below 2^21."""
    x, y, z = (_spread(coordinates[:, k]) << np.uint64(k) for k in range(3))
    return x | y | z


def morton_decode(codes: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """Return the coordinates (n, 3) of Morton codes (n,)."""
    return np.stack([_gather(codes >> np.uint64(k)) for k in range(3)], axis=1)
