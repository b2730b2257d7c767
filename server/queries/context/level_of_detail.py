"""Level of detail of a scene: which of its poses need no voxel of the scene itself.

A level (schemas/archive/level.py) holds about a thirtieth of an archive's points. Where voxels of
the archive are not in memory, its representatives are asked first. All points lie within their
cover spheres, so a pose that is clear of these is clear. The representatives are points of the
archive, so a pair with one of them is a pair of the scene. Poses that this does not settle are
answered from the voxels themselves.
"""

import math
import time
from collections.abc import Callable
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from ....schemas.archive.archive import Archive
from ....schemas.archive.level import cover_units, halvings_between
from ....schemas.archive.voxel_grid import voxel_keys
from ....schemas.errors import BadRequestError, TooLargeError
from ...kernels.core.voxels_in_reach import VoxelsInReach
from ...residency.voxel_cache import VoxelCache
from ...runtime.stop_flag import StoppedError
from .query_budget import QueryBudget, with_deadline
from .query_context import LevelOfDetail, SceneData, make_scene_data, with_stop

_A = TypeVar("_A")

# Time after a request's deadline in which the level is asked about what is still open [s]: a load of
# one of its voxels and a few milliseconds of search.
LEVEL_GRACE = 0.01


class LevelData(NamedTuple):
    """Opened level, before a radius model is chosen.

    data: of its archive.  occurs: (32,) bool, cover classes that a representative has.
    settles_exact, parents: see `LevelOfDetail`.
    """

    data: SceneData
    occurs: NDArray[np.bool_]
    settles_exact: bool
    parents: NDArray[np.int64]


def open_level_data(
    archive: Archive, residency: VoxelCache, described: Archive, *, settles_exact: bool
) -> LevelData:
    """Return the data of a level whose voxels `residency` holds. described: the archive of the level."""
    halvings = halvings_between(archive.header.lattice, described.header.lattice)
    keys = voxel_keys(archive.coordinates >> halvings)
    parents = np.searchsorted(described.voxels["key"], keys)
    occurs = archive.header.radius_counts > 0
    return LevelData(make_scene_data(archive, residency), occurs, settles_exact, parents)


def with_level(data: SceneData, level: LevelData | None) -> SceneData:
    """Return the same scene with a level whose spheres are made for the scene's radii."""
    if level is None:
        return data
    largest = data.radius_units
    smallest = largest - int(data.arrays.radius_deficit.max())
    radii = largest + cover_units()
    top = int(radii[level.occurs].max())
    own = level.data.arrays
    covers = level.data._replace(
        arrays=own._replace(radius_deficit=np.maximum(top - radii, 0)), radius_units=top
    )
    points = level.data._replace(
        arrays=own._replace(radius_deficit=np.zeros(1, np.int64)), radius_units=smallest
    )
    return data._replace(level=LevelOfDetail(covers, points, level.settles_exact, level.parents))


class SettledPoses:
    """Poses of one request that its scene's level settles.

    settled: (k,) bool, poses whose voxels need not be examined.
    """

    def __init__(
        self,
        data: SceneData,
        poses: NDArray[np.float64],
        budget: QueryBudget,
        ask: Callable[[LevelOfDetail, NDArray[np.int64]], NDArray[np.bool_]],
    ) -> None:
        """Begin with no pose settled.

        ask: function that asks the level about the poses of some numbers and returns which of them
        it settles.
        """
        self.settled = np.zeros(len(poses), bool)
        self._asked = np.zeros(len(poses), bool)
        self._where = data.residency.where
        level = data.level
        wanted = level is not None and (budget.tolerance > 0 or budget.relative > 0 or level.settles_exact)
        # A frame that does not wait has no voxels in reach that the level proves clear (late_voxels.py).
        self._level = level if wanted and budget.late is None else None
        if self._level is not None:
            self._level = stoppable(self._level, budget)
        self._ask = ask

    def drop(self, reach: VoxelsInReach) -> VoxelsInReach:
        """Ask about poses with a voxel in reach that is not resident; return the reach without those settled."""
        if self._level is None:
            return reach
        rows = reach.rows[: reach.starts[-1]]
        absent = self._where[rows, 0] < 0
        if absent.any():
            pose_of = np.repeat(np.arange(len(self.settled)), np.diff(reach.starts))
            cold = np.zeros(len(self.settled), bool)
            cold[pose_of[absent]] = True
            which = np.flatnonzero(cold & ~self._asked)
            self._asked[which] = True
            if len(which):
                self.settled[which] = self._answer(which)
        if not self.settled.any():
            return reach
        held = np.where(self.settled, 0, np.diff(reach.starts))
        starts = np.concatenate([[0], np.cumsum(held)])
        kept = ~np.repeat(self.settled, np.diff(reach.starts))
        return reach._replace(starts=starts, rows=np.append(rows[kept], np.int64(-1)))

    def _answer(self, which: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Return which poses the level settles."""
        level = self._level
        assert level is not None
        found = asked(lambda: self._ask(level, which))
        return np.zeros(len(which), bool) if found is None else found


def asked(ask: Callable[[], _A]) -> _A | None:
    """Return what a query of the level finds; None if its spheres reach too far, or it was stopped.

    The scene has accepted the request. The cover spheres are larger than the scene's.
    """
    try:
        return ask()
    except (BadRequestError, TooLargeError, StoppedError):
        return None


def stoppable(level: LevelOfDetail, budget: QueryBudget) -> LevelOfDetail:
    """Return the same level for the broad phase of a request."""
    covers, points = (with_stop(data, budget.request) for data in (level.covers, level.points))
    return level._replace(covers=covers, points=points)


def level_budget(budget: QueryBudget) -> QueryBudget:
    """Return the budget of an exact query of the level for a request with `budget`."""
    return budget._replace(tolerance=0.0, relative=0.0, share=1.0, late=None)


def ask_after_deadline(
    data: SceneData, budget: QueryBudget, ask: Callable[[LevelOfDetail, QueryBudget], _A]
) -> _A | None:
    """Ask the level, in a budget of its own, about what a request leaves open at its deadline.

    Return None without a deadline or a level, if something else stopped the request, or as `asked`.
    """
    if data.level is None or budget.deadline == math.inf or budget.stopped:
        return None
    own = with_deadline(budget, max(budget.deadline, time.perf_counter()) + LEVEL_GRACE)
    level = stoppable(data.level, own)
    return asked(lambda: ask(level, own))
