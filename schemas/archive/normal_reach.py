"""Reach within which points contribute to a surface normal. kernels/normal_codes.py defines it."""

import math
from fractions import Fraction

from ..errors import BadRequestError

# Default distance within which points contribute to a point's normal [m]: some forty points of a
# scanned façade, on an area no larger than a hand.
NORMAL_REACH = 0.08
# Largest reach [m]. Points farther apart do not belong to one surface. At steps of 0.1 mm, sums fit
# 63 bits for any voxel (`squared_reach`).
MAX_NORMAL_REACH = 1.0


def squared_reach(reach: float, step: float, points: int) -> int:
    """Return the greatest squared distance within `reach` [m], in squared steps.

    Both lengths are taken as the decimal numbers that they print as, so 800 steps of 0.1 mm are
    exactly 8 cm.
    points: number of points in the largest voxel, whose sums must fit 63 bits, also when they are
    taken about a place one diameter away and shifted
    (builder/kernels/neighbours/estimate_normals.py). Raises BadRequestError for an invalid reach.
    """
    if not 0 < reach <= MAX_NORMAL_REACH:
        raise BadRequestError(
            f"normal reach {reach!r}: expected a length above 0, at most {MAX_NORMAL_REACH:g} m"
        )
    square = int((Fraction(repr(float(reach))) / Fraction(repr(step))) ** 2)
    if square * max(points, 1) >= 1 << 59:
        most = 0.995 * math.sqrt((1 << 59) / max(points, 1)) * step
        raise BadRequestError(
            f"normal reach {reach!r} m: sums over {points} points in a voxel exceed 63 bits: give at most {most:.3g}"
        )
    return square
