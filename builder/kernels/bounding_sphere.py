"""Bounding spheres cut by a slab, exact over integers.

The centre comes from Badoiu and Clarkson's iteration ("Smaller core-sets for balls", 2003): step toward
the farthest point by 1 / (i + 1); it never fails on collinear, coplanar or cospherical points, as solvers
for the minimal ball do (NUMERICS.md case 8). The slab's direction is the eigenvector of least variance.
Both are only guesses of where a good bound lies: the bound itself is measured afterwards from the *stored*
integers, and rounded outward, so it encloses whatever the guess (NUMERICS.md N3).
"""

import math

import numba as nb
import numpy as np

# Ratio to the minimal ball: see tests/hard_cases/test_bounds.py, at most 1.25 on leaf blocks.
# Large sets get fewer steps, because each step visits every point and an upper node is tested rarely.
SMALL_SET = 256
SMALL_STEPS = 32
LARGE_STEPS = 8

# The slab's direction is stored in three int8; finer directions gained nothing measurable.
NORMAL_LENGTH = 127.0


@nb.njit(nogil=True, cache=True)
def ceil_sqrt(value):
    """The least integer whose square is at least value; value int64, 0 to 2^62."""
    root = np.int64(math.sqrt(float(value)))
    while root * root < value:
        root += 1
    while root > 0 and (root - 1) * (root - 1) >= value:
        root -= 1
    return root


@nb.njit(nogil=True, cache=True)
def _ball_center(points, lo, hi, steps, center):
    """Guess the centre (3,) float64 of the least ball around points[lo:hi], int32; 0 steps: the box's centre."""
    for k in range(3):
        least, most = points[lo, k], points[lo, k]
        for i in range(lo + 1, hi):
            least = min(least, points[i, k])
            most = max(most, points[i, k])
        center[k] = (float(least) + float(most)) * 0.5
    for step in range(steps):
        far, best = lo, -1.0
        for i in range(lo, hi):
            dx = float(points[i, 0]) - center[0]
            dy = float(points[i, 1]) - center[1]
            dz = float(points[i, 2]) - center[2]
            d2 = dx * dx + dy * dy + dz * dz
            if d2 > best:
                best, far = d2, i
        # The box's centre is a good start already: the first steps of 1/2, 1/3 would only leave it.
        weight = 1.0 / (step + 4.0)
        for k in range(3):
            center[k] += (float(points[far, k]) - center[k]) * weight


@nb.njit(nogil=True, cache=True)
def _least_variance(points, lo, hi, normal):
    """Write the direction (3,) of least variance of points[lo:hi], by cyclic Jacobi rotations (unit length)."""
    n = float(hi - lo)
    mean = np.zeros(3)
    for i in range(lo, hi):
        for k in range(3):
            mean[k] += float(points[i, k])
    for k in range(3):
        mean[k] /= n
    a = np.zeros((3, 3))
    for i in range(lo, hi):
        dx, dy, dz = (
            float(points[i, 0]) - mean[0],
            float(points[i, 1]) - mean[1],
            float(points[i, 2]) - mean[2],
        )
        a[0, 0] += dx * dx
        a[0, 1] += dx * dy
        a[0, 2] += dx * dz
        a[1, 1] += dy * dy
        a[1, 2] += dy * dz
        a[2, 2] += dz * dz
    a[1, 0], a[2, 0], a[2, 1] = a[0, 1], a[0, 2], a[1, 2]
    v = np.eye(3)
    for _ in range(8):
        for p in range(2):
            for q in range(p + 1, 3):
                if abs(a[p, q]) <= 1e-12 * (abs(a[p, p]) + abs(a[q, q])):
                    continue
                theta = (a[q, q] - a[p, p]) / (2.0 * a[p, q])
                t = 1.0 / (abs(theta) + math.sqrt(theta * theta + 1.0))
                t = -t if theta < 0.0 else t
                c = 1.0 / math.sqrt(t * t + 1.0)
                s = t * c
                for k in range(3):
                    kp, kq = a[k, p], a[k, q]
                    a[k, p], a[k, q] = c * kp - s * kq, s * kp + c * kq
                for k in range(3):
                    pk, qk = a[p, k], a[q, k]
                    a[p, k], a[q, k] = c * pk - s * qk, s * pk + c * qk
                for k in range(3):
                    kp, kq = v[k, p], v[k, q]
                    v[k, p], v[k, q] = c * kp - s * kq, s * kp + c * kq
    least = 0
    for k in range(1, 3):
        if a[k, k] < a[least, least]:
            least = k
    for k in range(3):
        normal[k] = v[k, least]


