"""Radius class of a point, from the positions of its closest distinct points; exact over integers.

The local class depends on the distance of a neighbour, and thus on the density around the point.
The mean of the neighbours indicates a rim of a surface. For n neighbours at random all around the
point, the squared distance of their mean is 1 / n of the mean of their squared distances; in half a
disc it is 0.36 of it, at a right-angled crease 0.18. The largest angle between neighbours, in the
plane through them, finds the same rims but needs an eigenvector.
"""

import numpy as np

from ....schemas.archive.radius_model import LOCAL_CLASSES, RIM_BIT
from ....schemas.runtime import compiling as nb
from .nearest_neighbours import STACK, closest_distinct

# Number of closest distinct points considered.
NEIGHBOURS = 24
# The distance of this neighbour determines the local class. With fewer neighbours neither a class
# nor a rim is determined.
LOCAL_NEIGHBOUR = 12
# A point is on a rim when the squared distance of the neighbours' mean exceeds the mean of their
# squared distances divided by this.
RIM_SHARE = 6
# Flag added to the class of a point with too few neighbours.
TOO_FEW_NEIGHBOURS = 32


@nb.njit(nogil=True, cache=True)
def _local_class(d2, local2):
    """Return the least class whose limit in local2 holds a squared distance, else the last class."""
    c = 0
    while c < local2.shape[0] and d2 > local2[c]:
        c += 1
    return c


@nb.njit(nogil=True, cache=True)
def _is_rim(closest, held):
    """Return whether the mean of closest[:held] lies off the point.

    The criterion is |sum d|^2 / held^2 > sum |d|^2 / held / RIM_SHARE.
    """
    x = y = z = total = np.int64(0)
    for i in range(held):
        total += closest[i, 0]
        x += closest[i, 1]
        y += closest[i, 2]
        z += closest[i, 3]
    return RIM_SHARE * (x * x + y * y + z * z) > held * total


@nb.njit(nogil=True, cache=True)
def point_classes(points, boxes, starts, rows, reach2, local2, classes):
    """Write the radius classes of some points.

    points, boxes, starts: as in `closest_distinct`.
    rows: (n,) int32, the row of `classes` for each point; -1 to skip the point.
    reach2, local2: `ClassLimits` of builder/passes/radius_classes.py.
    Writes classes (q,) uint8: the local class, with RIM_BIT on a rim. A point with too few
    neighbours gets the last class with TOO_FEW_NEIGHBOURS. With steps of at least 1 micrometre all
    sums stay below 2^50.
    """
    closest, stack = np.empty((NEIGHBOURS, 4), np.int64), np.empty((STACK, 2), np.int64)
    for i in range(points.shape[0]):
        if rows[i] < 0:
            continue
        held = closest_distinct(points, boxes, starts, i, reach2, closest, stack)
        if held < LOCAL_NEIGHBOUR:
            classes[rows[i]] = LOCAL_CLASSES - 1 | TOO_FEW_NEIGHBOURS
            continue
        found = _local_class(closest[LOCAL_NEIGHBOUR - 1, 0], local2)
        if _is_rim(closest, held):
            found |= RIM_BIT
        classes[rows[i]] = found
