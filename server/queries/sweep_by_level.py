"""Motions that need no voxel of the scene, or only those behind the place where its level is first touched.

Nothing is touched before the level's cover spheres are, and where a representative is touched, a
point of the scene is.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from ...schemas.wire.answers import SweepAnswers, Verdict
from ..kernels.motion.sweep_segments import SweepProgress
from .context.level_of_detail import asked, level_budget, stoppable
from .context.query_budget import QueryBudget
from .context.query_context import LevelOfDetail, SceneData

# `tolerance` of a request that gives none [m].
DEFAULT_TOLERANCE = 1e-6
# Tolerance of a sweep through the level, as a share of the request's, and at least [m]: both of its
# bounds are then together within that of the request, and no time is spent on less than covers.
_LEVEL_SHARE, _LEVEL_LEAST = 0.25, 1e-4

# Function that sweeps through some data: data, pose_from, pose_to (k, 4, 4), tolerance [m], budget.
AskSweep = Callable[[SceneData, NDArray[np.float64], NDArray[np.float64], float, QueryBudget], SweepAnswers]


class SweepsByLevel:
    """Questions about the motions of one request to the scene's level of detail.

    before_loads: whether a motion is asked about before a voxel is loaded for it.
    """

    def __init__(self, data: SceneData, tolerance: float, budget: QueryBudget, ask: AskSweep) -> None:
        """Begin with no question asked.

        tolerance: of the request [m].
        """
        level = None if data.nothing_clear else data.level
        self._level = None if level is None else stoppable(level, budget)
        # Frames simulate with the tolerance of their effects: what is in memory must not matter there.
        self._toleranced = budget.tolerance > DEFAULT_TOLERANCE
        # A budget that does not wait for loads bounds absent voxels instead (late_sweep.py).
        self.before_loads = (
            level is not None and budget.late is None and (self._toleranced or level.settles_exact)
        )
        self._budget, self._ask = budget, ask
        self._within = max(tolerance * _LEVEL_SHARE, _LEVEL_LEAST)

    def find_clear(
        self, level: LevelOfDetail, budget: QueryBudget, first: NDArray[np.float64], last: NDArray[np.float64]
    ) -> SweepAnswers:
        """Return what cover spheres prove of motions: `lower` and CLEAR hold, nothing else does."""
        return self._ask(level.covers, first, last, self._within, level_budget(budget))

    def settle(
        self,
        which: NDArray[np.int64],
        first: NDArray[np.float64],
        last: NDArray[np.float64],
        progress: SweepProgress,
        proved: NDArray[np.float64],
        tolerance: float,
    ) -> NDArray[np.int64]:
        """Ask about the motions `which`, and return those that need no voxel; update `progress`.

        first, last: (k, 4, 4), world.  proved: see `_next_round`, written for motions in contact.
        Without a tolerance only a clear motion is settled, and nothing else changes.
        """
        level = self._level
        if level is None:
            return which[:0]
        found = asked(lambda: self.find_clear(level, self._budget, first[which], last[which]))
        if found is None:
            return which[:0]
        clear = found.verdict == Verdict.CLEAR
        progress.at[which[clear]] = 1.0
        if not self._toleranced:
            return which[clear]
        touch = which[~clear]
        lower = found.lower[~clear]
        progress.at[touch] = np.maximum(progress.at[touch], lower)
        exact = level_budget(self._budget)
        own = asked(lambda: self._ask(level.points, first[touch], last[touch], self._within, exact))
        if own is None:
            return which[clear]
        with np.errstate(invalid="ignore"):  # a motion that stands still: 0 times infinity
            near = progress.speed[touch] * (own.upper - lower) <= tolerance
        near &= np.isfinite(own.upper)
        touch = touch[near]
        progress.upper[touch], proved[touch] = own.upper[near], lower[near]
        progress.witness[touch, 0] = own.witness_avatar[near]
        progress.witness[touch, 1] = own.witness_cloud[near]
        return np.concatenate([which[clear], touch])


def cold_motions(
    data: SceneData, starts: NDArray[np.int64], rows: NDArray[np.int64], but: NDArray[np.bool_]
) -> NDArray[np.int64]:
    """Return the motions, ascending, with a voxel in their segment that is not resident; none of `but`."""
    absent = data.arrays.where[rows[: starts[-1]], 0] < 0
    if not absent.any():
        return np.empty(0, np.int64)
    cold = np.unique(np.repeat(np.arange(len(but)), np.diff(starts))[absent])
    return np.asarray(cold[~but[cold]])
