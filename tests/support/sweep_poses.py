"""Poses and walls for tests of `sweep`."""

import archive_cases
import numpy as np
from numpy.typing import NDArray


def at(x: float, y: float = 0.0, z: float = 0.0) -> NDArray[np.float64]:
    """Return the pose (1, 4, 4) of a translation."""
    return archive_cases.pose_of(np.eye(3), np.array([x, y, z]))[None]


def turn_z(angle: float) -> NDArray[np.float64]:
    """Return a rotation (3, 3) about z."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def wall(size: float, apart: float) -> NDArray[np.float64]:
    """Return points (n, 3) of a square in the plane x = 0."""
    side = np.arange(-size / 2, size / 2 + apart / 2, apart)
    y, z = np.meshgrid(side, side)
    return np.stack([np.zeros(y.size), y.ravel(), z.ravel()], axis=1)
