"""Bounding spheres cut by a slab, exact over integers.

The centre comes from Badoiu and Clarkson's iteration ("Smaller core-sets for balls", 2003): step
toward the farthest point by 1 / (i + 1). It never fails on collinear, coplanar or cospherical
points, as solvers for the minimal ball do (NUMERICS.md case 8). The slab's direction is the
eigenvector of least variance. Both are only estimates of a good bound. The centre can therefore be
computed in float32, and the direction from sums over children. The bound itself is measured
afterwards from the *stored* integers and rounded outward. It encloses the points whatever the
estimate (NUMERICS.md N3).
"""

import math

import numpy as np

from ....schemas.runtime import compiling as nb

# Steps of the centre's iteration. Ratio of the radius to that of the minimal ball: see
# tests/hard_cases/test_bounds.py, at most 1.25 on leaf blocks. Large sets get fewer steps, because
# each step visits every point and queries test an upper node rarely.
SMALL_SET = 256
SMALL_STEPS = 32
LARGE_STEPS = 8
# Points whose distances are compared at once. The index of a point in its block fits into the low
# bits of a distance.
BLOCK = 256

# The slab's direction is stored in three int8; a finer direction gave no measurable gain.
NORMAL_LENGTH = 127.0

# Length of the moments, the statistics of a set of points: the number of points; their mean x, y, z;
# the sums of products of deviations from the mean: xx, xy, xz, yy, yz, zz.
MOMENTS = 10


@nb.njit(nogil=True, cache=True)
def ceil_sqrt(value):
    """Return the least integer whose square is at least value; value int64, 0 to 2^62."""
    root = np.int64(math.sqrt(float(value)))
    while root * root < value:
        root += 1
    while root > 0 and (root - 1) * (root - 1) >= value:
        root -= 1
    return root


@nb.njit(nogil=True, cache=True)
def bound_workspace(n):
    """Allocate the workspace of `ball_center` for up to n points.

    Returns (coordinates (3, n) float32, distances (BLOCK,) float32, the same distances viewed as
    int32).
    """
    distances = np.empty(BLOCK, np.float32)
    return np.empty((3, n), np.float32), distances, distances.view(np.int32)


@nb.njit(nogil=True, cache=True)
def ball_center(workspace, lo, hi, steps, center):
    """Improve an estimated centre (3,) float64 of the least ball around points of `workspace`.

    lo, hi: the range of points.
    steps: number of iterations.
    The farthest point is found among distances compared by their bits as integers, which order like
    the floats. A loop that looks for the greatest float would stay scalar.
    """
    points, distances, bits = workspace
    place = np.int32(BLOCK - 1)
    for step in range(steps):
        x, y, z = np.float32(center[0]), np.float32(center[1]), np.float32(center[2])
        far, best = lo, np.int32(-1)
        for begin in range(lo, hi, np.uint64(BLOCK)):
            held = min(np.uint64(BLOCK), hi - begin)
            for j in range(held):
                dx, dy, dz = points[0, begin + j] - x, points[1, begin + j] - y, points[2, begin + j] - z
                distances[j] = dx * dx + dy * dy + dz * dz
            greatest = np.int32(-1)
            for j in range(held):
                greatest = max(greatest, np.int32((bits[j] & ~place) | np.int32(j)))
            if np.int32(greatest & ~place) > best:
                best, far = np.int32(greatest & ~place), begin + np.uint64(greatest & place)
        # The box's centre is a good start: initial steps of 1/2 and 1/3 would only leave it.
        weight = 1.0 / (step + 4.0)
        for k in range(np.uint64(3)):
            center[k] += (float(points[k, far]) - center[k]) * weight


@nb.njit(nogil=True, cache=True)
def leaf_moments(xyz, lo, hi, moments):
    """Write the moments (MOMENTS,) float64 of the points [lo, hi) of a leaf node.

    Sums are exact until they are divided.
    """
    n = np.int64(hi - lo)
    x0, y0, z0 = xyz[0, lo], xyz[1, lo], xyz[2, lo]
    x = y = z = xx = xy = xz = yy = yz = zz = np.int64(0)
    for i in range(lo, hi):
        dx, dy, dz = (
            np.int64(np.int32(xyz[0, i] - x0)),
            np.int64(np.int32(xyz[1, i] - y0)),
            np.int64(np.int32(xyz[2, i] - z0)),
        )
        x, y, z = x + dx, y + dy, z + dz
        xx, xy, xz = xx + dx * dx, xy + dx * dy, xz + dx * dz
        yy, yz, zz = yy + dy * dy, yz + dy * dz, zz + dz * dz
    by = 1.0 / float(n)
    moments[0] = float(n)
    moments[1], moments[2], moments[3] = (
        float(x0) + float(x) * by,
        float(y0) + float(y) * by,
        float(z0) + float(z) * by,
    )
    moments[4], moments[5], moments[6] = (
        float(n * xx - x * x) * by,
        float(n * xy - x * y) * by,
        float(n * xz - x * z) * by,
    )
    moments[7], moments[8], moments[9] = (
        float(n * yy - y * y) * by,
        float(n * yz - y * z) * by,
        float(n * zz - z * z) * by,
    )


