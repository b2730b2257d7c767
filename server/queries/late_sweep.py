"""Bounds of a motion by voxels that are not in memory, for frames that do not wait.

`sweep` sets these voxels aside. They end the motion where the first of them may be touched: by the
cover spheres of the level of detail, if that is in memory; else by the voxel's box, by conservative
advancement. late_voxels.py does the same for poses.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...schemas.archive.units import UNITS_PER_METRE
from ...schemas.wire.answers import SweepAnswers
from ..avatars.avatar_model import AvatarModel
from ..kernels.core.voxels_in_reach import VoxelsInReach
from ..kernels.motion.sweep_resident import motion_bounds, pose_between
from ..kernels.nearest.missing_voxels import split_missing
from .context.level_of_detail import asked, stoppable
from .context.query_budget import QueryBudget
from .context.query_context import SceneData

# Limit of advances of one motion, and the least share of the motion that an advance must gain.
_MAX_ADVANCES, _MIN_ADVANCE = 16, 1e-3
# Rounding of placed points at both ends of an advance [exact units], besides `slip`.
_ROUNDING = 4.0


class Motions(NamedTuple):
    """Motions of a sweep, with the dataset's origin at zero.

    first, last: (k, 4, 4).  scales, units, loose: (k,), as in `advance_segments`.  box: of the avatar.
    """

    first: NDArray[np.float64]
    last: NDArray[np.float64]
    scales: NDArray[np.float64]
    units: NDArray[np.int64]
    loose: NDArray[np.float64]
    box: NDArray[np.float64]


class AbsentVoxels:
    """Voxels in reach of the motions of one sweep that are not in memory.

    rows: found so far.  only: (v,) mask of the voxels that the sweep considers; None: all.
    """

    def __init__(self, only: NDArray[np.bool_] | None = None) -> None:
        self.rows: set[int] = set()
        self._only = only

    @property
    def restricted(self) -> bool:
        """Return whether only some voxels count; the caller then bounds the motion by those set aside."""
        return self._only is not None

    def set_aside(
        self, starts: NDArray[np.int64], rows: NDArray[np.int64], where: NDArray[np.int64]
    ) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return starts (k + 1,) and rows of planned segments without the voxels that are absent."""
        listed = rows[: starts[-1]]
        wanted = np.ones(len(listed), bool) if self._only is None else self._only[listed]
        absent = wanted & (where[listed, 0] < 0)
        self.rows.update(listed[absent].tolist())
        kept = wanted & ~absent
        if kept.all():
            return starts, rows
        before = np.concatenate([[0], np.cumsum(kept)])
        return before[starts], np.append(listed[kept], np.int64(-1))


def clear_until(
    data: SceneData,
    avatar: AvatarModel,
    motions: Motions,
    absent: AbsentVoxels,
    budget: QueryBudget,
    sweep_level: Callable[[SceneData, AbsentVoxels], SweepAnswers],
) -> NDArray[np.float64]:
    """Return the fraction (k,) up to which no absent voxel touches on each motion.

    data: with its origin at zero.  sweep_level: sweeps the level's cover spheres on the same
    motions, with its own absent voxels.
    """
    until, rest = np.ones(len(motions.first)), np.array(sorted(absent.rows), np.int64)
    if not len(rest):
        return until
    level = data.level
    if level is not None and not budget.stop:
        asked_rows: NDArray[np.bool_] = np.zeros(len(data.arrays.where), bool)
        asked_rows[rest] = True
        own = AbsentVoxels(asked_rows[level.parents])
        covers = stoppable(level, budget).covers
        found = asked(lambda: sweep_level(covers, own))
        if found is not None and not covers.nothing_clear:
            until = np.minimum(until, found.lower)
            lacking = np.array(sorted(own.rows), np.int64)
            rest = np.unique(level.parents[lacking])
            with covers.residency.hold(lacking.tolist(), -math.inf):  # their loads are owed
                pass
    if len(rest):
        until = np.minimum(until, _clear_by_bounds(data, avatar, motions, rest, budget))
    return until


def _clear_by_bounds(
    data: SceneData, avatar: AvatarModel, motions: Motions, rows: NDArray[np.int64], budget: QueryBudget
) -> NDArray[np.float64]:
    """Return the fraction (k,) up to which voxels are proved clear by their boxes.

    An advance is as long as the gap to the voxels takes at the motion's greatest speed.
    """
    where = data.arrays.where.copy()  # one of them may have been loaded since
    where[rows] = -1
    arrays = data.arrays._replace(where=where)
    starts, one, origin = np.array([0, len(rows)]), np.zeros(1, np.int64), np.zeros(3)
    left, pose = (np.empty_like(starts), np.empty_like(rows)), np.empty((1, 4, 4))
    until = np.zeros(len(motions.first))
    for i, (first, last) in enumerate(zip(motions.first, motions.last, strict=True)):
        speed, slip = motion_bounds(first, last, motions.box)
        held = float(motions.units[i]) + _ROUNDING + 2.0 * slip * UNITS_PER_METRE + float(motions.loose[i])
        at = slice(i, i + 1)
        reach = VoxelsInReach(
            motions.scales[at], motions.units[at], starts, rows, np.zeros((1, 2, 3)), np.zeros(1, bool)
        )
        for _ in range(_MAX_ADVANCES):
            pose_between(first, last, until[i], motions.box, origin, pose[0])
            bound, counts = np.full(1, math.inf), np.zeros((3, 1), np.uint32)
            split_missing(pose, avatar.arrays, arrays, data.broad, reach, one, *left, bound, counts)
            gap = (bound[0] * arrays.units_per_step * (1.0 - 1e-12) - held) / UNITS_PER_METRE
            if gap <= 0.0 or budget.stop:
                break
            gain = gap / speed * (1.0 - 1e-9) if speed > 0.0 else 1.0
            until[i] = min(1.0, until[i] + gain)
            if until[i] >= 1.0 or gain < _MIN_ADVANCE:
                break
    return until
