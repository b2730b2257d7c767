"""Vectors and rotations of a frame, a few at a time, in Python's numbers: each sum in one order, the same everywhere.

numpy's products of matrices are a library's, which adds and contracts as the processor has it: another machine could
have other bits, and the same wishes would lead elsewhere. Nor does any library promise a sine. Of three numbers this is
faster, too: a product by numpy takes a microsecond.
"""

import math

import numpy as np
from numpy.typing import NDArray

from ...kernels.motion.screw_motion import sine_cosine

Vec = NDArray[np.float64]  # (3,)
Matrix = NDArray[np.float64]  # (3, 3), or the upper left of a pose (4, 4)

_QUARTER = 0.5 * math.pi


def dot(one: Vec, other: Vec) -> float:
    """The product of two vectors (3,)."""
    (a, b, c), (x, y, z) = one.tolist(), other.tolist()
    return float(a * x + b * y + c * z)


def size(way: Vec) -> float:
    """The length of a vector (3,)."""
    x, y, z = way.tolist()
    return math.sqrt(x * x + y * y + z * z)


def unit(way: tuple[float, float, float]) -> Vec:
    """The direction of a vector, not zero."""
    found = np.array(way, np.float64)
    return found / size(found)


def level(way: Vec, up: Vec) -> Vec:
    """What of a vector is square to a unit vector."""
    flat: Vec = way - dot(way, up) * up
    return flat


def turned_by(turn: Matrix, way: Vec) -> Vec:
    """A vector turned by a rotation: turn @ way."""
    (a, b, c), (d, e, f), (g, h, i) = (row[:3] for row in turn[:3].tolist())
    x, y, z = way.tolist()
    return np.array([a * x + b * y + c * z, d * x + e * y + f * z, g * x + h * y + i * z])


def turned_back(turn: Matrix, way: Vec) -> Vec:
    """A vector turned back by a rotation: way @ turn."""
    return turned_by(turn[:3, :3].T, way)


def product(one: Matrix, other: Matrix) -> Matrix:
    """The product (3, 3) of two matrices."""
    return np.column_stack([turned_by(one, other[:3, column]) for column in range(3)])


def spread(matrix: Matrix) -> float:
    """The root of the sum of the squares of a matrix (3, 3): it makes no vector longer by more."""
    return math.sqrt(sum(x * x for row in matrix.tolist() for x in row[:3]))


def lowest_of(points: NDArray[np.float64], up: Vec) -> float:
    """How far up the lowest of points (n, 3), not none, is."""
    x, y, z = up.tolist()
    return float((points[:, 0] * x + points[:, 1] * y + points[:, 2] * z).min())


def rotation(axis: Vec, angle: float) -> Matrix:
    """The rotation (3, 3) about a unit vector by an angle [rad], after Rodrigues."""
    quarters = math.floor(angle / _QUARTER)
    s, c = sine_cosine(min(max(angle - quarters * _QUARTER, 0.0), _QUARTER))
    for _ in range(quarters % 4):
        s, c = c, -s
    x, y, z = axis.tolist()
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + s * cross + (1.0 - c) * product(cross, cross)


def straightened(turn: Matrix) -> Matrix:
    """A rotation made one again: turned for hours, rounding would add up."""
    first = turn[:, 0] / size(turn[:, 0])
    second = turn[:, 1] - first * dot(first, turn[:, 1])
    second /= size(second)
    (a, b, c), (x, y, z) = first.tolist(), second.tolist()
    return np.column_stack([first, second, [b * z - c * y, c * x - a * z, a * y - b * x]])
