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
from ..queries.path import path_question
from ..queries.request import QueryBudget, ask_until_stopped, make_budget
from ..queries.scene_data import SceneData, with_stop
from ..runtime.stop_flag import NO_STOP, StopFlag
from .archive_generation import ArchiveGeneration
from .merge_answers import answers_in_world, limit_pairs, merge_answers
from .placed_archive import PlacedArchive
from .rigid_transform import Pose

_A = TypeVar("_A", bound=Cost)
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
    answers: list[_A] = []
    first = 0
    for archive in archives:
        with archive.take() as opened:
            data = with_stop(opened.radius_model(radius_model), budget.request)
            items, scan = place(archive, opened)
            own = budget._replace(scan=scan)
            found = ask_until_stopped(question, k, own, partial(engine, data, own, items))
            answers.append(answers_in_world(found, archive.pose, first))
            first += opened.sources
    return merge_answers(answers)


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
    # All poses are checked here, so that an error names a pose by its position on the path.
    asks = [path_question(leg.data, avatar, leg.poses, op, parameters, stop) for leg in legs]
    limit = parameters.get("limit")

    def ask(start: int, end: int) -> Cost:
        begun = time.perf_counter()
        answers = [
            answers_in_world(ask_leg(start, end, begun), leg.pose, leg.first_source)
            for leg, (ask_leg, _) in zip(legs, asks, strict=True)
        ]
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
