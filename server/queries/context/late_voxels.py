"""Voxels that a frame does not wait for: what proves it clear of them without a load.

A budget with `late` loads nothing. A voxel that is not in memory is bounded by the level of detail,
where that is in memory; else by its coarse bounds; else by its box. All points of a voxel lie within
the cover spheres of the level's voxels that divide it, so a pose that is clear of these is clear of
the voxel. Voxels that this does not settle are missing, and their loads are owed.
"""

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from ...avatars.avatar_model import AvatarModel
from ...kernels.collide.collide_poses import collide_poses
from ...kernels.collide.early_contact import CLEAR, UNKNOWN
from ...kernels.core.voxels_in_reach import VoxelsInReach
from .level_of_detail import asked, stoppable
from .query_budget import QueryBudget
from .query_context import LevelOfDetail, SceneData, as_held, check_request
from .unloaded_voxels import drop_clear_voxels


def drop_proved_voxels(
    data: SceneData,
    avatar: AvatarModel,
    poses: NDArray[np.float64],
    margin_units: int,
    budget: QueryBudget,
) -> Callable[[VoxelsInReach], VoxelsInReach]:
    """Return a function that removes from a reach the voxels that are absent and provably not in reach.

    It changes nothing for a budget that waits for loads.
    poses: (k, 4, 4) float64, those of the reach.  margin_units: part of the reach beyond the radii
    of avatar and scan, exact units.
    """
    coarse = drop_clear_voxels(data, avatar, poses)

    def drop(reach: VoxelsInReach) -> VoxelsInReach:
        if budget.late is None or not len(avatar.points):
            return reach
        reach = coarse(reach)
        rows = reach.rows[: reach.starts[-1]]
        absent = np.flatnonzero(data.arrays.where[rows, 0] < 0)
        if data.level is None or not len(absent) or budget.stop:
            return reach
        pose_of = np.repeat(np.arange(len(poses)), np.diff(reach.starts))
        level = stoppable(data.level, budget)
        pairs = pose_of[absent], rows[absent]
        clear = asked(lambda: _clear_of_level(level, avatar, poses, margin_units, *pairs, budget))
        if clear is None or not clear.any():
            return reach
        kept = np.ones(len(rows), bool)
        kept[absent[clear]] = False
        counts = np.bincount(pose_of[kept], minlength=len(poses))
        starts = np.concatenate([[0], np.cumsum(counts)])
        return reach._replace(starts=starts, rows=np.append(rows[kept], np.int64(-1)))

    return drop


def _clear_of_level(
    level: LevelOfDetail,
    avatar: AvatarModel,
    poses: NDArray[np.float64],
    margin_units: int,
    pose_of: NDArray[np.int64],
    rows: NDArray[np.int64],
    budget: QueryBudget,
) -> NDArray[np.bool_]:
    """Return which pairs (n,) of a pose and a voxel of the scene the level proves clear.

    pose_of, rows: (n,) number of the pose and row of the voxel.
    """
    covers = level.covers
    around = check_request(covers, avatar, poses, covers.radius_units + margin_units)
    parents = level.parents[around.rows[: around.starts[-1]]]
    parts = []
    for pose, row in zip(pose_of.tolist(), rows.tolist(), strict=True):
        begin, end = around.starts[pose], around.starts[pose + 1]
        parts.append(around.rows[begin:end][parents[begin:end] == row])
    starts = np.concatenate([[0], np.cumsum([len(part) for part in parts])])
    own = around._replace(
        scales=around.scales[pose_of],
        units=around.units[pose_of],
        starts=starts,
        rows=np.append(np.concatenate(parts), np.int64(-1)),
        boxes=around.boxes[pose_of],
        outside=around.outside[pose_of],
    )
    verdict, counts = np.full(len(rows), CLEAR, np.uint8), np.zeros((3, len(rows)), np.uint32)
    needed = np.unique(own.rows[:-1]).tolist()
    with covers.residency.hold(needed, -math.inf) as held:
        seen = as_held(covers, held, budget)
        which = np.arange(len(rows))
        collide_poses(poses[pose_of], avatar.arrays, seen.arrays, own, which, 0, verdict, counts)
    if covers.nothing_clear:
        verdict[:] = UNKNOWN
    return np.asarray(verdict == CLEAR)
