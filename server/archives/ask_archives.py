"""Queries over all archives of a scene: each is queried in its own frame, and answers are merged.

A pose is in contact if it touches any archive. Otherwise it is unknown if any archive's verdict is
unknown, and clear if all archives are clear. It is `outside` if it is outside of all archives. A
budget is shared by all archives: each gets what the archives before it left. With one archive at
the identity, nothing is transformed or merged.
"""

import math
import time
from collections.abc import Callable, Generator, Iterator, Sequence
from functools import partial
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from ...schemas.wire.answers import ContactsAnswers, Cost, Part
from ...schemas.wire.question_rules import Question
from ...schemas.wire.question_table import QUESTIONS, join_answers
from ..avatars.avatar_model import AvatarModel
from ..queries.context.query_budget import NO_LIMIT, QueryBudget, ask_until_stopped, make_budget
from ..queries.context.query_context import SceneData, with_stop
from ..queries.path import part_stop, path_question
from ..runtime.stop_flag import NO_STOP, StopFlag
from .archive_generation import ArchiveGeneration
from .merge_answers import answers_in_world, limit_pairs, merge_answers
from .placed_archive import PlacedArchive
from .rigid_transform import Pose

_A = TypeVar("_A", bound=Cost)
# Range of rows of a request; None: all rows.
Rows = slice | None
# Function that queries one archive for some rows of a request.
AskRows = Callable[[SceneData, QueryBudget, Rows], _A]
# Items of a request in the frame of one archive, column by column, and whether the voxels near them
# are used in passing (`QueryBudget.scan`).
PlacedItems = tuple[Sequence[Any], bool]
PlaceItems = Callable[[PlacedArchive, ArchiveGeneration], PlacedItems]
# Pairs that `contacts` lists per pose by default.
DEFAULT_LIMIT = 100


class PathLeg(NamedTuple):
    """All poses of a path in the frame of one archive.

    data: of the archive.  pose: (4, 4), archive to world; None: the identity.
    first_source: number of the archive's first source among those of the scene.
    poses: (k, 4, 4), avatar to archive.
    """

    data: SceneData
    pose: Pose | None
    first_source: int
    poses: NDArray[np.float64]


def ask_each(
    archives: Sequence[PlacedArchive],
    question: Question[_A],
    k: int,
    place: PlaceItems,
    engine: Callable[[SceneData, QueryBudget, Sequence[Any]], _A],
    tolerance: float = 0.0,
    relative_tolerance: float = 0.0,
    budget_ms: float | None = None,
    budget_visits: int | None = None,
    radius_model: str | None = None,
    stop: StopFlag = NO_STOP,
) -> _A:
    """Query every archive for k items (poses, rays, points, motions or objects); merge the answers.

    place: returns the items for an archive and its current generation.  engine: queries an archive.
    tolerance, relative_tolerance, budget_ms, budget_visits, stop: as for `make_budget`.
    radius_model: see schemas/archive/radius_model.py; None: that of each archive.
    Raise BadRequestError, and the errors of the query.
    """
    budget = make_budget(tolerance, relative_tolerance, budget_ms, budget_visits, stop)
    visits = np.zeros(k, np.int64)
    answers: list[_A] = []
    first = 0
    for archive in archives:
        with archive.take() as opened:
            data = with_stop(opened.radius_model(radius_model), budget.stop)
            items, scan = place(archive, opened)
            own = budget._replace(scan=scan)
            ask = partial(_ask_rows, engine, items)
            found = ask_until_stopped(question, k, own, partial(ask_within_budget, ask, data, own, visits))
            answers.append(answers_in_world(found, archive.pose, first))
            first += opened.sources
        if budget.visits < NO_LIMIT:
            visits += found.node_visits  # type: ignore[attr-defined]  # all answers have them
    return merge_answers(answers)


def _ask_rows(
    engine: Callable[[SceneData, QueryBudget, Sequence[Any]], _A],
    items: Sequence[Any],
    data: SceneData,
    budget: QueryBudget,
    rows: Rows,
) -> _A:
    """Query an archive for some rows of the items."""
    return engine(data, budget, items if rows is None else [column[rows] for column in items])


