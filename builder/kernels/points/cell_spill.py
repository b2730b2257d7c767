"""Reordering of a voxel's points (3, n): a cell's x, y and z become contiguous, one read gets a cell."""

import numpy as np

from ....schemas.kernels import compiling as nb


@nb.njit(nogil=True, cache=True)
def by_cell(xyz, starts):
    """Return points (3, n) uint16 in cell order as (3 n,): x[], y[], z[] of each cell.

    starts: (c + 1,), where the cells begin.
    """
    flat = np.empty(3 * xyz.shape[1], np.uint16)
    for cell in range(starts.shape[0] - 1):
        lo, held = np.uint64(starts[cell]), np.uint64(starts[cell + 1] - starts[cell])
        for k in range(np.uint64(3)):
            to = np.uint64(3) * lo + k * held
            for i in range(held):
                flat[to + i] = xyz[k, lo + i]
    return flat


@nb.njit(nogil=True, cache=True)
def by_axis(flat, starts):
    """Undo `by_cell`."""
    xyz = np.empty((3, flat.shape[0] // 3), np.uint16)
    for cell in range(starts.shape[0] - 1):
        lo, held = np.uint64(starts[cell]), np.uint64(starts[cell + 1] - starts[cell])
        for k in range(np.uint64(3)):
            at = np.uint64(3) * lo + k * held
            for i in range(held):
                xyz[k, lo + i] = flat[at + i]
    return xyz