@nb.njit(nogil=True, cache=True)
def _radius(points, lo, hi, center, unit):
    """Radius [units], rounded up, of the ball around a stored centre (3,) int64 [units] that holds points[lo:hi]."""
    cx, cy, cz = center[0] * unit, center[1] * unit, center[2] * unit
    farthest = np.int64(0)
    for i in range(lo, hi):
        dx, dy, dz = np.int64(points[i, 0]) - cx, np.int64(points[i, 1]) - cy, np.int64(points[i, 2]) - cz
        farthest = max(farthest, dx * dx + dy * dy + dz * dz)
    return (ceil_sqrt(farthest) + unit - 1) // unit


@nb.njit(nogil=True, cache=True)
def bound_points(points, lo, hi, unit_log2, highest, with_slab, center, normal, slab):
    """Bound points[lo:hi] by a sphere cut by a slab, stored as integers.

    points: (n, 3) int32, 0 to 2^23 [steps], lo < hi.  unit_log2: the stored unit, 2^unit_log2 steps.
    highest: greatest coordinate a stored centre may have, and the
    greatest radius wanted.  with_slab: False leaves the normal zero.
    Writes center (3,) int64 [units], normal (3,) int64 of length about 127, slab (2,) int64: least and greatest
    dot(normal, point - center) [steps]. Returns the radius [units], int64, rounded up.
    """
    guess = np.empty(3)
    unit = np.int64(1) << np.int64(unit_log2)
    steps = SMALL_STEPS if hi - lo <= SMALL_SET else LARGE_STEPS
    radius = highest + 1
    while radius > highest:
        # A ball around the box's centre, tried last, has at most half the diagonal: 0.87 of `highest`, and fits.
        _ball_center(points, lo, hi, steps, guess)
        for k in range(3):
            center[k] = min(max(np.int64(np.rint(guess[k] / float(unit))), 0), highest)
        radius = _radius(points, lo, hi, center, unit)
        if steps == 0:
            break
        steps = 0
    for k in range(3):
        normal[k] = 0
    if with_slab and hi - lo >= 3:
        _least_variance(points, lo, hi, guess)
        for k in range(3):
            normal[k] = np.int64(np.rint(guess[k] * NORMAL_LENGTH))
    cx, cy, cz = center[0] * unit, center[1] * unit, center[2] * unit
    least, most = np.int64(1) << 62, -(np.int64(1) << 62)
    for i in range(lo, hi):
        dx, dy, dz = np.int64(points[i, 0]) - cx, np.int64(points[i, 1]) - cy, np.int64(points[i, 2]) - cz
        along = normal[0] * dx + normal[1] * dy + normal[2] * dz
        least, most = min(least, along), max(most, along)
    slab[0], slab[1] = least, most
    return radius


@nb.njit(nogil=True, cache=True)
def bound_nodes(points, begin, end, unit_log2, highest, with_slab, center, radius, normal, slab):
    """`bound_points` for every run points[begin[i]:end[i]]; writes row i of center, radius, normal, slab (int64)."""
    for i in range(begin.shape[0]):
        radius[i] = bound_points(
            points, begin[i], end[i], unit_log2, highest, with_slab, center[i], normal[i], slab[i]
        )