def ask_within_budget(
    ask: AskRows[_A], data: SceneData, budget: QueryBudget, visits: NDArray[np.int64]
) -> _A:
    """Query an archive with what other archives left of the budget of each pose.

    visits: (k,) node visits that the other archives made for each pose.
    Consecutive poses with the same remaining budget share one call. They are nearly always the
    poses that no other archive is near.
    """
    if budget.visits == NO_LIMIT or not visits.any():
        return ask(data, budget, None)
    left = np.maximum(budget.visits - visits, 0)
    ends = [*(np.flatnonzero(np.diff(left)) + 1).tolist(), len(left)]
    starts = [0, *ends[:-1]]
    return join_answers(
        [
            ask(data, budget._replace(visits=int(left[start])), slice(start, end))
            for start, end in zip(starts, ends, strict=True)
        ]
    )


def make_legs(
    archives: Sequence[PlacedArchive],
    taken: Sequence[ArchiveGeneration],
    radius_model: str | None,
    poses: NDArray[np.float64],
) -> list[PathLeg]:
    """Return the leg of a path (poses (k, 4, 4), world) for each archive.

    taken: the current generation of each archive, in the order of `archives`.
    """
    firsts = [0, *np.cumsum([opened.sources for opened in taken]).tolist()]
    return [
        PathLeg(opened.radius_model(radius_model), archive.pose, first, archive.poses_in(poses))
        for opened, archive, first in zip(taken, archives, firsts, strict=False)
    ]


def ask_along(
    legs: Sequence[PathLeg],
    avatar: AvatarModel,
    op: str,
    parameters: dict[str, Any],
    stop: StopFlag = NO_STOP,
) -> tuple[Callable[[int, int], Cost], int]:
    """Return a function that answers items [start, end) of a path, and the total number of items.

    op, parameters: the query, and its arguments beside avatar and poses.
    stop: its `part_seconds` limits a part's time, all archives together.
    Raise the errors of `path_question`.
    """
    begin = time.perf_counter()
    # All poses are checked here, so that an error names a pose by its position on the path.
    asks = [path_question(leg.data, avatar, leg.poses, op, parameters, stop) for leg in legs]
    visits, budget_ms = parameters.get("budget_visits"), parameters.get("budget_ms")
    limit = parameters.get("limit")

    def ask_bounded(leg: PathLeg, start: int, spent: NDArray[np.int64], part: StopFlag | None) -> Cost:
        """Query the items from `start` on with what is left of their visits and of the time.

        spent: (n,) node visits that other archives made for each item.
        """

        def ask(data: SceneData, budget: QueryBudget, rows: Rows) -> Cost:
            k = slice(0, len(spent)) if rows is None else rows
            # n motions need n + 1 poses: each motion ends where the next one begins.
            own = leg.poses[start + k.start : start + k.stop + QUESTIONS[op].moving]
            options = parameters | {"budget_visits": budget.visits}
            if budget_ms is not None:
                options["budget_ms"] = max(0.0, budget_ms - (time.perf_counter() - begin) * 1e3)
            return path_question(data, avatar, own, op, options, stop)[0](0, k.stop - k.start, part)

        return ask_within_budget(ask, leg.data, QueryBudget(visits=int(visits or 0)), spent)

    def ask(start: int, end: int) -> Cost:
        spent = np.zeros(end - start, np.int64)
        # Without a limit on a part, each archive keeps its own flag, which a time budget may set.
        part = None if stop.part_seconds == math.inf else part_stop(stop, stop.part_seconds)
        answers: list[Cost] = []
        for leg, (ask_all, _) in zip(legs, asks, strict=True):
            if visits is None or end == start or len(legs) == 1:
                found = ask_all(start, end, part)
            else:
                found = ask_bounded(leg, start, spent, part)
                spent += found.node_visits  # type: ignore[attr-defined]  # all answers have them
            answers.append(answers_in_world(found, leg.pose, leg.first_source))
        together = merge_answers(answers)
        if isinstance(together, ContactsAnswers):
            return limit_pairs(together, DEFAULT_LIMIT if limit is None else limit)
        return together

    return ask, asks[0][1]


class PathParts(Iterator[Part]):
    """Parts of a path. Holds the archive generations that it reads until its end or `close`."""

    def __init__(self, parts: Generator[Part, None, None], taken: Sequence[ArchiveGeneration]) -> None:
        """Yield `parts`. taken: the generations that they read, released at the end."""
        self._parts = parts
        self._taken = list(taken)

    def __next__(self) -> Part:
        try:
            return next(self._parts)
        except BaseException:  # including StopIteration
            self.close()
            raise

    def close(self) -> None:
        """End the path and release its generations. Closing twice is allowed."""
        taken, self._taken = self._taken, []
        if taken:
            self._parts.close()
            for opened in taken:
                opened.release()

    def __del__(self) -> None:
        self.close()
