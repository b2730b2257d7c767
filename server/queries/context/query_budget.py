"""How much an answer may cost: tolerance and budgets (DESIGN.md, "Verdicts, bounds and budgets"; NUMERICS.md case 30).

Every question takes an `Effort`. Without a budget the work ends when the answer is exact, or known within the
tolerance. With one it ends there or when the budget is spent, whichever is first; what is said then is still true.
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

# Of the time left, what loads may take: what is resident is to be searched as well.
LOAD_SHARE = 0.5
# After the deadline of a budget, searches that look at the clock have so long to end by themselves, with what they know
# by then; after that the stop flag ends everything [s].
GRACE = 0.05


class Effort(NamedTuple):
    """What one request may cost.

    tolerance: how early contact may be called, and how far bounds may lie apart [m]; 0, the default: exact, for no
    search that may stop early is as fast (`solidcloud accuracy`).
    visits: node visits a pose (ray, point, motion).  deadline: on time.perf_counter()'s clock [s], inf: none.
    scan: what is looked at is passed by, as on a sweep along a path: it is not to wash the cache (eviction.py).
    share: of the cache, what may be held at a time. Counts of work depend on it, where not all fits; no verdict does.
    stop: ends the work early once it is set; what was not looked at then is unknown.
    """

    tolerance: float = 0.0
    visits: int = NO_LIMIT
    deadline: float = math.inf
    scan: bool = False
    share: float = 1.0
    stop: Stop = NEVER

    @property
    def limited(self) -> bool:
        """Whether there is a budget.

        `collide` and `distance` search by priority only then. A tolerance alone they answer exactly, for that takes a
        fraction of the time of a search that may stop early (`solidcloud accuracy`, knob "tolerance").
        """
        return self.visits < NO_LIMIT or self.deadline < math.inf

    @property
    def spent(self) -> bool:
        """Whether the time is up, or the request was stopped."""
        return bool(self.stop) or (self.deadline < math.inf and time.perf_counter() >= self.deadline)

    def loads_until(self) -> float:
        """Until when loads that begin now may go on, on the same clock [s]; inf: until they are done."""
        if self.deadline == math.inf:
            return math.inf
        now = time.perf_counter()
        return now + (self.deadline - now) * LOAD_SHARE


EXACT = Effort()


class EngineOptions(QuestionOptions, total=False):
    """The options of a question to a scene: those of the wire, and the stop flag of whoever asks."""

    stop: Stop


def make_effort(
    tolerance: float = 0.0,
    budget_ms: float | None = None,
    budget_visits: int | None = None,
    stop: Stop = NEVER,
) -> Effort:
    """The effort of a request that starts now.

    tolerance: [m], finite and >= 0.  budget_ms: waiting for loads and work together; None: no limit.
    budget_visits: its twin that needs no clock, node visits a pose; None: no limit.  stop: the request's stop flag. A
    budget of time sets it `GRACE` after its end, for kernels that do not look at the clock; where it is NEVER, the
    effort has one of its own. Raises BadRequestError.
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
