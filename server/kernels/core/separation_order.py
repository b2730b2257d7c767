"""Exact comparison of two pairs of spheres by their separation, sqrt(D) - R (NUMERICS.md N5).

D is the squared distance of the centres and R the sum of the radii, both integers in exact units;
most separations are therefore irrational. Where all radii are the same, the squares alone decide.
Where they differ, float64 nearly always decides. Where it cannot, the roots are eliminated by
squaring and integers of 128 bits are compared.
"""

import math

import numpy as np

from .kernel_decorators import njit_no_refcount

# Two separations whose float64 values differ by more than this are in that order. Squares are below
# 2^62, so a root is off by at most half of 2^-22 for its rounding and 2^-54 of itself for that of
# the square: 2.3e-7. Two of them and a sum stay below 6e-7. The last difference is exact where it
# is small.
CERTAIN = 2.0**-19
_LOW = np.uint64(0xFFFFFFFF)
_HALF = np.uint64(32)


@njit_no_refcount
def _product(a, b):
    """Return the product of two uint64 as its high and low 64 bits."""
    a_high, a_low, b_high, b_low = a >> _HALF, a & _LOW, b >> _HALF, b & _LOW
    # None of these exceeds 64 bits: (2^32 - 1)^2 + 2 (2^32 - 1) = 2^64 - 1.
    low = a_low * b_low
    middle = a_high * b_low + (low >> _HALF)
    other = a_low * b_high + (middle & _LOW)
    return a_high * b_high + (middle >> _HALF) + (other >> _HALF), ((other & _LOW) << _HALF) | (low & _LOW)


@njit_no_refcount
def _compare_roots(square, other, radius_difference):
    """Return the sign of sqrt(square) - (sqrt(other) + d), int64, with d = radius_difference >= 0.

    The two sides differ by at most 1. Squaring both leaves the sign of s - 2 d sqrt(other), with
    s = square - other - d^2. If s is not negative, both sides are squared again. All terms fit,
    because d is at most slightly larger than the root of `square`.
    """
    s = square - other - radius_difference * radius_difference
    if s < 0:
        return -1
    size, twice = np.uint64(s), np.uint64(2 * radius_difference)
    high, low = _product(size, size)
    other_high, other_low = _product(twice * twice, np.uint64(other))
    if high != other_high:
        return -1 if high < other_high else 1
    if low != other_low:
        return -1 if low < other_low else 1
    return 0


@njit_no_refcount
def compare_separations(square, radius, other_square, other_radius):
    """Compare the separations sqrt(square) - radius of two pairs exactly.

    Returns -1, 0 or 1: the first separation is less than, equal to or greater than the other.
    square, other_square: int64, 0 to 3 * 2^60, from `pair_square`.  radius, other_radius: int64,
    -2^31 to 2^31, exact units. Terms common to both radii may be omitted: `-deficit` serves as well
    as the radius.
    """
    radius_difference = radius - other_radius
    apart = (math.sqrt(np.float64(square)) - math.sqrt(np.float64(other_square))) - np.float64(
        radius_difference
    )
    if apart < -CERTAIN:
        return -1
    if apart > CERTAIN:
        return 1
    if radius_difference >= 0:
        return _compare_roots(square, other_square, radius_difference)
    return -_compare_roots(other_square, square, -radius_difference)
