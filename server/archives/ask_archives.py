"""Queries over all archives of a scene: each is queried in its own frame, and answers are merged.

A pose is in contact if it touches any archive. Otherwise it is unknown if any archive's verdict is
unknown, and clear if all archives are clear. It is `outside` if it is outside of all archives. A
deadline is that of all archives together. With one archive at the identity, nothing is transformed
or merged.
"""

import time
from collections.abc import Callable, Generator, Iterator, Sequence
from functools import partial
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from ...schemas.wire.answers import ContactsAnswers, Cost, Part
from ...schemas.wire.question_rules import Question
from ..avatars.avatar_model import AvatarModel
from ..queries.load_and_search import ask_until_stopped
from ..queries.path import path_question
from ..queries.query_inputs import QueryBudget, SceneData, make_budget, with_stop
from ..runtime.stop_flag import NO_STOP, StopFlag
from .merge_answers import answers_in_world, limit_pairs, merge_answers
from .placed_archive import ArchiveGeneration, PlacedArchive

_A = TypeVar("_A", bound=Cost)
# Items of a request in the frame of one archive, column by column, and whether the voxels near them
# are used in passing (`QueryBudget.scan`).
PlacedItems = tuple[Sequence[Any], bool]
PlaceItems = Callable[[PlacedArchive, ArchiveGeneration], PlacedItems]
# Pairs that `contacts` lists per pose by default.
DEFAULT_LIMIT = 100


class HeldArchive(NamedTuple):
    """An archive of a scene, and the generation of it that a reader holds.

    data: of the generation, with a radius model and a stop flag.
    """

    placed: PlacedArchive
    opened: ArchiveGeneration
    data: SceneData


def hold_archives(
    archives: Sequence[PlacedArchive], radius_model: str | None, stop: StopFlag
) -> list[HeldArchive]:
    """Return the current generation of each archive; the caller must `release` each.

    radius_model: see schemas/archive/radius_model.py; None: that of each archive. Raise BadRequestError.
    """
    taken: list[ArchiveGeneration] = []
    try:
        for placed in archives:
            taken.append(placed.take())
        return [
            HeldArchive(placed, opened, with_stop(opened.radius_model(radius_model), stop))
            for placed, opened in zip(archives, taken, strict=True)
        ]
    except BaseException:
        for opened in taken:
            opened.release()
        raise


def release(held: Sequence[HeldArchive]) -> None:
    """Release what `hold_archives` returned."""
    for each in held:
        each.opened.release()


def ask_held(held: Sequence[HeldArchive], ask: Callable[[HeldArchive], _A]) -> list[_A]:
    """Return the answers of each archive, in the world, for `merge_answers`.

    ask: queries an archive about the items of a request, placed in its frame.
    """
    answers, first = [], 0
    for each in held:
        answers.append(answers_in_world(ask(each), each.placed.pose, first))
        first += each.opened.sources
    return answers


def ask_each(
    archives: Sequence[PlacedArchive],
    question: Question[_A],
    k: int,
    place: PlaceItems,
    engine: Callable[[SceneData, QueryBudget, Sequence[Any]], _A],
    tolerance: float = 0.0,
    relative_tolerance: float = 0.0,
    budget_ms: float | None = None,
    radius_model: str | None = None,
    stop: StopFlag = NO_STOP,
) -> _A:
    """Query every archive for k items (poses, rays, points, motions or objects); merge the answers.

    place: returns the items for an archive and its current generation.  engine: queries an archive.
    tolerance, relative_tolerance, budget_ms, stop: as for `make_budget`.
    radius_model: see schemas/archive/radius_model.py; None: that of each archive.
    Raise BadRequestError, and the errors of the query.
    """
    budget = make_budget(tolerance, relative_tolerance, budget_ms, stop)

    def ask(each: HeldArchive) -> _A:
        items, scan = place(each.placed, each.opened)
        own = budget._replace(scan=scan)
        return ask_until_stopped(question, k, own, partial(engine, each.data, own, items))

    held = hold_archives(archives, radius_model, budget.request)
    try:
        return merge_answers(ask_held(held, ask))
    finally:
        release(held)


def ask_along(
    held: Sequence[HeldArchive],
    avatar: AvatarModel,
    poses: NDArray[np.float64],
    op: str,
    parameters: dict[str, Any],
    stop: StopFlag = NO_STOP,
) -> tuple[Callable[[int, int], Cost], int]:
    """Return a function that answers items [start, end) of a path, and the total number of items.

    poses: (k, 4, 4), world.  op, parameters: the query, and its arguments beside avatar and poses.
    stop: its `part_seconds` limits a part's time, all archives together.
    Raise the errors of `path_question`.
    """
    # All poses are checked here, so that an error names a pose by its position on the path.
    asks, total = {}, 0
    for each in held:
        own = each.placed.poses_in(poses)
        asks[each.placed], total = path_question(each.data, avatar, own, op, parameters, stop)
    limit = parameters.get("limit")

    def ask(start: int, end: int) -> Cost:
        begun = time.perf_counter()
        together = merge_answers(ask_held(held, lambda each: asks[each.placed](start, end, begun)))
        if isinstance(together, ContactsAnswers):
            return limit_pairs(together, DEFAULT_LIMIT if limit is None else limit)
        return together

    return ask, total


class PathParts(Iterator[Part]):
    """Parts of a path. Holds the archive generations that it reads until its end or `close`."""

    def __init__(self, parts: Generator[Part, None, None], held: Sequence[HeldArchive]) -> None:
        """Yield `parts`. held: the generations that they read, released at the end."""
        self._parts = parts
        self._held = list(held)

    def __next__(self) -> Part:
        try:
            return next(self._parts)
        except BaseException:  # including StopIteration
            self.close()
            raise

    def close(self) -> None:
        """End the path and release its generations. Closing twice is allowed."""
        held, self._held = self._held, []
        if held:
            self._parts.close()
            release(held)

    def __del__(self) -> None:
        self.close()
