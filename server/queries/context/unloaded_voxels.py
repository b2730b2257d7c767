"""Voxels that are not in memory: what is known of them without a load.

Coarse bounds may prove that a pose is clear of a voxel, which then need not be loaded. A voxel that
a hold lacks is bounded before the search, which then examines only the others.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from ...avatars.avatar_model import AvatarModel
from ...kernels.collide.coarse_clearance import CoarseArrays
from ...kernels.core.voxels_in_reach import VoxelsInReach
from ...kernels.nearest.missing_voxels import split_missing
from ...residency.coarse_bounds import drop_clear_pairs
from ...residency.voxel_states import HeldVoxels
from .query_budget import QueryBudget
from .query_context import SceneData

# Pairs of pose and voxel bounded by nodes after a deadline: some microseconds each.
MAX_LATE_PAIRS = 1024
# Coarse bounds of no voxel.
NO_COARSE = CoarseArrays(
    np.empty(0, np.float32), np.empty(0, np.int32), np.empty(0, np.int32), np.empty(0, np.int32)
)


def drop_clear_voxels(
    data: SceneData, avatar: AvatarModel, poses: NDArray[np.float64]
) -> Callable[[VoxelsInReach], VoxelsInReach]:
    """Return a function that removes from a reach what coarse bounds prove clear, for `collide`.

    poses: (k, 4, 4) float64, those of the reach.
    """

    def drop(reach: VoxelsInReach) -> VoxelsInReach:
        if data.coarse is None or not len(avatar.points):
            return reach
        return drop_clear_pairs(data.arrays, data.coarse.arrays, avatar.arrays, poses, reach)[0]

    return drop


def bound_missing(
    data: SceneData,
    held: HeldVoxels,
    avatar: AvatarModel,
    poses: NDArray[np.float64],
    part: VoxelsInReach,
    which: NDArray[np.int64],
    missing_bound: NDArray[np.float64],
    counts: NDArray[np.uint32],
    budget: QueryBudget,
) -> VoxelsInReach:
    """Return `part` without the voxels that are not resident; `part` itself if all are.

    data: as held.  avatar: not empty.  part, which: a piece of a request (`pieces`).
    Adds the numbers of these voxels to counts[0] (3, k), and lowers missing_bound (k,) [steps] to
    lower bounds of the distance of the avatar's centres from them.
    """
    if not held.late and not held.faults:
        return part
    # When a deadline has passed, no more time is spent on nodes than on the load of a voxel.
    hurried = budget.deadline < np.inf and part.starts[-1] > MAX_LATE_PAIRS
    coarse = NO_COARSE if data.coarse is None or hurried else data.coarse.arrays
    starts, rows = np.empty_like(part.starts), np.empty(max(1, int(part.starts[-1])), np.int64)
    split_missing(
        poses,
        avatar.arrays,
        data.arrays,
        data.broad,
        coarse,
        part,
        which,
        starts,
        rows,
        missing_bound,
        counts,
    )
    return part._replace(starts=starts, rows=rows)
