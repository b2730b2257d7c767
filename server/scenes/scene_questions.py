"""Queries of a scene in this process, over all of its archives."""

import os
from collections.abc import Iterator, Sequence, Sized
from concurrent.futures import Executor
from contextlib import ExitStack
from typing import Any, TypeVar

import numpy as np
from msgspec import structs
from numpy.typing import ArrayLike

from ...schemas.archive.pose_arrays import make_poses
from ...schemas.errors import BadRequestError
from ...schemas.wire.answers import Cost, Part
from ...schemas.wire.question_rules import Question
from ...schemas.wire.requests import make_objects, make_vectors
from ..archives.archive_generation import ArchiveGeneration
from ..archives.ask_archives import (
    PathParts,
    PlacedItems,
    PlaceItems,
    ask_along,
    ask_each,
    hold_archives,
    release,
)
from ..archives.merge_answers import limit_pairs
from ..archives.placed_archive import PlacedArchive
from ..avatars.avatar_model import AvatarModel
from ..avatars.client_avatars import Avatars
from ..observability.request_stats import RequestStats
from ..queries.context.query_budget import EXACT, QueryBudget, make_budget, unknown_answers
from ..queries.context.query_context import SceneData, with_stop
from ..queries.engine_table import ENGINES
from ..queries.objects import SCENE_GROUP
from ..queries.path import PATH_THREADS, largest_part, path_parts
from ..runtime.path_threads import PathThreads
from ..runtime.stop_flag import NO_STOP, StopFlag, StoppedError
from ..scene_interface import QueryMethods

_A = TypeVar("_A", bound=Cost)


class SceneQuestions(QueryMethods):
    """Archives of a scene, avatars of its clients, and the query methods. Thread-safe.

    name: of the scene.  archives: at least one.
    """

    def __init__(self, archives: Sequence[PlacedArchive], name: str, metrics: RequestStats) -> None:
        """Query these archives; see `Scene`."""
        self.name, self.archives = name, list(archives)
        # A single archive at the identity takes the arguments of a request unchanged.
        self._alone = self.archives[0] if len(archives) == 1 and archives[0].pose is None else None
        self._metrics, self._avatars = metrics, Avatars()
        self._path_threads = PathThreads(name, max(PATH_THREADS, os.cpu_count() or 1))

    def path_threads(self, client: str) -> Executor:
        """Return the executor of a client's paths.

        All clients share its threads, one a core, in turn.
        """
        return self._path_threads.of(client)

    def avatar(self, name: str, client: str) -> AvatarModel:
        """Return an avatar of the client or of the scene. Raise UnknownAvatarError."""
        return self._avatars.get(name, client)

    def ask(self, question: Question[_A], *arguments: Any, client: str = "", **options: Any) -> _A:
        """Answer a question for all archives together; server/queries defines each answer.

        arguments: the fields of its request, in their order, avatars by name.
        client: owner of the avatars.
        options: the remaining fields by name, and

        - budget_ms, and tolerance [m] and relative_tolerance of questions that take them: see
          server/queries/context/query_budget.py,
        - radius_model: size of the scan's spheres, see schemas/archive/radius_model.py; None: the
          scene's default,
        - stop: stop flag that ends the work early.

        A cluster of `contacts` contains points of one archive only; depths in different archives
        are compared after rounding. `objects` are tested against one another in the frame of the
        first archive. Raise UnknownAvatarError and the errors of the query.
        """
        complete = len(arguments) == len(question.arguments)
        given = arguments if complete else question.all_arguments(arguments, options)
        if options:
            self.check_options(question, options)
        if question.other_defaults:
            options = question.other_defaults | options
        if self._alone is None or question.whole:
            return self._ask_placed(question, given, client, options)
        # Neither transformation nor merging. A request of one pose takes 30 µs in all, so every
        # function call counts here.
        rows = given[len(question.arrays) - (not question.about_avatars)]  # of the last array
        with self._alone.take() as opened:
            data, budget = _terms(opened, **options) if options else (opened.data, EXACT)
            user = ("", "")
            subject: Any = given
            if question.about_avatars:
                # `record_user` takes the user's position from the last pose.
                user = client, given[0]
                avatar = self._avatars.get(given[0], client)
                around = 0.0 if question.around is None else given[question.around]
                if opened.record_user(user, avatar, rows, around):
                    budget = budget._replace(scan=True)
                subject = avatar, *given[1:]
            try:
                answers: _A = ENGINES[question.name](data, *subject, budget=budget)
            except StoppedError:
                answers = unknown_answers(question, _count(question, rows), budget)
            else:
                if budget.stopped:
                    answers = structs.replace(answers, stopped=budget.stopped)
        self._metrics.answered(*user, answers)
        return answers

    def _ask_placed(
        self, question: Question[_A], given: tuple[Any, ...], client: str, options: dict[str, Any]
    ) -> _A:
        """Answer `ask` for archives that are several or not at the identity, each in its own frame."""
        user, first = ("", ""), 0
        subject: tuple[AvatarModel, ...] = ()
        if question.whole:
            user, what = (client, ""), given[1:]
            k, place = self._place_objects(given[0], client)
        else:
            if question.about_avatars:
                user, subject, first = (client, given[0]), (self.avatar(given[0], client),), 1
            end = first + len(question.arrays)
            around = 0.0 if question.around is None else given[question.around]
            k, place = _place_arrays(question, given[first:end], user, subject, around)
            what = given[end:]

        def ask(data: SceneData, budget: QueryBudget, items: Sequence[Any]) -> _A:
            found: _A = ENGINES[question.name](data, *subject, *items, *what, budget=budget)
            return found

        answers: Any = ask_each(self.archives, question, k, place, ask, **options)
        self._metrics.answered(*user, answers)
        if question.listed is not None and len(self.archives) > 1:
            answers = limit_pairs(answers, given[question.arguments.index(question.listed[0])])
        return answers  # type: ignore[no-any-return]

    def _place_objects(self, objects: Any, client: str) -> tuple[int, PlaceItems]:
        """Return the number of objects, and the function that places them in an archive's frame.

        Pairs of objects are tested in the frame of the first archive only. For other archives, their
        groups are 0: they are tested against the scene only.
        """
        items, poses = make_objects(objects)
        avatars = [self.avatar(item.avatar, client) for item in items]
        groups = np.array([item.group for item in items], np.uint32)
        masks = np.array([item.mask for item in items], np.uint32)

        def place(archive: PlacedArchive, _: ArchiveGeneration) -> PlacedItems:
            own = archive.poses_in(poses)
            if archive is self.archives[0]:
                return (avatars, own, groups, masks), False
            return (avatars, own, groups & np.uint32(0), masks & np.uint32(SCENE_GROUP)), False

        return len(items), place

    def path(
        self,
        name: str,
        poses: ArrayLike,
        op: str = "collide",
        *,
        threads: int = PATH_THREADS,
        radius_model: str | None = None,
        client: str = "",
        stop: StopFlag = NO_STOP,
        **parameters: Any,
    ) -> Iterator[Part]:
        """Answer `op` (collide, distance, contacts, sweep) along poses, in ordered parts.

        name: of the avatar.  poses: (k, 4, 4) or (4, 4), avatar to world.
        op: a sweep has k - 1 motions, from each pose to the next; the others examine the poses
        only.
        threads: parts computed at a time.  client: owner of the avatar.
        parameters: of `op` besides the poses, including tolerance and budgets. `budget_ms` is for
        the whole path.
        Each part answers the items [first, first + n) of `total`. All poses are checked before the
        first part. Raise UnknownAvatarError and the errors of `op`.
        """
        held = hold_archives(self.archives, radius_model, stop)
        try:
            ask, total = ask_along(held, self.avatar(name, client), make_poses(poses), op, parameters, stop)

            def ask_part(start: int, end: int) -> Cost:
                # Hold the generations: the consumer may close the path, which releases `held`.
                with ExitStack() as stack:
                    for each in held:
                        stack.enter_context(each.opened.taken())
                    part = ask(start, end)
                self._metrics.answered(client, name, part)
                return part

            most = largest_part(op, parameters)
            ahead = (self.path_threads(client), 2 * threads) if threads > 1 else (None, 1)
            return PathParts(path_parts(ask_part, total, most, *ahead), held)
        except BaseException:
            release(held)
            raise


