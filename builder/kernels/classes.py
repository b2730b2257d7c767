"""The radius class of a point, from where its closest distinct points are; exact over integers.

The local class follows the distance of a neighbour, so the density around. A rim of a surface is told by where the mean
of the neighbours lies. All around the point, n of them in no order have their mean at a squared distance of 1 / n of
theirs in the mean; in half a disc at 0.36 of it, about a right-angled crease at 0.18. The largest angle between
neighbours, in the plane through them, finds the same rims, but takes an eigenvector.
"""

import numpy as np

from ...schemas.kernels import compiling as nb
from ...schemas.radius_model import LOCAL_CLASSES, RIM_BIT
from .neighbours import STACK, closest_distinct

# How many of the closest distinct points are looked at.
NEIGHBOURS = 24
# The local class goes by the distance of this one, and no class and no rim is told by fewer.
LOCAL_NEIGHBOUR = 12
# On a rim the squared distance of the mean of the neighbours is more than the mean of theirs over this.
RIM_SHARE = 6
# Set beside the class of a point that has too few neighbours.
FEW = 32


@nb.njit(nogil=True, cache=True)
def _local_class(d2, local2):
    """The least class whose limit in local2 holds a squared distance; the last class where none does."""
    c = 0
    while c < local2.shape[0] and d2 > local2[c]:
        c += 1
    return c


@nb.njit(nogil=True, cache=True)
def _is_rim(closest, held):
    """Whether the mean of closest[:held] lies off the point: |sum d|^2 / held^2 > sum |d|^2 / held / RIM_SHARE."""
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

    points, boxes, starts: as `closest_distinct` takes them.  rows: (n,) int32, where in `classes` a point's goes; -1:
    nobody asks.  reach2, local2: `Limits` of builder/classes.py.  Writes classes (q,) uint8: the local class, RIM_BIT
    on a rim, FEW where there are too few neighbours. With steps of at least 1 micrometre all sums stay below 2^50.
    """
    closest, stack = np.empty((NEIGHBOURS, 4), np.int64), np.empty((STACK, 2), np.int64)
    for i in range(points.shape[0]):
        if rows[i] < 0:
            continue
        held = closest_distinct(points, boxes, starts, i, reach2, closest, stack)
        if held < LOCAL_NEIGHBOUR:
            classes[rows[i]] = LOCAL_CLASSES - 1 | FEW
            continue
        found = _local_class(closest[LOCAL_NEIGHBOUR - 1, 0], local2)
        if _is_rim(closest, held):
            found |= RIM_BIT
        classes[rows[i]] = found
