"""Which of two pairs of spheres is closer: the gap between them, sqrt(D) - R, compared exactly (NUMERICS.md N5).

D is the square of the distance of the centres and R the sum of the radii, integers of exact units, so gaps are as a
rule no numbers that a machine holds. Where all radii are the same the squares alone tell; where they are not, float64
tells nearly always, and where it does not, the roots are squared away and integers of 128 bits are compared.
"""

import math

import numpy as np

from .compiled import borrowing

# Two gaps that float64 finds farther apart than this are in that order. Squares are below 2^62, so a root is off by at
# most half of 2^-22 in rounding and 2^-54 of itself for the square's: 2.3e-7; two of them and a sum: below 6e-7. The
# last difference is exact where it is small.
CERTAIN = 2.0**-19
_LOW = np.uint64(0xFFFFFFFF)
_HALF = np.uint64(32)


@borrowing
def _product(a, b):
    """The product of two uint64 as its high and low 64 bits."""
    a_high, a_low, b_high, b_low = a >> _HALF, a & _LOW, b >> _HALF, b & _LOW
    # None of these exceeds 64 bits: (2^32 - 1)^2 + 2 (2^32 - 1) = 2^64 - 1.
    low = a_low * b_low
    middle = a_high * b_low + (low >> _HALF)
    other = a_low * b_high + (middle & _LOW)
    return a_high * b_high + (middle >> _HALF) + (other >> _HALF), ((other & _LOW) << _HALF) | (low & _LOW)


@borrowing
def _compare_roots(square, other, more):
    """The sign of sqrt(square) - (sqrt(other) + more), for more >= 0, the difference within 1; int64.

    Both sides squared: of s - 2 more sqrt(other), with s = square - other - more^2; where s is not negative, squared
    again. All of it fits, for `more` is no larger than the root of `square` and a little.
    """
    s = square - other - more * more
    if s < 0:
        return -1
    size, twice = np.uint64(s), np.uint64(2 * more)
    high, low = _product(size, size)
    other_high, other_low = _product(twice * twice, np.uint64(other))
    if high != other_high:
        return -1 if high < other_high else 1
    if low != other_low:
        return -1 if low < other_low else 1
    return 0


@borrowing
def compare_gaps(square, radius, other_square, other_radius):
    """-1, 0 or 1: the gap sqrt(square) - radius is less than, equal to or greater than the other; exactly.

    square, other_square: int64, 0 to 3 * 2^60, as `pair_square` has them.  radius, other_radius: int64, -2^31 to 2^31,
    exact units; may leave out what is the same in both, so `-drop` is as good as the radius.
    """
    more = radius - other_radius
    apart = (math.sqrt(np.float64(square)) - math.sqrt(np.float64(other_square))) - np.float64(more)
    if apart < -CERTAIN:
        return -1
    if apart > CERTAIN:
        return 1
    if more >= 0:
        return _compare_roots(square, other_square, more)
    return -_compare_roots(other_square, square, -more)
