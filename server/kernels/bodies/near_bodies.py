"""Bodies that a motion could meet.

Their boxes are compared one by one: there are some hundred users.
"""

import numpy as np

from ....schemas.archive.units import UNITS_PER_METRE
from ....schemas.kernels import compiling as nb
from ..motion.screw_motion import make_motion


@nb.njit(nogil=True, cache=True)
def bound_body(box, pose, origin, more, bounds):
    """Write the bounds (2, 3) of a body's placed box, grown by `more` on all sides.

    box: (2, 3), avatar frame.  bounds: relative to the origin [m].
    """
    for r in range(3):
        middle, half, size = pose[r, 3] - origin[r], 0.0, abs(pose[r, 3]) + abs(origin[r])
        for c in range(3):
            middle += pose[r, c] * (0.5 * (box[0, c] + box[1, c]))
            half += abs(pose[r, c]) * (0.5 * (box[1, c] - box[0, c]))
            size += abs(pose[r, c]) * (abs(box[0, c]) + abs(box[1, c]))
        half += more + 2.0 / UNITS_PER_METRE + size * 2.0**-48
        bounds[0, r], bounds[1, r] = middle - half, middle + half


@nb.njit(nogil=True, cache=True)
def find_near_bodies(box, first, last, more, bounds, kinds, wanted, skip, rows):
    """Write the bodies whose bounds meet those of a motion, ascending, to rows (n,) int64.

    Returns how many.
    box: (2, 3) of the moving avatar.  first, last: (4, 4), translations relative to the origin.
    more: its radius plus the margin [m].  bounds: (n, 2, 3), see `bound_body`.  kinds: (n,) uint8,
    one bit each.  wanted: the bits of the kinds to find.  skip: a row to omit.
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
