"""First hits of rays and points, bounded by the level of detail where voxels are not in memory.

A representative is a point of the scene, so the first hit of the scene is no farther than that of
the representatives. All points lie within their cover spheres, so it is no nearer than the first
hit of these.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...kernels.rays.rays import ClosestHits
from .level_of_detail import asked, stoppable
from .query_budget import QueryBudget
from .query_context import LevelOfDetail, SceneData


class LevelHits(NamedTuple):
    """First hits of n rays or points, as far as the level knows them [exact units].

    best: those of the representatives.  lower: (n,) float64, lower bounds of those of the scene.
    """

    best: ClosestHits
    lower: NDArray[np.float64]


# Function that asks the level about the rays or points of some numbers.
AskLevel = Callable[[LevelOfDetail, NDArray[np.int64]], LevelHits]


def found_units(best: ClosestHits) -> NDArray[np.float64]:
    """Return the distances found (k,) [exact units]; inf for none."""
    square = best.square
    return np.asarray(np.where(square >= 0, np.sqrt(np.maximum(square, 0).astype(np.float64)), best.value))


class HitsByLevel:
    """Rays or points of one request about which the level is asked, each at most once.

    before_loads: whether a ray is asked about before a voxel is loaded for it.
    clear_until: (k,) float64, nothing is nearer than this [exact units]; 0 where the level was not asked.
    """

    def __init__(
        self,
        data: SceneData,
        k: int,
        reach_units: int,
        budget: QueryBudget,
        allowed: tuple[float, float],
        ask: AskLevel,
    ) -> None:
        """Begin with k rays or points, none of them asked about.

        allowed: distance of two bounds [exact units], and the same as a share of the distance.
        """
        level = None if data.nothing_clear else data.level
        self._level = None if level is None else stoppable(level, budget)
        # An exact answer nearly always needs the voxel of the hit: the level would be read in addition.
        self.before_loads = level is not None and max(allowed) > 0.0 and budget.late is None
        self._late = budget.deadline < math.inf
        self._asked = np.zeros(k, bool)
        self.clear_until = np.zeros(k)
        self._reach, self._allowed, self._ask = float(reach_units), allowed, ask

    def forget(self, begin: int, end: int) -> None:
        """Allow to ask about the rays [begin, end) again: what was found is lost."""
        self._asked[begin:end] = False
        self.clear_until[begin:end] = 0.0

    def settle(self, begin: int, rows: NDArray[np.int64], part: ClosestHits) -> NDArray[np.int64]:
        """Ask about rays, and return those that need no voxel: their bounds are close enough.

        rows: rows in `part`, whose first is ray `begin`. The results of the rays returned are
        updated in `part`.
        """
        rows = rows[~self._asked[begin + rows]]
        self._asked[begin + rows] = True
        found = self._find(begin + rows)
        if found is None:
            return rows[:0]
        self.clear_until[begin + rows] = found.lower
        near = np.minimum(found_units(part)[rows], found_units(found.best))
        low = np.minimum(part.unseen[rows], found.lower)
        hit = np.isfinite(near)
        with np.errstate(invalid="ignore"):  # inf - inf where nothing is hit
            most = np.maximum(self._allowed[0], self._allowed[1] * low)
            close = (low > near) | ((near - low <= most) & (most > 0.0))
        enough = np.where(hit, close, low > self._reach)
        chosen = rows[enough]
        _merge(part, chosen, found, enough)
        part.unseen[chosen] = low[enough]
        return chosen

    def bound_late(self, best: ClosestHits) -> None:
        """Ask about rays that a deadline left unfinished; narrow their bounds in `best`."""
        if self._level is None or not self._late:
            return
        unseen = best.unseen <= np.minimum(found_units(best), self._reach)
        rows = np.flatnonzero(unseen & ~self._asked)
        found = self._find(rows)
        if found is not None:
            _merge(best, rows, found, np.ones(len(rows), bool))
            best.unseen[rows] = np.maximum(best.unseen[rows], found.lower)

    def _find(self, rays: NDArray[np.int64]) -> LevelHits | None:
        """Return what the level knows of rays; None if it cannot be asked."""
        level, ask = self._level, self._ask
        if level is None or not len(rays):
            return None
        return asked(lambda: ask(level, rays))


def _merge(best: ClosestHits, rows: NDArray[np.int64], found: LevelHits, which: NDArray[np.bool_]) -> None:
    """Replace hits of `rows` by those that the level found, for its rays `which`, where these are nearer."""
    own = found.best
    nearer = found_units(own)[which] < found_units(best)[rows]
    at = rows[nearer]
    for column, values in ((best.value, own.value), (best.square, own.square), (best.lattice, own.lattice)):
        column[at] = values[which][nearer]
