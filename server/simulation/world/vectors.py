"""Vectors and rotations of a frame, computed with Python's floats in a fixed order of operations.

numpy multiplies matrices with a library whose order of sums and use of fused operations depend on
the processor. The same motion commands could give other poses on another machine. No library
guarantees the bits of a sine either. For three numbers this is also faster: a product by numpy
takes a microsecond.
"""

import math

import numpy as np
from numpy.typing import NDArray

from ...kernels.motion.screw_motion import sine_cosine

Vec = NDArray[np.float64]  # (3,)
Matrix = NDArray[np.float64]  # (3, 3), or the upper left of a pose (4, 4)

_QUARTER = 0.5 * math.pi


def dot(one: Vec, other: Vec) -> float:
    """Return the dot product of two vectors (3,)."""
    (a, b, c), (x, y, z) = one.tolist(), other.tolist()
    return float(a * x + b * y + c * z)


def norm(vector: Vec) -> float:
    """Return the length of a vector (3,)."""
    x, y, z = vector.tolist()
    return math.sqrt(x * x + y * y + z * z)


def unit_vector(vector: tuple[float, float, float]) -> Vec:
    """Return the direction of a vector that is not zero."""
    found = np.array(vector, np.float64)
    return found / norm(found)


def horizontal(vector: Vec, up: Vec) -> Vec:
    """Return the part of a vector that is perpendicular to a unit vector."""
    flat: Vec = vector - dot(vector, up) * up
    return flat


def rotate(rotation: Matrix, vector: Vec) -> Vec:
    """Return rotation @ vector."""
    (a, b, c), (d, e, f), (g, h, i) = (row[:3] for row in rotation[:3].tolist())
    x, y, z = vector.tolist()
    return np.array([a * x + b * y + c * z, d * x + e * y + f * z, g * x + h * y + i * z])


def rotate_back(rotation: Matrix, vector: Vec) -> Vec:
    """Return vector @ rotation, which inverts `rotate`."""
    return rotate(rotation[:3, :3].T, vector)


def multiply(one: Matrix, other: Matrix) -> Matrix:
    """Return the product (3, 3) of two matrices."""
    return np.column_stack([rotate(one, other[:3, column]) for column in range(3)])


def frobenius_norm(matrix: Matrix) -> float:
    """Return the Frobenius norm of a matrix (3, 3), which bounds its largest singular value."""
    return math.sqrt(sum(x * x for row in matrix.tolist() for x in row[:3]))


def min_height(points: NDArray[np.float64], up: Vec) -> float:
    """Return the least height of points (n, 3) along a direction; n > 0."""
    x, y, z = up.tolist()
    return float((points[:, 0] * x + points[:, 1] * y + points[:, 2] * z).min())


def rotation_matrix(axis: Vec, angle: float) -> Matrix:
    """Return the rotation (3, 3) about a unit vector by an angle [rad], by Rodrigues' formula."""
    quarters = math.floor(angle / _QUARTER)
    s, c = sine_cosine(min(max(angle - quarters * _QUARTER, 0.0), _QUARTER))
    for _ in range(quarters % 4):
        s, c = c, -s
    x, y, z = axis.tolist()
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + s * cross + (1.0 - c) * multiply(cross, cross)


def orthonormalize(rotation: Matrix) -> Matrix:
    """Return a rotation without the rounding errors that products of many rotations accumulate."""
    first = rotation[:, 0] / norm(rotation[:, 0])
    second = rotation[:, 1] - first * dot(first, rotation[:, 1])
    second /= norm(second)
    (a, b, c), (x, y, z) = first.tolist(), second.tolist()
    return np.column_stack([first, second, [b * z - c * y, c * x - a * z, a * y - b * x]])