@nb.njit(nogil=True, cache=True)
def join_moments(moment_rows, first, count, moments):
    """Write the joint moments (MOMENTS,) of the rows first to first + count of moment_rows (n, MOMENTS)."""
    n = 0.0
    x = y = z = 0.0
    for i in range(first, first + count):
        held = moment_rows[i, 0]
        n += held
        x, y, z = x + held * moment_rows[i, 1], y + held * moment_rows[i, 2], z + held * moment_rows[i, 3]
    x, y, z = x / n, y / n, z / n
    xx = xy = xz = yy = yz = zz = 0.0
    for i in range(first, first + count):
        held, dx, dy, dz = (
            moment_rows[i, 0],
            moment_rows[i, 1] - x,
            moment_rows[i, 2] - y,
            moment_rows[i, 3] - z,
        )
        xx, xy, xz = (
            xx + moment_rows[i, 4] + held * dx * dx,
            xy + moment_rows[i, 5] + held * dx * dy,
            xz + moment_rows[i, 6] + held * dx * dz,
        )
        yy, yz, zz = (
            yy + moment_rows[i, 7] + held * dy * dy,
            yz + moment_rows[i, 8] + held * dy * dz,
            zz + moment_rows[i, 9] + held * dz * dz,
        )
    moments[0], moments[1], moments[2], moments[3] = n, x, y, z
    moments[4], moments[5], moments[6], moments[7], moments[8], moments[9] = xx, xy, xz, yy, yz, zz


@nb.njit(nogil=True, cache=True)
def _flat_direction(moments, direction):
    """Write the direction (3,) of least variance where it is distinct; return whether it is.

    Newton's method from 0, which never passes it, finds the least root of the characteristic
    polynomial. The direction is the cross product of two rows of the matrix minus that root. Only +
    - * / and sqrt are used: the result is the same on any machine.
    """
    size = (moments[4] + moments[7] + moments[9]) / 3.0
    if not size > 0.0:
        return False
    xx, xy, xz = moments[4] / size, moments[5] / size, moments[6] / size
    yy, yz, zz = moments[7] / size, moments[8] / size, moments[9] / size
    second = xx * yy - xy * xy + xx * zz - xz * xz + yy * zz - yz * yz
    third = xx * (yy * zz - yz * yz) - xy * (xy * zz - yz * xz) + xz * (xy * yz - yy * xz)
    root = 0.0
    for _ in range(40):
        slope = second - root * (6.0 - 3.0 * root)
        value = third - root * (second - root * (3.0 - root))
        if not slope > 1e-3:  # a double root, or nearly one
            return False
        step = value / slope
        root += step
        if abs(step) <= 1e-15:
            break
    xx, yy, zz = xx - root, yy - root, zz - root
    ax, ay, az = xy * yz - xz * yy, xz * xy - xx * yz, xx * yy - xy * xy
    bx, by, bz = xy * zz - xz * yz, xz * xz - xx * zz, xx * yz - xy * xz
    cx, cy, cz = yy * zz - yz * yz, yz * xz - xy * zz, xy * yz - yy * xz
    a, b, c = ax * ax + ay * ay + az * az, bx * bx + by * by + bz * bz, cx * cx + cy * cy + cz * cz
    if b > a:
        ax, ay, az, a = bx, by, bz, b
    if c > a:
        ax, ay, az, a = cx, cy, cz, c
    if not a > 1e-8:
        return False
    length = math.sqrt(a)
    direction[0], direction[1], direction[2] = ax / length, ay / length, az / length
    return True


@nb.njit(nogil=True, cache=True)
def least_variance(moments, direction):
    """Write the unit direction (3,) float64 of least variance of moments (MOMENTS,)."""
    if _flat_direction(moments, direction):
        return
    a, v = np.zeros((3, 3)), np.zeros((3, 3))
    v[0, 0] = v[1, 1] = v[2, 2] = 1.0
    a[0, 0], a[0, 1], a[0, 2] = moments[4], moments[5], moments[6]
    a[1, 0], a[1, 1], a[1, 2] = moments[5], moments[7], moments[8]
    a[2, 0], a[2, 1], a[2, 2] = moments[6], moments[8], moments[9]
    for _ in range(8):  # cyclic Jacobi rotations
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
        direction[k] = v[k, least]