def _place_arrays(
    question: Question[Any],
    given: Sequence[Any],
    user: tuple[str, str],
    subject: tuple[AvatarModel, ...],
    around: float,
) -> tuple[int, PlaceItems]:
    """Return the number of items, and the function that places them in an archive's frame.

    given: the arrays of the request.  user: client and name of the avatar, `subject` the avatar
    itself, if the question is about one.  around: its margin or reach [m].
    """
    names = tuple(question.arrays)
    arrays = [
        make_poses(each) if subject else make_vectors(each, name)
        for each, name in zip(given, names, strict=True)
    ]
    if len(arrays[0]) != len(arrays[-1]):
        one, other = ("poses to begin at", "to end at") if subject else (names[0], names[-1])
        raise BadRequestError(f"{len(arrays[0])} {one} and {len(arrays[-1])} {other}: expected equal numbers")

    def place(archive: PlacedArchive, opened: ArchiveGeneration) -> PlacedItems:
        if subject:
            own = [archive.poses_in(each) for each in arrays]
            return own, opened.record_user(user, subject[0], own[-1], around)
        return [
            archive.directions_in(each) if name in question.directions else archive.points_in(each)
            for each, name in zip(arrays, names, strict=True)
        ], False

    return len(arrays[0]), place


def _terms(
    opened: ArchiveGeneration,
    tolerance: float = 0.0,
    relative_tolerance: float = 0.0,
    budget_ms: float | None = None,
    radius_model: str | None = None,
    stop: StopFlag = NO_STOP,
) -> tuple[SceneData, QueryBudget]:
    """Return the scene data and the budget of a request with these options."""
    budget = make_budget(tolerance, relative_tolerance, budget_ms, stop)
    data = opened.data if radius_model is None else opened.radius_model(radius_model)
    return with_stop(data, budget.request), budget


def _count(question: Question[Any], rows: ArrayLike) -> int:
    """Return the number of items of an argument; 0 for one that has no length."""
    if question.about_avatars:
        return len(make_poses(rows))
    return len(rows) if isinstance(rows, Sized) else 0
