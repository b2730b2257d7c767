"""The surface normal at a scan point, as a code of 16 bits: what builder and server compute alike.

The definition, which no order, tree or machine can change. Of all points of the same voxel within reach of the point
(itself and duplicates included), differences to it in whole steps; their number, sums and sums of products, exact
int64. From these, in float64, each operation as it stands here and none but + - * / and square root, which IEEE 754
rounds alike everywhere: the covariance, divided by its trace; SWEEPS cyclic sweeps of Jacobi rotations (Jacobi 1846;
the stable form is Golub and Van Loan, Matrix Computations, section 8.5); the eigenvector of the least eigenvalue. There
is no normal, code NONE,

- of fewer than LEAST_POINTS points, or where all are in one place;
- of points along a line: the second eigenvalue is at most LINE times the greatest;
- of points with no thin direction: the least eigenvalue is above THICK times the second.

The code is that of the unit normal or its opposite, whichever has z >= 0: octahedral, as Cigolle et al. 2014 (A Survey
of Efficient Representations for Independent Unit Vectors) have it for hemispheres. With p = (x, y) / (|x| + |y| + |z|),
u = p_x + p_y and v = p_x - p_y fill the square [-1, 1]; 127 u and 127 v are rounded half to even, 128 is added: u is
the high byte, v the low one, so both are 1 to 255. The axes are exact, other directions off by 0.56 degrees at most.
"""

import math

import numpy as np

from . import compiling as nb

NONE = np.uint16(0)
LEAST_POINTS = 3
# Standard deviations of 1 : 32. A line of one scanner's row, noise and all, is below; what is left of a surface at its
# edge, a strip a tenth as wide as it is long, above.
LINE = 2.0**-10
# Right-angled edges and corners are at 0.29, and have the direction between the faces; a ball is at 1.
THICK = 0.5
# Off-diagonals shrink quadratically; four make them vanish in float64, from any start that was tried.
SWEEPS = 6
_SMALL = (
    2.0**-120
)  # an off-diagonal of a matrix of trace 1 that is as good as zero; its square does not underflow
_LEVELS = 127.0
_MIDDLE = 128


@nb.njit(nogil=True, cache=True)
def _rotation(a_pp, a_qq, a_pq):
    """(t, c, s) of the Jacobi rotation that makes a_pq vanish."""
    if abs(a_pq) <= _SMALL:
        return 0.0, 1.0, 0.0
    theta = (a_qq - a_pp) / (2.0 * a_pq)
    root = abs(theta) + math.sqrt(theta * theta + 1.0)
    t = 1.0 / root if theta >= 0.0 else -1.0 / root
    c = 1.0 / math.sqrt(t * t + 1.0)
    return t, c, t * c


@nb.njit(nogil=True, cache=True)
def _turn(c, s, a, b):
    """Two figures turned by a rotation."""
    return c * a - s * b, s * a + c * b


@nb.njit(nogil=True, cache=True)
def least_direction(xx, yy, zz, yz, zx, xy):
    """Eigenvalues of a symmetric matrix, float64, of trace about 1: ascending, and the unit eigenvector of the least.

    Returns ((least, second, greatest), (x, y, z)). Equal eigenvalues: any of their eigenvectors.
    """
    # The columns of the rotation so far: eigenvectors in the end.
    ax, ay, az, bx, by, bz, cx, cy, cz = 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0
    for _ in range(SWEEPS):
        t, c, s = _rotation(xx, yy, xy)
        xx, yy, xy = xx - t * xy, yy + t * xy, 0.0
        zx, yz = _turn(c, s, zx, yz)
        ax, bx = _turn(c, s, ax, bx)
        ay, by = _turn(c, s, ay, by)
        az, bz = _turn(c, s, az, bz)
        t, c, s = _rotation(xx, zz, zx)
        xx, zz, zx = xx - t * zx, zz + t * zx, 0.0
        xy, yz = _turn(c, s, xy, yz)
        ax, cx = _turn(c, s, ax, cx)
        ay, cy = _turn(c, s, ay, cy)
        az, cz = _turn(c, s, az, cz)
        t, c, s = _rotation(yy, zz, yz)
        yy, zz, yz = yy - t * yz, zz + t * yz, 0.0
        xy, zx = _turn(c, s, xy, zx)
        bx, cx = _turn(c, s, bx, cx)
        by, cy = _turn(c, s, by, cy)
        bz, cz = _turn(c, s, bz, cz)
    least, greatest = min(xx, yy, zz), max(xx, yy, zz)
    second = max(min(xx, yy), min(max(xx, yy), zz))
    if least == zz:  # of equal ones z: what cannot be told apart lies flat
        ax, ay, az = cx, cy, cz
    elif least == yy:
        ax, ay, az = bx, by, bz
    return (least, second, greatest), (ax, ay, az)


@nb.njit(nogil=True, cache=True)
def encode_normal(x, y, z):
    """The code, uint16, of a direction (x, y, z) of any length but 0."""
    if z < 0.0 or (z == 0.0 and (y < 0.0 or (y == 0.0 and x < 0.0))):
        x, y, z = -x, -y, -z
    size = abs(x) + abs(y) + z
    x, y = x / size, y / size
    u = np.int64(np.rint((x + y) * _LEVELS)) + _MIDDLE
    v = np.int64(np.rint((x - y) * _LEVELS)) + _MIDDLE
    return np.uint16(256 * u + v)


@nb.njit(nogil=True, cache=True)
def decode_normal(code):
    """The unit vector (x, y, z), z >= 0, of a code that is not NONE."""
    u, v = np.float64(np.int64(code) // 256 - _MIDDLE), np.float64(np.int64(code) % 256 - _MIDDLE)
    x, y = (u + v) * 0.5, (u - v) * 0.5
    z = _LEVELS - abs(x) - abs(y)
    length = math.sqrt(x * x + y * y + z * z)
    return x / length, y / length, z / length


@nb.njit(nogil=True, cache=True)
def normal_code(sums):
    """The code, uint16, of the normal at a point.

    sums: (10,) int64, of the differences to it [steps]: how many, x, y, z, xx, yy, zz, yz, zx, xy.
    """
    if sums[0] < LEAST_POINTS:
        return NONE
    n = np.float64(sums[0])
    x, y, z = np.float64(sums[1]) / n, np.float64(sums[2]) / n, np.float64(sums[3]) / n
    xx, yy = np.float64(sums[4]) / n - x * x, np.float64(sums[5]) / n - y * y
    zz = np.float64(sums[6]) / n - z * z
    yz, zx = np.float64(sums[7]) / n - y * z, np.float64(sums[8]) / n - z * x
    xy = np.float64(sums[9]) / n - x * y
    trace = xx + yy + zz
    if not trace > 0.0:
        return NONE
    values, vector = least_direction(xx / trace, yy / trace, zz / trace, yz / trace, zx / trace, xy / trace)
    if values[1] <= LINE * values[2] or values[0] > THICK * values[1]:
        return NONE
    return encode_normal(vector[0], vector[1], vector[2])
