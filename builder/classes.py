"""The radius class of every point: what `local` and `border` need to know of its neighbours."""

import numpy as np
from numpy.typing import NDArray

from ..schemas.radius_model import LOCAL_CLASSES, RIM_BIT, local_radii
from .kernels.classes import nearest_of_all
from .octree import VoxelPoints

NEIGHBOURS = 6


def classify(points: VoxelPoints, step: float, models: tuple[str, ...]) -> tuple[NDArray[np.uint8], int]:
    """The class (n,) of each point of a voxel, and how many had too few neighbours within twice the largest radius."""
    distinct, back = np.unique(points.local, axis=0, return_inverse=True)
    limits = np.array([int(4 * (r / step) ** 2) for r in local_radii()], np.int64)
    best = np.empty((len(distinct), NEIGHBOURS), np.int64)
    nearest_of_all(distinct, limits[-1], NEIGHBOURS, best)
    farthest = np.where(best[:, -1] < 0, limits[-1] + 1, best[:, -1])
    classes = np.zeros(len(distinct), np.uint8)
    if "local" in models:
        classes |= np.minimum(np.searchsorted(limits, farthest), LOCAL_CLASSES - 1).astype(np.uint8)
    if "border" in models:
        classes |= np.where(best[:, 2] < 0, RIM_BIT, 0).astype(np.uint8)
    back = back.reshape(-1)
    return classes[back], int(np.count_nonzero((farthest > limits[-1])[back]))
