"""Screw motions: the pose at a fraction of the way between two poses, and its speed and curvature.

Definition: R0, R1 are the upper left 3x3 of the two poses (rotations within 1e-9), p0, p1 their
translations, and E(a) is the rotation by `a` about the axis u of the shorter rotation that takes R0
to R1, by the angle A. The translation p1 - p0 = along + across, with `along` parallel to u. Then

    R(t) = E(t A) (R0 + t F)
    p(t) = p0 + t along + sin(t A/2) / sin(A/2) E(-(1 - t) A/2) across

where F = E(-A) R1 - R0 is the difference that rounding leaves between the two poses.

This is M(t) = exp(t log(M1 M0^-1)) M0 for exact poses, written so that nothing cancels as A
approaches 0 (then the ratio of the sines is t) or pi. M(0) and M(1) are the given bits. A rotation
by pi is about the axis whose first non-zero component is positive; within rounding of pi, the sign
of the quaternion computed here decides.

All arithmetic is float64 in one fixed order, with +, -, *, / and square roots only; sine and cosine
are computed by their series. The bits are therefore the same on every machine, compiled and
interpreted. No library's sine guarantees that.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ....schemas.runtime import compiling as nb
from ..core.kernel_decorators import njit_no_refcount
from .vector_tuples import Vector, column, cross, divided, dot, minus, norm, place_of, plus, rotate, times

# Coefficients of sin(x) / x and cos(x), by powers of x^2, highest first. Up to pi/2, the omitted
# terms are below 2^-58.
_SINE = tuple((-1.0) ** n / math.factorial(2 * n + 1) for n in range(10, -1, -1))
_COSINE = tuple((-1.0) ** n / math.factorial(2 * n) for n in range(11, -1, -1))

# A rotation whose half angle has a smaller sine moves nothing within 1e9 m by a unit; its squares
# could be denormal.
_NO_TURN = 1e-30


class ScrewMotion(NamedTuple):
    """One motion.

    first, last: (4, 4) poses.  axis: unit u.  half: A / 2, in [0, pi/2].  sine: sin(A / 2).
    along, across: parts of the translation [m].  strain: columns of F.
    The rates hold for every avatar point on the whole way of the ideal motion, per unit of t:
    speed: upper bound of the speed [m].  bend: upper bound of |second derivative| [m].
    slip: upper bound of the distance of a computed placed point from the ideal motion [m].
    """

    first: NDArray[np.float64]
    last: NDArray[np.float64]
    axis: Vector
    half: float
    sine: float
    along: Vector
    across: Vector
    strain: tuple[Vector, Vector, Vector]
    speed: float
    bend: float
    slip: float


@njit_no_refcount
def sine_cosine(x):
    """Return sin(x) and cos(x) for 0 <= x <= pi/2.

    The error is within a few half units in the last place; the result is the same on every machine.
    """
    square = x * x
    s, c = 0.0, 0.0
    for k in _SINE:
        s = s * square + k
    for k in _COSINE:
        c = c * square + k
    return s * x, c


@njit_no_refcount
def angle_of(s, c):
    """Return the angle in [0, pi/2] with the given sine and cosine; s^2 + c^2 is 1 to rounding.

    Each step reduces an error e to about e^3 / 6; the first guess is within 0.08.
    """
    x = s if s <= c else 0.5 * math.pi - c
    for _ in range(3):
        guess_s, guess_c = sine_cosine(min(max(x, 0.0), 0.5 * math.pi))
        x += s * guess_c - c * guess_s
    return min(max(x, 0.0), 0.5 * math.pi)


@njit_no_refcount
def _turn(axis, s, c, v):
    """Return v rotated about `axis` by the angle whose HALF has sine s and cosine c."""
    once = cross(axis, v)
    return plus(v, plus(times(2.0 * s * c, once), times(2.0 * s * s, cross(axis, once))))


@njit_no_refcount
def _turn_back(axis, s, c, v):
    """Return v, perpendicular to the axis, rotated back by the angle of sine s, cosine c."""
    return minus(times(c, v), times(s, cross(axis, v)))


@nb.njit(nogil=True, cache=True)
def _quaternion(first, last):
    """Return the unit quaternion w, x, y, z, w >= 0, of the rotation between two poses' axes."""
    turn = np.empty((3, 3))
    square0, square1 = 0.0, 0.0
    for r in range(3):
        for c in range(3):
            square0 += first[r, c] * first[r, c]
            square1 += last[r, c] * last[r, c]
            turn[r, c] = last[r, 0] * first[c, 0] + last[r, 1] * first[c, 1] + last[r, 2] * first[c, 2]
    size = math.sqrt(square0 / 3.0 * (square1 / 3.0))
    for r in range(3):
        for c in range(3):
            turn[r, c] /= size
    # Beginning with the largest of the four: no difference of nearly equal numbers is a divisor.
    a, b, c = turn[0, 0], turn[1, 1], turn[2, 2]
    if a + b + c >= max(a, b, c):
        w, x, y, z = 1 + a + b + c, turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]
    elif a >= b and a >= c:
        w, x, y, z = turn[2, 1] - turn[1, 2], 1 + a - b - c, turn[0, 1] + turn[1, 0], turn[2, 0] + turn[0, 2]
    elif b >= c:
        w, x, y, z = turn[0, 2] - turn[2, 0], turn[0, 1] + turn[1, 0], 1 + b - a - c, turn[1, 2] + turn[2, 1]
    else:
        w, x, y, z = turn[1, 0] - turn[0, 1], turn[2, 0] + turn[0, 2], turn[1, 2] + turn[2, 1], 1 + c - a - b
    size = math.sqrt(w * w + x * x + y * y + z * z)
    lead = w if w != 0.0 else (x if x != 0.0 else (y if y != 0.0 else z))
    if lead < 0.0:
        size = -size
    return w / size, x / size, y / size, z / size


