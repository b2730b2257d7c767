"""Vectors, points and poses in compiled code. A vector is a tuple of three float64, and may be an array (3,).

The operations and their order are those of server/simulation/world/frame.py, so that both give the
same bits.
"""

import math

import numpy as np

from ....schemas.runtime import compiling as nb
from ..core.kernel_decorators import njit_no_refcount

Vector = tuple[float, float, float]


@njit_no_refcount
def vector(row):
    """Return the vector in an array (3,)."""
    return row[0], row[1], row[2]


@njit_no_refcount
def put(row, one):
    """Write a vector to an array (3,)."""
    row[0], row[1], row[2] = one[0], one[1], one[2]


@njit_no_refcount
def place_of(pose):
    """Return the translation of a pose (4, 4)."""
    return pose[0, 3], pose[1, 3], pose[2, 3]


@njit_no_refcount
def dot(one, other):
    return one[0] * other[0] + one[1] * other[1] + one[2] * other[2]


@njit_no_refcount
def norm(one):
    return math.sqrt(one[0] * one[0] + one[1] * one[1] + one[2] * one[2])


@njit_no_refcount
def plus(one, other):
    return one[0] + other[0], one[1] + other[1], one[2] + other[2]


@njit_no_refcount
def minus(one, other):
    return one[0] - other[0], one[1] - other[1], one[2] - other[2]


@njit_no_refcount
def times(factor, one):
    return factor * one[0], factor * one[1], factor * one[2]


@njit_no_refcount
def divided(one, by):
    return one[0] / by, one[1] / by, one[2] / by


@njit_no_refcount
def cross(one, other):
    return (
        one[1] * other[2] - one[2] * other[1],
        one[2] * other[0] - one[0] * other[2],
        one[0] * other[1] - one[1] * other[0],
    )


@njit_no_refcount
def column(pose, c):
    """Return a column of the rotation of a pose (4, 4)."""
    return pose[0, c], pose[1, c], pose[2, c]


@njit_no_refcount
def point_of(points, block, lane):
    """Return a point of an avatar, avatar frame [m]. points: (b, 3, LANES)."""
    return points[block, 0, lane], points[block, 1, lane], points[block, 2, lane]


@njit_no_refcount
def rotate(pose, one):
    """Return a vector of the frame of a pose (4, 4) in the world."""
    return (
        pose[0, 0] * one[0] + pose[0, 1] * one[1] + pose[0, 2] * one[2],
        pose[1, 0] * one[0] + pose[1, 1] * one[1] + pose[1, 2] * one[2],
        pose[2, 0] * one[0] + pose[2, 1] * one[1] + pose[2, 2] * one[2],
    )


@njit_no_refcount
def placed(pose, shift, point):
    """Return a point placed by a pose, by the formula of `place`. shift: (3,), t - O [m]."""
    return plus(rotate(pose, point), shift)


@njit_no_refcount
def rotate_back(pose, one):
    """Return a vector of the world in the frame of a pose (4, 4)."""
    return (
        pose[0, 0] * one[0] + pose[1, 0] * one[1] + pose[2, 0] * one[2],
        pose[0, 1] * one[0] + pose[1, 1] * one[1] + pose[2, 1] * one[2],
        pose[0, 2] * one[0] + pose[1, 2] * one[1] + pose[2, 2] * one[2],
    )


@njit_no_refcount
def copy_pose(source, target):
    """Copy a pose (4, 4) to another array."""
    for r in range(4):
        for c in range(4):
            target[r, c] = source[r, c]


@nb.njit(nogil=True, cache=True)
def same_pose(one, other):
    """Return whether two poses (4, 4) have the same bits."""
    for r in range(4):
        for c in range(4):
            a, b = one[r, c], other[r, c]
            if a != b or np.signbit(a) != np.signbit(b):
                return False
    return True


@nb.njit(nogil=True, cache=True)
def translated(pose, way):
    """Return a new pose (4, 4), translated by a vector."""
    there = np.empty((4, 4))
    copy_pose(pose, there)
    for r in range(3):
        there[r, 3] += way[r]
    return there
