"""Tolerance and budgets of a query.

Every query takes an `Effort`. Without a budget the work ends when the answer is exact, or known
within the tolerance. With a budget it also ends when the budget is spent; the answer is then still
correct. See NUMERICS.md case 30.
"""

import math
import time
from typing import NamedTuple

from ....schemas.errors import BadRequestError
from ....schemas.wire.requests import QuestionOptions
from ...kernels.core.stop_flag_checks import (
    NO_LIMIT as NO_LIMIT,  # no budget: more node visits than any request could make
)
from ...runtime.deadlines import stop_at
from ...runtime.stop_flag import NEVER, Stop

# Share of the remaining time that loads may take; the rest is for searching resident voxels.
LOAD_SHARE = 0.5
# Time after a budget's deadline in which searches that check the clock end by themselves, with the
# results so far; after it the stop flag ends everything [s].
GRACE = 0.05


class Effort(NamedTuple):
    """Limits on the cost of one request.

    tolerance: separation at which contact may already be reported, and largest distance between
    bounds [m]. The default 0 means exact, because no search that may stop early is as fast
    (`solidcloud accuracy`).
    visits: node visits a pose (ray, point, motion).
    deadline: on time.perf_counter()'s clock [s], inf for none.
    scan: voxels are used in passing, as on a sweep along a path, and should not displace others in
    the cache (eviction.py).
    share: of the cache, for the voxels held at a time. If not all fit, work counts depend on it;
    verdicts never do.
    stop: ends the work early once it is set; what was not examined by then is unknown.
    """

    tolerance: float = 0.0
    visits: int = NO_LIMIT
    deadline: float = math.inf
    scan: bool = False
    share: float = 1.0
    stop: Stop = NEVER

    @property
    def limited(self) -> bool:
        """Return whether there is a budget.

        `collide` and `distance` use best-first search only then. With only a tolerance they answer
        exactly, which takes a fraction of the time of a search that may stop early (`solidcloud
        accuracy`, knob "tolerance").
        """
        return self.visits < NO_LIMIT or self.deadline < math.inf

    @property
    def spent(self) -> bool:
        """Return whether the time is up or the request was stopped."""
        return bool(self.stop) or (self.deadline < math.inf and time.perf_counter() >= self.deadline)

    def loads_until(self) -> float:
        """Return the deadline of loads that begin now, on the same clock [s]; inf if none."""
        if self.deadline == math.inf:
            return math.inf
        now = time.perf_counter()
        return now + (self.deadline - now) * LOAD_SHARE


EXACT = Effort()


class EngineOptions(QuestionOptions, total=False):
    """Options of a query to a scene: those of the wire, and the caller's stop flag."""

    stop: Stop


def make_effort(
    tolerance: float = 0.0,
    budget_ms: float | None = None,
    budget_visits: int | None = None,
    stop: Stop = NEVER,
) -> Effort:
    """Make the effort of a request that starts now.

    tolerance: [m], finite and >= 0.
    budget_ms: time limit including waits for loads; None: no limit.
    budget_visits: limit in node visits a pose, independent of the clock; None: no limit.
    stop: the request's stop flag. A time budget sets it `GRACE` after its end, for kernels that do
    not check the clock; if it is NEVER, the effort gets a new flag. Raise BadRequestError.
    """
    if not 0 <= tolerance < math.inf:
        raise BadRequestError(f"tolerance is {tolerance}: expected a finite number of metres, 0 or more")
    if budget_ms is not None and not 0 <= budget_ms < math.inf:
        raise BadRequestError(f"budget_ms is {budget_ms}: expected milliseconds, 0 or more, or none")
    if budget_visits is not None and not 0 <= budget_visits <= NO_LIMIT:
        raise BadRequestError(f"budget_visits is {budget_visits}: expected node visits, 0 or more, or none")
    deadline = math.inf
    if budget_ms is not None:
        deadline = time.perf_counter() + budget_ms / 1e3
        stop = Stop() if stop is NEVER else stop
        stop_at(stop, deadline + GRACE, f"the request's budget of {budget_ms:g} ms was spent")
    visits = NO_LIMIT if budget_visits is None else int(budget_visits)
    return Effort(float(tolerance), visits, deadline, stop=stop)
