"""The radius class of a point, from where its closest distinct points are; exact over integers."""

import numba as nb
import numpy as np

from ...schemas.radius_model import RIM_BIT
from .neighbours import STACK, closest_distinct

# How many of the closest distinct points are looked at.
NEIGHBOURS = 6
# Set beside the class of a point that has fewer.
FEW = 32


@nb.njit(nogil=True, cache=True)
def _local_class(closest, held, limits2):
    """The least class whose limit holds the last of NEIGHBOURS; the last class where there are fewer."""
    last = limits2.shape[0] - 1
    if held < NEIGHBOURS:
        return last
    c = 0
    while c < last and closest[held - 1, 0] > limits2[c]:
        c += 1
    return c


@nb.njit(nogil=True, cache=True)
def point_classes(points, boxes, starts, rows, limits2, classes):
    """Write the radius classes of some points.

    points, boxes, starts: as `closest_distinct` takes them.  rows: (n,) int32, where in `classes` a point's goes; -1:
    nobody asks.  limits2: (c,) int64, the squared distances of the last neighbour up to which each local class goes,
    ascending; beyond the last none is looked for.  Writes classes (q,) uint8: the local class, RIM_BIT on a rim, FEW
    where there are not enough neighbours.
    """
    closest, stack = np.empty((NEIGHBOURS, 4), np.int64), np.empty((STACK, 2), np.int64)
    for i in range(points.shape[0]):
        if rows[i] < 0:
            continue
        held = closest_distinct(points, boxes, starts, i, limits2[-1], closest, stack)
        found = _local_class(closest, held, limits2)
        if held < NEIGHBOURS:
            found |= FEW
        if held < 3:
            found |= RIM_BIT
        classes[rows[i]] = found
