"""Budget and cost of a query, and the answer of a query that was stopped.

Every query takes a `QueryBudget`. Without a deadline the work ends when the answer is exact, or
known within the tolerance. A deadline is a stop flag that is set at that time: the same kernels end,
and the answer is still correct. See NUMERICS.md case 30.
"""

import math
import time
from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import numpy as np
from msgspec import structs
from numpy.typing import NDArray

from ....schemas.archive.units import UNITS_PER_METRE
from ....schemas.errors import BadRequestError
from ....schemas.wire.answers import Cost
from ....schemas.wire.question_rules import Question
from ...kernels.core.placed_avatar import MAX_REACH_UNITS
from ...residency.voxel_cache import HeldVoxels, VoxelCache
from ...runtime.stop_flag import NO_STOP, StopFlag, StoppedError, stop_at

_A = TypeVar("_A", bound=Cost)

# Share of the remaining time that loads may take; the rest is for searching resident voxels.
LOAD_SHARE = 0.5
# Where a share of the distance is allowed, this is allowed at any distance: near contact a share
# would be less than the lattice resolves [m].
LEAST_RELATIVE = 1e-3


class LateVoxels:
    """Voxels that a frame needs and does not wait for, because they are not in memory.

    count: number of voxels, counted by each query of the frame that lacks them. 0: all answers are
    those of a frame that waits.
    """

    __slots__ = ("count",)

    def __init__(self) -> None:
        self.count = 0


class QueryBudget(NamedTuple):
    """Limits on the cost of one request.

    tolerance: separation up to which contact may be reported, and allowed distance between bounds
    [m]. The default 0 means exact.
    relative: allowed distance between the bounds of a distance, as a share of the distance between
    the centres; a millimetre is allowed at any distance if it is above 0.
    deadline: on time.perf_counter()'s clock [s], inf for none. It sets `stop`.
    scan: voxels are used in passing, as on a sweep along a path, and should not displace others in
    the cache (eviction.py).
    share: share of the cache for the voxels held at a time. If not all fit, work counts depend on
    it; verdicts never do.
    stop: ends the work early once it is set; what was not examined by then is unknown.
    request: the flag of the whole request, which its deadline does not set: for its broad phase.
    late: None: voxels that are not in memory are loaded. Otherwise no load is waited for: such
    voxels are bounded (late_voxels.py), their loads are owed, and they are counted here.
    """

    tolerance: float = 0.0
    deadline: float = math.inf
    scan: bool = False
    share: float = 1.0
    stop: StopFlag = NO_STOP
    relative: float = 0.0
    late: LateVoxels | None = None
    request: StopFlag = NO_STOP

    @property
    def stopped(self) -> str:
        """Return why something else than its deadline stopped the request; "" if nothing did."""
        return self.stop.reason or self.request.reason

    @property
    def between_bounds(self) -> float:
        """Return the distance that two bounds may lie apart, however small the distance [m]."""
        return max(self.tolerance, LEAST_RELATIVE if self.relative > 0.0 else 0.0)

    @property
    def tolerance_units(self) -> int:
        """Return the tolerance in exact units, rounded down; at most the longest reach."""
        return math.floor(min(self.tolerance * UNITS_PER_METRE, float(MAX_REACH_UNITS)))

    def loads_until(self) -> float:
        """Return the deadline of loads that begin now, on the same clock [s]; inf if none.

        -inf: no load begins, and none is waited for.
        """
        if self.late is not None:
            return -math.inf
        if self.deadline == math.inf:
            return math.inf
        now = time.perf_counter()
        return now + (self.deadline - now) * LOAD_SHARE

    def lacked(self, voxels: int) -> None:
        """Count voxels that a query of a frame lacked, if it does not wait for them."""
        if self.late is not None:
            self.late.count += voxels


EXACT = QueryBudget()


