"""Surface normal at a scan point, as a 16-bit code.

The definition does not depend on order, tree, voxels or machine. Take all scan points within reach
of the point (itself and duplicates included). Sum their differences to the point, in whole steps:
count, sums and sums of products, exact int64. From these compute in float64, with each
operation exactly as it stands here and nothing but + - * / and square root, which IEEE 754 rounds
identically everywhere: the covariance, divided by its trace; SWEEPS cyclic sweeps of Jacobi
rotations (Jacobi 1846; the stable form is Golub and Van Loan, Matrix Computations, section 8.5);
the eigenvector of the least eigenvalue. There is no normal, code NO_NORMAL,

- for fewer than MIN_POINTS points, or if all are in one place;
- for points along a line: the second eigenvalue is at most LINE times the greatest;
- for points without a thin direction: the least eigenvalue is above THICK times the second.

The code represents the unit normal or its opposite, whichever has z >= 0. It is the octahedral code
for hemispheres of Cigolle et al. 2014 (A Survey of Efficient Representations for Independent Unit
Vectors). With p = (x, y) / (|x| + |y| + |z|), u = p_x + p_y and v = p_x - p_y fill the square [-1,
1]; 127 u and 127 v are rounded half to even, and 128 is added. u is the high byte, v the low one,
so both are 1 to 255. The axes are exact; other directions are off by 0.56 degrees at most.
"""

import math
from fractions import Fraction

import numpy as np

from ....schemas.errors import BadRequestError
from ....schemas.runtime import compiling as nb

# Largest reach [m]. Points farther apart do not belong to one surface.
MAX_NORMAL_REACH = 1.0
SUMS = 10  # elements of the sums that `normal_code` takes
NO_NORMAL = np.uint16(0)
MIN_POINTS = 3
# Ratio of variances; standard deviations of 1 : 32. The points of one scanner row, with noise, are
# below it. A strip at the edge of a surface, a tenth as wide as it is long, is above it.
LINE = 2.0**-10
# Right-angled edges and corners are at 0.29, and get the direction between the faces; a ball is at
# 1.
THICK = 0.5
# Off-diagonal elements shrink quadratically. Four sweeps make them vanish in float64, from every
# start that was tried.
SWEEPS = 6
_SMALL = (
    2.0**-120
)  # an off-diagonal element that counts as zero if the trace is 1; its square does not underflow
_LEVELS = 127.0
_MIDDLE = 128


@nb.njit(nogil=True, cache=True)
def _rotation(a_pp, a_qq, a_pq):
    """Return (t, c, s) of the Jacobi rotation that makes a_pq vanish."""
    if abs(a_pq) <= _SMALL:
        return 0.0, 1.0, 0.0
    theta = (a_qq - a_pp) / (2.0 * a_pq)
    root = abs(theta) + math.sqrt(theta * theta + 1.0)
    t = 1.0 / root if theta >= 0.0 else -1.0 / root
    c = 1.0 / math.sqrt(t * t + 1.0)
    return t, c, t * c


@nb.njit(nogil=True, cache=True)
def _rotate_pair(c, s, a, b):
    """Rotate the pair (a, b)."""
    return c * a - s * b, s * a + c * b


@nb.njit(nogil=True, cache=True)
def least_direction(xx, yy, zz, yz, zx, xy):
    """Return the eigenvalues of a symmetric matrix, and the unit eigenvector of the least.

    xx to xy: float64, elements of a matrix with trace about 1.
    Returns ((least, second, greatest), (x, y, z)). Equal eigenvalues: any of their eigenvectors.
    """
    # Columns of the accumulated rotation: the eigenvectors in the end.
    ax, ay, az, bx, by, bz, cx, cy, cz = 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0
    for _ in range(SWEEPS):
        t, c, s = _rotation(xx, yy, xy)
        xx, yy, xy = xx - t * xy, yy + t * xy, 0.0
        zx, yz = _rotate_pair(c, s, zx, yz)
        ax, bx = _rotate_pair(c, s, ax, bx)
        ay, by = _rotate_pair(c, s, ay, by)
        az, bz = _rotate_pair(c, s, az, bz)
        t, c, s = _rotation(xx, zz, zx)
        xx, zz, zx = xx - t * zx, zz + t * zx, 0.0
        xy, yz = _rotate_pair(c, s, xy, yz)
        ax, cx = _rotate_pair(c, s, ax, cx)
        ay, cy = _rotate_pair(c, s, ay, cy)
        az, cz = _rotate_pair(c, s, az, cz)
        t, c, s = _rotation(yy, zz, yz)
        yy, zz, yz = yy - t * yz, zz + t * yz, 0.0
        xy, zx = _rotate_pair(c, s, xy, zx)
        bx, cx = _rotate_pair(c, s, bx, cx)
        by, cy = _rotate_pair(c, s, by, cy)
        bz, cz = _rotate_pair(c, s, bz, cz)
    least, greatest = min(xx, yy, zz), max(xx, yy, zz)
    second = max(min(xx, yy), min(max(xx, yy), zz))
    if least == zz:  # if equal, prefer z: ambiguous points count as horizontal
        ax, ay, az = cx, cy, cz
    elif least == yy:
        ax, ay, az = bx, by, bz
    return (least, second, greatest), (ax, ay, az)


