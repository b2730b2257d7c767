"""A path through several archives, and budgets of visits that several archives share."""

import math
import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from ...schemas.wire.answers import ContactsAnswers, Cost
from ...schemas.wire.columns import join
from ..archives.merge_answers import carried, limited, merged
from ..archives.rigid_transform import Pose
from ..avatars.avatar_model import AvatarModel
from ..queries.context.query_budget import NO_LIMIT, Effort
from ..queries.context.query_context import SceneData
from ..queries.path import part_stop, path_question
from ..runtime.stop_flag import NEVER, Stop

_A = TypeVar("_A", bound=Cost)
# Asks one archive about some rows of a request.
Ask = Callable[[SceneData, Effort, slice], _A]
# Pairs that `contacts` lists where no limit is given.
LISTED = 100


class Leg(NamedTuple):
    """A path through one archive. data: what it reads.  pose: archive to world, None: at the identity.

    first_source: which of the scene's sources the archive's first is.  poses: (k, 4, 4) in the archive's frame.
    """

    data: SceneData
    pose: Pose | None
    first_source: int
    poses: NDArray[np.float64]


def in_budget(ask: Ask[_A], data: SceneData, effort: Effort, visits: NDArray[np.int64]) -> _A:
    """What an archive answers with the node visits (k,) that others took off the budget of each pose.

    Poses that follow one another and have as much left are asked about together: nearly always all of those that no
    other archive has near it.
    """
    if effort.visits == NO_LIMIT or not len(visits):
        return ask(data, effort, slice(None))
    left = np.maximum(effort.visits - visits, 0)
    ends = [*(np.flatnonzero(np.diff(left)) + 1).tolist(), len(left)]
    starts = [0, *ends[:-1]]
    return join(
        [
            ask(data, effort._replace(visits=int(left[start])), slice(start, end))
            for start, end in zip(starts, ends, strict=True)
        ]
    )


def along(
    legs: Sequence[Leg], avatar: AvatarModel, op: str, parameters: dict[str, Any], stop: Stop = NEVER
) -> tuple[Callable[[int, int], Cost], int]:
    """Return what answers [start, stop) of a path through all archives, and how many answers there are.

    The time of a part, `stop.part_seconds`, is that of all archives together.
    """
    begin = time.perf_counter()
    # All poses are checked here, so that an error names one by its place on the path.
    asks = [path_question(leg.data, avatar, leg.poses, op, parameters, stop) for leg in legs]
    visits, budget_ms = parameters.get("budget_visits"), parameters.get("budget_ms")
    limit = parameters.get("limit")

    def ask_bounded(leg: Leg, start: int, spent: NDArray[np.int64], part: Stop | None) -> Cost:
        """Ask with what is left of the visits of each answer from `start` on, and of the time."""

        def ask(data: SceneData, effort: Effort, k: slice) -> Cost:
            # The motions of a path end where the next begin.
            own = leg.poses[start + k.start : start + k.stop + (op == "sweep")]
            options = parameters | {"budget_visits": effort.visits}
            if budget_ms is not None:
                options["budget_ms"] = max(0.0, budget_ms - (time.perf_counter() - begin) * 1e3)
            return path_question(data, avatar, own, op, options, stop)[0](0, k.stop - k.start, part)

        return in_budget(ask, leg.data, Effort(visits=int(visits or 0)), spent)

    def ask(start: int, end: int) -> Cost:
        spent = np.zeros(end - start, np.int64)
        # Without a limit each archive's own flag remains, which a budget may set.
        part = None if stop.part_seconds == math.inf else part_stop(stop, stop.part_seconds)
        answers: list[Cost] = []
        for leg, (ask_all, _) in zip(legs, asks, strict=True):
            if visits is None or end == start:
                found = ask_all(start, end, part)
            else:
                found = ask_bounded(leg, start, spent, part)
                spent += found.node_visits  # type: ignore[attr-defined]  # all answers have them
            answers.append(carried(found, leg.pose, leg.first_source))
        together = merged(answers)
        if isinstance(together, ContactsAnswers):
            return limited(together, LISTED if limit is None else limit)
        return together

    return ask, asks[0][1]