def make_budget(
    tolerance: float = 0.0,
    relative_tolerance: float = 0.0,
    budget_ms: float | None = None,
    stop: StopFlag = NO_STOP,
) -> QueryBudget:
    """Make the budget of a request that starts now.

    tolerance: [m], finite and >= 0.  relative_tolerance: finite and >= 0.
    budget_ms: time limit including waits for loads; None: no limit.
    stop: the request's stop flag; a time limit sets a part of it. Raise BadRequestError.
    """
    if not 0 <= tolerance < math.inf:
        raise BadRequestError(f"tolerance is {tolerance}: expected a finite number of metres, 0 or more")
    if not 0 <= relative_tolerance < math.inf:
        raise BadRequestError(
            f"relative_tolerance is {relative_tolerance}: expected a finite share, 0 or more, as 0.3 for 30 %"
        )
    if budget_ms is not None and not 0 <= budget_ms < math.inf:
        raise BadRequestError(f"budget_ms is {budget_ms}: expected milliseconds, 0 or more, or none")
    budget = QueryBudget(float(tolerance), stop=stop, relative=float(relative_tolerance), request=stop)
    return budget if budget_ms is None else with_deadline(budget, time.perf_counter() + budget_ms / 1e3)


def with_deadline(budget: QueryBudget, deadline: float) -> QueryBudget:
    """Return the same budget with this deadline, on time.perf_counter()'s clock [s]."""
    stop = budget.request.part()
    stop_at(stop, deadline, "")
    return budget._replace(deadline=deadline, stop=stop)


class CostCounter:
    """Cost of one request, summed over its holds: the fields of `Cost`. Not thread-safe."""

    __slots__ = ("_keys", "_residency", "begin", "faults", "hits", "late", "loaded", "misses", "waited")

    def __init__(self, begin: float, residency: VoxelCache, keys: NDArray[np.uint64]) -> None:
        """Begin with zero cost.

        begin: start time on time.perf_counter()'s clock [s].  keys: (v,) of the voxels, by their
        row in the index.
        """
        self.begin, self._residency, self._keys = begin, residency, keys
        self.hits = self.misses = 0
        self.loaded = 0  # voxels that the request loaded for later holds: they are not hits
        self.waited = 0.0
        self.faults: dict[str, None] = {}
        self.late: dict[int, None] = {}

    def add(self, held: HeldVoxels, again: int = 0) -> None:
        """Add a hold. again: number of its hits on voxels that the request has held before."""
        found = held.hits - again - self.loaded
        self.hits, self.loaded = self.hits + max(0, found), max(0, -found)
        self.misses += held.misses
        self.waited += held.waited
        self.faults.update(dict.fromkeys(held.faults))
        self.late.update(dict.fromkeys(held.late))

    def add_cost(self, cost: Cost) -> None:
        """Add the cost of another query of the same data."""
        rows = [int(self._keys.searchsorted(key)) for key in cost.late]
        self.add(HeldVoxels(cost.hits, cost.misses, cost.faults, tuple(rows), cost.wait_seconds))

    def of_level(self, residency: VoxelCache) -> "CostCounter":
        """Return a counter for a query of the level of the same scene, for `add_level`."""
        return CostCounter(self.begin, residency, self._keys)

    def add_level(self, cost: "CostCounter") -> None:
        """Add the waits and faults of a query of the level. Its voxels are not those of the scene."""
        self.waited += cost.waited
        self.faults.update(cost.faults)

    def fields(self) -> dict[str, Any]:
        """Return the fields of `Cost`; call it when the answer is complete."""
        return {
            "engine_seconds": time.perf_counter() - self.begin,
            "hits": self.hits,
            "misses": self.misses,
            "resident": self._residency.resident,
            "resident_bytes": self._residency.resident_bytes,
            "faults": tuple(self.faults),
            "wait_seconds": self.waited,
            "late": tuple(self._keys[list(self.late)].tolist()) if self.late else (),
        }


def ask_until_stopped(question: Question[_A], k: int, budget: QueryBudget, ask: Callable[[], _A]) -> _A:
    """Run a query of k items with `ask`. Add the reason to the answer if the request is stopped."""
    try:
        answers = ask()
    except StoppedError:
        return unknown_answers(question, k, budget)
    return structs.replace(answers, stopped=budget.stopped) if budget.stopped else answers


def unknown_answers(question: Question[_A], k: int, budget: QueryBudget) -> _A:
    """Return `Question.unknown` for the k items of a stopped request, with the reason."""
    answers = question.unknown(k, bounded=budget.tolerance > 0.0)
    return structs.replace(answers, stopped=budget.stopped)