@nb.njit(nogil=True, cache=True)
def make_motion(first, last, box, origin):
    """Compute the screw motion between two checked poses (4, 4).

    box: (2, 3), least and greatest coordinates of the avatar's points [m].  origin: (3,) of the
    dataset, world [m].

    Speed and bend are convex functions of the point's position; their maximum over the box is
    therefore at a corner. The motion rotates velocity and acceleration with it; their values at its
    beginning, apart from F, therefore hold for all of it.
    slip: entries of E(t A) and p(t) - p0 are off by some 30 half units in the last place of s and
    |p1 - p0|; placing and shifting add 4 of the largest term (measured by
    tests/unit/server/kernels/motion/test_screw_motion.py). The stated bound is twice that.
    """
    w, x, y, z = _quaternion(first, last)
    sine, axis, half = norm((x, y, z)), (1.0, 0.0, 0.0), 0.0
    if sine < _NO_TURN:
        sine = 0.0
    else:
        axis, half = divided((x, y, z), sine), angle_of(sine, w)
    sine, cosine = sine_cosine(half)
    way = minus(place_of(last), place_of(first))
    along = times(0.0 + dot(axis, way), axis)  # never times a negative zero
    across = minus(way, along)
    moved = abs(way[0]) + abs(way[1]) + abs(way[2])
    strain = (
        _strain(axis, sine, cosine, first, last, 0),
        _strain(axis, sine, cosine, first, last, 1),
        _strain(axis, sine, cosine, first, last, 2),
    )
    uneven = 0.0
    for c in range(3):
        for r in range(3):
            uneven += strain[c][r] * strain[c][r]
    uneven = math.sqrt(uneven)
    # p'(0) = along + (A / 2 sin(A/2)) E(-A/2) across, and p''(0) = A u x p'(0).
    rate = 1.0 if sine == 0.0 else half / sine
    begin = plus(along, times(rate, _turn_back(axis, sine, cosine, across)))
    speed, bend, far = 0.0, 0.0, 0.0
    angle = 2.0 * half
    for corner in range(8):
        at = box[corner & 1, 0], box[corner >> 1 & 1, 1], box[corner >> 2, 2]
        velocity = plus(begin, times(angle, cross(axis, rotate(first, at))))
        speed = max(speed, norm(velocity))
        bend = max(bend, angle * norm(cross(axis, velocity)))
        far = max(far, abs(at[0]) + abs(at[1]) + abs(at[2]))
    largest, place = 0.0, 0.0
    for r in range(3):
        for c in range(3):
            largest = max(largest, abs(first[r, c]), abs(last[r, c]))
        place = max(place, abs(first[r, 3]) + abs(last[r, 3]) + abs(origin[r]))
    # Rounding of these rates themselves, relative to the terms of their sums, which may cancel.
    loose = 2.0**-47 * (moved + angle * largest * far)
    speed = speed * (1.0 + 1e-12) + loose + (angle + 1.0) * uneven * far
    bend = bend * (1.0 + 1e-12) + angle * loose + (angle * angle + 2.0 * angle) * uneven * far
    slip = 2.0**-47 * (moved + largest * far) + 2.0**-50 * place
    return ScrewMotion(first, last, axis, half, sine, along, across, strain, speed, bend, slip)


@njit_no_refcount
def _strain(axis, sine, cosine, first, last, c):
    """Return a column of F."""
    return minus(_turn(axis, -sine, cosine, column(last, c)), column(first, c))


@njit_no_refcount
def pose_at(motion, t, pose):
    """Write M(t), the pose at fraction t in [0, 1], into pose (4, 4), by the definition."""
    if t <= 0.0 or t >= 1.0:
        given = motion.first if t <= 0.0 else motion.last
        for r in range(4):
            for c in range(4):
                pose[r, c] = given[r, c]
        return
    first, axis = motion.first, motion.axis
    s, c = sine_cosine(t * motion.half)
    for k in range(3):
        strained = plus(column(first, k), times(t, motion.strain[k]))
        pose[0, k], pose[1, k], pose[2, k] = _turn(axis, s, c, strained)
    ratio = t if motion.sine == 0.0 else s / motion.sine
    back_s, back_c = sine_cosine((1.0 - t) * motion.half)
    turned = _turn_back(axis, back_s, back_c, motion.across)
    way = plus(times(t, motion.along), times(ratio, turned))
    for r in range(3):
        pose[r, 3] = first[r, 3] + way[r]
        pose[3, r] = 0.0
    pose[3, 3] = 1.0
