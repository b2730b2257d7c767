"""Scan point nearest to one place, where all voxels in reach are resident; for frames of walking.

The definition is that of within_point.py.
"""

import numpy as np

from ....schemas.archive.units import UNITS_PER_METRE
from ....schemas.kernels import compiling as nb
from ..core.array_references import with_flag
from ..core.scene_arrays import stopped
from .near_points import voxels_in_box
from .rays import STACK, ClosestHits
from .within_point import search_voxel


@nb.njit(nogil=True, cache=True)
def nearest_in_memory(held, place, reach, stop, rows, found):
    """Find the scan point nearest to a place.

    held: reference to the scene's arrays.  place: (x, y, z), world [m].  reach: at most 16 m.
    stop: (1,) int64, the request's stop flag.  rows: (capacity,) int64, set to the voxels in reach.
    found: (3,) float64, set to the point's centre, world [m].
    Returns the number of rows, -1: not answered; whether a point is in reach; and node visits.
    """
    scene = with_flag(held.scene, stop)
    units, best = np.empty((1, 3), np.int64), ClosestHits(
        np.full(1, np.inf), np.full(1, -1, np.int64), np.zeros((1, 3), np.int64), np.full(1, np.inf),
        np.zeros((3, 1), np.uint32),
    )  # fmt: skip
    low, high = np.empty(3, np.int64), np.empty(3, np.int64)
    for r in range(3):
        away = place[r] - scene.origin[r]
        units[0, r] = np.int64(np.rint(away * UNITS_PER_METRE))
        # A step more on each side exceeds what rounding loses.
        low[r] = np.int64(np.floor((away - reach) / scene.step)) - 1
        high[r] = np.int64(np.ceil((away + reach) / scene.step)) + 1
    limit = np.int64(np.rint(reach * UNITS_PER_METRE))
    limit *= limit
    stack, bounds, order = np.empty(STACK, np.int64), np.empty(STACK), np.empty(STACK)
    count = voxels_in_box(held, low, high, rows)
    if count > rows.shape[0]:
        return -1, False, 0
    for voxel in rows[:count]:
        if scene.where[voxel, 0] < 0:
            return -1, False, 0
        limit = search_voxel(scene, voxel, units, 0, 0.0, 0.0, 0.0, best, limit, stack, bounds, order)
    visits = np.int64(best.counts[1, 0])
    if stopped(stop):
        return -1, False, 0
    for r in range(3):
        found[r] = best.lattice[0, r] * scene.step + scene.origin[r]
    return count, best.square[0] >= 0, visits
