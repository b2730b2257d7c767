"""Scan point nearest to one place, where all voxels in reach are resident; for frames of walking.

The definition is that of within_point.py.
"""

import numpy as np

from ....schemas.archive.units import UNITS_PER_METRE
from ....schemas.kernels import compiling as nb
from ..core.array_references import with_flag
from ..core.reach import REACH_STACK, all_resident, list_item
from ..core.scene_arrays import stopped
from .rays import STACK, ClosestHits
from .within_point import search_voxel


@nb.njit(nogil=True, cache=True)
def nearest_in_memory(held, place, reach, stop, found):
    """Find the scan point nearest to a place.

    held: reference to the scene's arrays.  place: (x, y, z), world [m].  reach: at most 16 m.
    stop: (1,) int64, the request's stop flag.  found: (3,) float64, set to the point's centre, world
    [m]. Writes held.one, the voxels in reach.
    Returns the number of rows, -1: not answered; whether a point is in reach; and node visits.
    """
    scene = with_flag(held.scene, stop)
    units, best = np.empty((1, 3), np.int64), ClosestHits(
        np.full(1, np.inf), np.full(1, -1, np.int64), np.zeros((1, 3), np.int64), np.full(1, np.inf),
        np.zeros((3, 1), np.uint32),
    )  # fmt: skip
    center, lists = np.empty(3), held.one.reach.lists
    for r in range(3):
        away = place[r] - scene.origin[r]
        units[0, r] = np.int64(np.rint(away * UNITS_PER_METRE))
        center[r] = away / scene.step
    limit = np.int64(np.rint(reach * UNITS_PER_METRE))
    limit *= limit
    stack, bounds, order = np.empty(STACK, np.int64), np.empty(STACK), np.empty(STACK)
    # A step more exceeds what rounding loses.
    span = reach / scene.step + 1.0
    count = list_item(
        held.tree, center, center, span, 0.0, stop, np.empty(REACH_STACK, np.int64), lists.rows, lists.near, 0
    )
    if not all_resident(scene.where, lists.rows, count):
        return -1, False, 0
    for voxel in lists.rows[:count]:
        limit = search_voxel(scene, voxel, units, 0, 0.0, best, limit, stack, bounds, order)
    visits = np.int64(best.counts[1, 0])
    if stopped(stop):
        return -1, False, 0
    for r in range(3):
        found[r] = best.lattice[0, r] * scene.step + scene.origin[r]
    return count, best.square[0] >= 0, visits
