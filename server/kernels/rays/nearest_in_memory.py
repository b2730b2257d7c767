"""Scan point nearest to one place, where all voxels in reach are resident; for frames of walking.

The definition is that of within_point.py.
"""

import numpy as np

from ....schemas.archive.units import UNITS_PER_METRE
from ....schemas.kernels import compiling as nb
from ..core.array_references import with_flag
from ..core.scene_arrays import MAX_RESIDENT_PATH_VISITS, stopped
from .rays import STACK, ClosestHits
from .stored_normals import find_voxel
from .within_point import search_voxel


@nb.njit(nogil=True, cache=True)
def nearest_in_memory(held, place, reach, stop, rows, found):
    """Find the scan point nearest to a place.

    held: reference to the scene's arrays.  place: (x, y, z), world [m].  reach: at most 16 m.
    stop: (1,) int64, the request's stop flag.  rows: (capacity,) int64, set to the voxels in reach.
    found: (3,) float64, set to the point's centre, world [m].
    Returns the number of rows, -1: not answered; whether a point is in reach; and node visits.
    """
    scene, keys = with_flag(held.scene, stop), held.index.keys
    units, best = np.empty((1, 3), np.int64), ClosestHits(
        np.full(1, np.inf), np.full(1, -1, np.int64), np.zeros((1, 3), np.int64), np.full(1, np.inf),
        np.zeros((3, 1), np.uint32),
    )  # fmt: skip
    low, high = np.empty(3, np.int64), np.empty(3, np.int64)
    for r in range(3):
        away = place[r] - scene.origin[r]
        units[0, r] = np.int64(np.rint(away * UNITS_PER_METRE))
        # A step more on each side exceeds what rounding loses.
        low[r] = (np.int64(np.floor((away - reach) / scene.step)) - 1) // scene.voxel_steps
        high[r] = (np.int64(np.ceil((away + reach) / scene.step)) + 1) // scene.voxel_steps
    limit = np.int64(np.rint(reach * UNITS_PER_METRE))
    limit *= limit
    stack, bounds, order = np.empty(STACK, np.int64), np.empty(STACK), np.empty(STACK)
    count = 0
    for x in range(low[0], high[0] + 1):
        for y in range(low[1], high[1] + 1):
            for z in range(low[2], high[2] + 1):
                steps = scene.voxel_steps
                voxel = find_voxel(keys, steps, x * steps, y * steps, z * steps)
                if voxel < 0:
                    continue
                if count == rows.shape[0] or scene.where[voxel, 0] < 0:
                    return -1, False, 0
                rows[count] = voxel
                count += 1
                limit = search_voxel(
                    scene, voxel, units, 0, 0.0, 0.0, 0.0, MAX_RESIDENT_PATH_VISITS, best, limit, stack, bounds, order
                )  # fmt: skip
    visits = np.int64(best.counts[1, 0])
    if visits >= MAX_RESIDENT_PATH_VISITS or stopped(stop):
        return -1, False, 0
    for r in range(3):
        found[r] = best.lattice[0, r] * scene.step + scene.origin[r]
    return count, best.square[0] >= 0, visits