@nb.njit(nogil=True, cache=True)
def encode_normal(x, y, z):
    """Return the code, uint16, of a direction (x, y, z) of any length but 0."""
    if z < 0.0 or (z == 0.0 and (y < 0.0 or (y == 0.0 and x < 0.0))):
        x, y, z = -x, -y, -z
    size = abs(x) + abs(y) + z
    x, y = x / size, y / size
    u = np.int64(np.rint((x + y) * _LEVELS)) + _MIDDLE
    v = np.int64(np.rint((x - y) * _LEVELS)) + _MIDDLE
    return np.uint16(256 * u + v)


@nb.njit(nogil=True, cache=True)
def decode_normal(code):
    """Return the unit vector (x, y, z), z >= 0, of a code that is not NO_NORMAL."""
    u, v = np.float64(np.int64(code) // 256 - _MIDDLE), np.float64(np.int64(code) % 256 - _MIDDLE)
    x, y = (u + v) * 0.5, (u - v) * 0.5
    z = _LEVELS - abs(x) - abs(y)
    length = math.sqrt(x * x + y * y + z * z)
    return x / length, y / length, z / length


@nb.njit(nogil=True, inline="always")
def add_sums(sums, a, b, c):
    """Add one point's difference (a, b, c), int64 [steps], to the sums for `normal_code`."""
    sums[0] += 1
    sums[1] += a
    sums[2] += b
    sums[3] += c
    sums[4] += a * a
    sums[5] += b * b
    sums[6] += c * c
    sums[7] += b * c
    sums[8] += c * a
    sums[9] += a * b


@nb.njit(nogil=True, cache=True)
def normal_code(sums):
    """Return the code, uint16, of the normal at a point.

    sums: (SUMS,) int64, over the differences to the point [steps]: count, x, y, z, xx, yy, zz, yz,
    zx, xy.
    """
    if sums[0] < MIN_POINTS:
        return NO_NORMAL
    n = np.float64(sums[0])
    x, y, z = np.float64(sums[1]) / n, np.float64(sums[2]) / n, np.float64(sums[3]) / n
    xx, yy = np.float64(sums[4]) / n - x * x, np.float64(sums[5]) / n - y * y
    zz = np.float64(sums[6]) / n - z * z
    yz, zx = np.float64(sums[7]) / n - y * z, np.float64(sums[8]) / n - z * x
    xy = np.float64(sums[9]) / n - x * y
    trace = xx + yy + zz
    if not trace > 0.0:
        return NO_NORMAL
    values, vector = least_direction(xx / trace, yy / trace, zz / trace, yz / trace, zx / trace, xy / trace)
    if values[1] <= LINE * values[2] or values[0] > THICK * values[1]:
        return NO_NORMAL
    return encode_normal(vector[0], vector[1], vector[2])


def squared_reach(reach: float, step: float, points: int) -> int:
    """Return the greatest squared distance within `reach` [m], in squared steps.

    Both lengths are taken as the decimal numbers that they print as, so 800 steps of 0.1 mm are
    exactly 8 cm.
    points: the most points that may be within reach; their sums must fit 63 bits.
    Raise BadRequestError for an invalid reach.
    """
    if not 0 < reach <= MAX_NORMAL_REACH:
        raise BadRequestError(
            f"normal reach {reach!r}: expected a length above 0, at most {MAX_NORMAL_REACH:g} m"
        )
    square = int((Fraction(repr(float(reach))) / Fraction(repr(step))) ** 2)
    if square * max(points, 1) >= 1 << 63:
        most = 0.995 * math.sqrt((1 << 63) / max(points, 1)) * step
        raise BadRequestError(
            f"normal reach {reach!r} m: sums over up to {points} points exceed 63 bits: give at most {most:.3g}"
        )
    return square