@nb.njit(nogil=True, cache=True)
def greatest_distance2(xyz, lo, hi, x, y, z):
    """Return the greatest squared distance, int64, of the points [lo, hi) of xyz from (x, y, z).

    All points lie within 2^30 of (x, y, z).
    """
    x, y, z = np.int32(x), np.int32(y), np.int32(z)
    farthest = np.int64(0)
    for i in range(lo, hi):
        dx, dy, dz = (
            np.int64(np.int32(xyz[0, i] - x)),
            np.int64(np.int32(xyz[1, i] - y)),
            np.int64(np.int32(xyz[2, i] - z)),
        )
        farthest = max(farthest, dx * dx + dy * dy + dz * dz)
    return farthest


@nb.njit(nogil=True, cache=True)
def extent_along(xyz, lo, hi, normal, x, y, z):
    """Return the least and greatest dot(normal, point - (x, y, z)) of the points [lo, hi) of xyz.

    normal: (3,) integers in the range of int8.
    """
    x, y, z = np.int32(x), np.int32(y), np.int32(z)
    a, b, c = np.int64(np.int32(normal[0])), np.int64(np.int32(normal[1])), np.int64(np.int32(normal[2]))
    least, most = np.int64(1) << 62, -(np.int64(1) << 62)
    for i in range(lo, hi):
        dx, dy, dz = (
            np.int64(np.int32(xyz[0, i] - x)),
            np.int64(np.int32(xyz[1, i] - y)),
            np.int64(np.int32(xyz[2, i] - z)),
        )
        along = a * dx + b * dy + c * dz
        least, most = min(least, along), max(most, along)
    return least, most


@nb.njit(nogil=True, cache=True)
def box_center(xyz, lo, hi, center):
    """Write the centre (3,) float64 of the bounding box of the points [lo, hi) of xyz."""
    for k in range(np.uint64(3)):
        least, most = xyz[k, lo], xyz[k, lo]
        for i in range(lo, hi):
            least, most = min(least, xyz[k, i]), max(most, xyz[k, i])
        center[k] = (float(least) + float(most)) * 0.5


@nb.njit(nogil=True, cache=True)
def bound_points(xyz, workspace, lo, hi, highest, moments, with_slab, guess, center, normal, slab):
    """Bound the points [lo, hi) of xyz by a sphere cut by a slab; return the radius, rounded up.

    xyz: (>= 3, n) int32, 0 to 2^23 [steps]; lo < hi.
    workspace: of `bound_workspace`, with the coordinates of xyz written.
    highest: upper limit of a stored centre's coordinates and of the radius.
    moments: of these points.
    with_slab: False leaves the normal zero.
    guess: (3,) float64, workspace.
    Writes integers: center (3,), normal (3,) of length about 127, slab (2,): least and greatest
    dot(normal, point - center) [steps]. Returns the radius [steps], int64.
    """
    steps = SMALL_STEPS if hi - lo <= np.uint64(SMALL_SET) else LARGE_STEPS
    radius = highest + 1
    while radius > highest:
        # If the first radius is too large, the second try takes the box's centre. Its radius is at
        # most half the diagonal, 0.87 of `highest`, and fits.
        box_center(xyz, lo, hi, guess)
        ball_center(workspace, lo, hi, steps, guess)
        for k in range(np.uint64(3)):
            center[k] = min(max(np.int64(np.rint(guess[k])), 0), highest)
        x, y, z = np.int64(center[0]), np.int64(center[1]), np.int64(center[2])
        radius = ceil_sqrt(greatest_distance2(xyz, lo, hi, x, y, z))
        if steps == 0:
            break
        steps = 0
    stored_direction(moments, with_slab, guess, normal)
    slab[0], slab[1] = extent_along(xyz, lo, hi, normal, x, y, z)
    return radius


@nb.njit(nogil=True, cache=True)
def stored_direction(moments, with_slab, guess, normal):
    """Write the slab's direction (3,) of length about 127 for moments; zero for fewer than 3 points."""
    if not with_slab or moments[0] < 3.0:
        normal[0] = normal[1] = normal[2] = 0
        return
    least_variance(moments, guess)
    for k in range(np.uint64(3)):
        normal[k] = np.int64(np.rint(guess[k] * NORMAL_LENGTH))
