"""Voxels that are not in memory are bounded before a search, which then examines only the others."""

import numpy as np
from numpy.typing import NDArray

from ...avatars.avatar_model import AvatarModel
from ...kernels.core.voxels_in_reach import VoxelsInReach
from ...kernels.nearest.missing_voxels import split_missing
from ...residency.voxel_cache import HeldVoxels
from .query_context import SceneData


def bound_missing(
    data: SceneData,
    held: HeldVoxels,
    avatar: AvatarModel,
    poses: NDArray[np.float64],
    part: VoxelsInReach,
    which: NDArray[np.int64],
    missing_bound: NDArray[np.float64],
    counts: NDArray[np.uint32],
) -> VoxelsInReach:
    """Return `part` without the voxels that are not resident; `part` itself if all are.

    data: as held.  avatar: not empty.  part, which: a piece of a request (`pieces`).
    Adds the numbers of these voxels to counts[0] (3, k), and lowers missing_bound (k,) [steps] to
    lower bounds of the distance of the avatar's centres from them.
    """
    if not held.late and not held.faults:
        return part
    starts, rows = np.empty_like(part.starts), np.empty(max(1, int(part.starts[-1])), np.int64)
    split_missing(
        poses, avatar.arrays, data.arrays, data.broad, part, which, starts, rows, missing_bound, counts
    )
    return part._replace(starts=starts, rows=rows)
