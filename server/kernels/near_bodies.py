"""Which of some bodies could a motion meet at all? Their boxes are compared one by one: users are some hundreds."""

import numpy as np

from ...schemas.kernels import compiling as nb
from ...schemas.voxel_grid import UNITS_PER_METRE
from .motion import make_motion


@nb.njit(nogil=True, cache=True)
def bound_body(box, pose, origin, more, bounds):
    """Write bounds (2, 3), from the origin [m], of a body's box (2, 3), avatar frame, placed; `more` on all sides."""
    for r in range(3):
        middle, half, size = pose[r, 3] - origin[r], 0.0, abs(pose[r, 3]) + abs(origin[r])
        for c in range(3):
            middle += pose[r, c] * (0.5 * (box[0, c] + box[1, c]))
            half += abs(pose[r, c]) * (0.5 * (box[1, c] - box[0, c]))
            size += abs(pose[r, c]) * (abs(box[0, c]) + abs(box[1, c]))
        half += more + 2.0 / UNITS_PER_METRE + size * 2.0**-48
        bounds[0, r], bounds[1, r] = middle - half, middle + half


@nb.njit(nogil=True, cache=True)
def find_near(box, first, last, more, bounds, kinds, wanted, skip, rows):
    """Bodies whose bounds meet those of a motion, ascending into rows (n,) int64; returns how many.

    box: (2, 3) of the moving avatar.  first, last: (4, 4), translations from the origin.  more: its radius and the
    margin [m].  bounds: (n, 2, 3), see `bound_body`.  kinds: (n,) uint8, one bit each; wanted: bits.  skip: a row.
    """
    origin = np.zeros(3)
    begin, end = np.empty((2, 3)), np.empty((2, 3))
    stray = make_motion(first, last, box, origin).bend / 8.0
    bound_body(box, first, origin, more + stray, begin)
    bound_body(box, last, origin, more + stray, end)
    count = 0
    for i in range(bounds.shape[0]):
        if i == skip or not kinds[i] & wanted:
            continue
        apart = False
        for r in range(3):
            apart |= min(begin[0, r], end[0, r]) > bounds[i, 1, r]
            apart |= max(begin[1, r], end[1, r]) < bounds[i, 0, r]
        if not apart:
            rows[count] = i
            count += 1
    return count
