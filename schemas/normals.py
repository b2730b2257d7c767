"""Surface normals: how far the points reach that one is estimated of. What a normal is, see kernels/normals.py."""

import math
from fractions import Fraction

from .errors import BadRequestError
from .index import MAX_NORMAL_REACH


def normal_reach(reach: float, step: float, points: int) -> int:
    """The greatest square of a distance within `reach` [m], in squared steps; BadRequestError for one that is none.

    Both lengths count as their decimal texts: 800 steps of 0.1 mm are 8 cm.  points: of the largest voxel, whose sums
    must fit 63 bits, also those taken from a place a diameter off and moved (builder/kernels/normals.py).
    """
    if not 0 < reach <= MAX_NORMAL_REACH:
        raise BadRequestError(
            f"normal reach {reach!r}: expected a length above 0, at most {MAX_NORMAL_REACH:g} m"
        )
    square = int((Fraction(repr(float(reach))) / Fraction(repr(step))) ** 2)
    if square * max(points, 1) >= 1 << 59:
        most = 0.995 * math.sqrt((1 << 59) / max(points, 1)) * step
        raise BadRequestError(
            f"normal reach {reach!r} m: of {points} points in a voxel sums do not fit 63 bits: give {most:.3g} at most"
        )
    return square
