"""Normals of all points of a voxel; boxes wholly within reach contribute their precomputed sums.

The boxes are those of nearest_neighbours.py, over points in Morton order. Sums of a box are
relative to its least corner and are translated to the query point. All arithmetic is exact in
int64: a box whose sums are used lies in the ball of the reach, so it measures at most twice the
reach, and `squared_reach` (schemas/archive/normal_reach.py) leaves room for it.
"""

import numpy as np

from ....schemas.kernels import compiling as nb
from ....schemas.kernels.normal_codes import normal_code
from .nearest_neighbours import BLOCK, FAN, STACK

# Length of the sums: count; x, y, z; xx, yy, zz; yz, zx, xy.
SUMS = 10


@nb.njit(nogil=True, cache=True, inline="always")
def _add_point(sums, multiplicity, x, y, z):
    """Add a difference with a multiplicity."""
    sums[0] += multiplicity
    sums[1] += multiplicity * x
    sums[2] += multiplicity * y
    sums[3] += multiplicity * z
    sums[4] += multiplicity * x * x
    sums[5] += multiplicity * y * y
    sums[6] += multiplicity * z * z
    sums[7] += multiplicity * y * z
    sums[8] += multiplicity * z * x
    sums[9] += multiplicity * x * y


@nb.njit(nogil=True, cache=True)
def _add_moved(sums, other, x, y, z):
    """Add the sums `other` (SUMS,) relative to an origin at (x, y, z) from the origin of `sums`."""
    n, sx, sy, sz = other[0], other[1], other[2], other[3]
    sums[0] += n
    sums[1] += sx + n * x
    sums[2] += sy + n * y
    sums[3] += sz + n * z
    sums[4] += other[4] + 2 * x * sx + n * x * x
    sums[5] += other[5] + 2 * y * sy + n * y * y
    sums[6] += other[6] + 2 * z * sz + n * z * z
    sums[7] += other[7] + y * sz + z * sy + n * y * z
    sums[8] += other[8] + z * sx + x * sz + n * z * x
    sums[9] += other[9] + x * sy + y * sx + n * x * y


@nb.njit(nogil=True, cache=True)
def _diagonal(boxes, box):
    """Return the square of a box's diagonal."""
    total = np.int64(0)
    for k in range(3):
        edge = np.int64(boxes[box, 3 + k]) - np.int64(boxes[box, k])
        total += edge * edge
    return total


@nb.njit(nogil=True, cache=True)
def box_sums(points, multiplicity, boxes, starts, square):
    """Return the sums (b, SUMS) int64 of the points of each box from its least corner.

    points: (n, 3) int32, distinct.
    multiplicity: (n,) int64, the multiplicity of each point.
    boxes, starts: of these points (nearest_neighbours.py).
    square: of the reach.
    The sums are zero for a box that fits into no ball of the reach.
    """
    sums = np.zeros((starts[-1], SUMS), np.int64)
    for box in range(starts[1]):
        if _diagonal(boxes, box) > 4 * square:
            continue
        x, y, z = np.int64(boxes[box, 0]), np.int64(boxes[box, 1]), np.int64(boxes[box, 2])
        for i in range(box * BLOCK, min((box + 1) * BLOCK, points.shape[0])):
            _add_point(sums[box], multiplicity[i], points[i, 0] - x, points[i, 1] - y, points[i, 2] - z)
    for level in range(1, starts.shape[0] - 1):
        for box in range(starts[level], starts[level + 1]):
            if _diagonal(boxes, box) > 4 * square:
                continue
            first = starts[level - 1] + (box - starts[level]) * FAN
            for child in range(first, min(first + FAN, starts[level])):
                _add_moved(
                    sums[box],
                    sums[child],
                    np.int64(boxes[child, 0]) - np.int64(boxes[box, 0]),
                    np.int64(boxes[child, 1]) - np.int64(boxes[box, 1]),
                    np.int64(boxes[child, 2]) - np.int64(boxes[box, 2]),
                )
    return sums


@nb.njit(nogil=True, cache=True)
def point_normals(points, multiplicity, boxes, starts, sums, square, codes):
    """Write the codes (n,) uint16 of the normals at all points.

    sums: the result of `box_sums`. Other arguments as in `box_sums`.
    """
    stack, total = np.empty((STACK, 2), np.int64), np.empty(SUMS, np.int64)
    for i in range(points.shape[0]):
        x, y, z = np.int64(points[i, 0]), np.int64(points[i, 1]), np.int64(points[i, 2])
        for k in range(SUMS):
            total[k] = 0
        level = starts.shape[0] - 2
        stack[0, 0], stack[0, 1] = level, starts[level]
        depth = 1
        while depth > 0:
            depth -= 1
            level, box = stack[depth, 0], stack[depth, 1]
            near = far = np.int64(0)
            for k in range(3):
                at = np.int64(points[i, k])
                low, high = np.int64(boxes[box, k]) - at, at - np.int64(boxes[box, 3 + k])
                gap = max(low, high, np.int64(0))
                reach = max(-low, -high)
                near += gap * gap
                far += reach * reach
            if near > square:
                continue
            if far <= square:
                _add_moved(
                    total,
                    sums[box],
                    np.int64(boxes[box, 0]) - x,
                    np.int64(boxes[box, 1]) - y,
                    np.int64(boxes[box, 2]) - z,
                )
            elif level == 0:
                for j in range(box * BLOCK, min((box + 1) * BLOCK, points.shape[0])):
                    dx, dy, dz = points[j, 0] - x, points[j, 1] - y, points[j, 2] - z
                    if dx * dx + dy * dy + dz * dz <= square:
                        _add_point(total, multiplicity[j], dx, dy, dz)
            else:
                first = starts[level - 1] + (box - starts[level]) * FAN
                for child in range(first, min(first + FAN, starts[level])):
                    stack[depth, 0], stack[depth, 1] = level - 1, child
                    depth += 1
        codes[i] = normal_code(total)
