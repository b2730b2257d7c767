"""Surface normals by brute force: covariance and eigenvectors with numpy, sums in Python's integers."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray


class Found(NamedTuple):
    """Result for one point.

    count: its neighbours, including itself. values: (3,) eigenvalues, ascending, of trace 1.

    normal: (3,) unit eigenvector of the least eigenvalue, of either sign.
    """

    count: int
    values: NDArray[np.float64]
    normal: NDArray[np.float64]


def neighbours(points: NDArray[np.int64], at: NDArray[np.int64], square: int) -> NDArray[np.int64]:
    """Return the differences (n, 3) from `at` to the points within a square [steps]."""
    away = points - at
    return away[(away.astype(object) ** 2).sum(axis=1) <= square]


def find(points: NDArray[np.int64], at: NDArray[np.int64], square: int) -> Found | None:
    """Return the surface through the points (n, 3) within a square [steps] of a point.

    Returns None if all coincide or there are none.
    """
    away = neighbours(points, at, square)
    if not len(away) or not (away != away[0]).any():
        return None
    spread = np.cov(away.T.astype(np.float64), bias=True)
    values, vectors = np.linalg.eigh(spread / np.trace(spread))
    return Found(len(away), values, vectors[:, 0])


def angle(one: NDArray[np.float64], other: NDArray[np.float64]) -> float:
    """Return the angle between two directions, regardless of their signs [degrees]."""
    return float(np.degrees(np.arcsin(min(1.0, float(np.sqrt((np.cross(one, other) ** 2).sum()))))))
