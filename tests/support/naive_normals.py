"""Brute force for surface normals: covariance and eigenvectors with numpy, sums in Python's integers."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray


class Found(NamedTuple):
    """Of one point. count: its neighbours, itself included.  values: (3,) eigenvalues, ascending, of trace 1.

    normal: (3,) unit eigenvector of the least, either side.
    """

    count: int
    values: NDArray[np.float64]
    normal: NDArray[np.float64]


def neighbours(points: NDArray[np.int64], at: NDArray[np.int64], square: int) -> NDArray[np.int64]:
    """Differences (n, 3) from `at` to the points within a square [steps]."""
    away = points - at
    return away[(away.astype(object) ** 2).sum(axis=1) <= square]


def find(points: NDArray[np.int64], at: NDArray[np.int64], square: int) -> Found | None:
    """The surface through the points (n, 3) within a square [steps] of one; None: all in one place, or none."""
    away = neighbours(points, at, square)
    if not len(away) or not (away != away[0]).any():
        return None
    spread = np.cov(away.T.astype(np.float64), bias=True)
    values, vectors = np.linalg.eigh(spread / np.trace(spread))
    return Found(len(away), values, vectors[:, 0])


def angle(one: NDArray[np.float64], other: NDArray[np.float64]) -> float:
    """Between two directions, either side of each [degrees]."""
    return float(np.degrees(np.arcsin(min(1.0, float(np.sqrt((np.cross(one, other) ** 2).sum()))))))
