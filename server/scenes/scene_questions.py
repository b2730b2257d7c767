"""The questions of a scene to its archives, in this process: each in the archive's frame, answers merged."""

import os
from collections.abc import Callable, Iterator, Sequence, Sized
from concurrent.futures import Executor
from contextlib import ExitStack
from typing import Any, TypeVar, Unpack

import numpy as np
from numpy.typing import ArrayLike

from ...schemas.errors import BadRequestError
from ...schemas.wire.answers import (
    CollideAnswers,
    ContactsAnswers,
    Cost,
    DistanceAnswers,
    ObjectsAnswers,
    Part,
    RaycastAnswers,
    SweepAnswers,
    WithinAnswers,
)
from ...schemas.wire.requests import make_objects, make_poses, make_vectors
from ..archives.archive_generation import HeldParts, Opened
from ..archives.ask_archives import LISTED, Ask, along, ask_each, make_legs, rows_of
from ..archives.merge_answers import limited
from ..archives.placed_archive import PlacedArchive
from ..avatars.avatar_model import AvatarModel
from ..avatars.client_avatars import Avatars
from ..observability.metrics import Metrics
from ..queries.collide import collide
from ..queries.contacts import contacts
from ..queries.context.query_budget import Effort, EngineOptions, make_effort
from ..queries.context.query_context import SceneData, with_stop
from ..queries.distance import distance
from ..queries.objects import SCENE_GROUP
from ..queries.objects import objects as ask_objects
from ..queries.path import PATH_THREADS, largest_part, path_parts
from ..queries.raycast import raycast
from ..queries.stopped_answers import ask_until_stopped
from ..queries.sweep import sweep
from ..queries.within import within
from ..runtime.path_threads import PathThreads
from ..runtime.stop_flag import NEVER, Stop

_A = TypeVar("_A", bound=Cost)


class SceneQuestions:
    """The archives of a scene, the avatars of its clients, and the questions. Thread-safe.

    name: of the scene.  archives: at least one.
    """

    def __init__(self, archives: Sequence[PlacedArchive], name: str, metrics: Metrics) -> None:
        """Ask these archives; see `Scene`."""
        self.name, self.archives = name, list(archives)
        # A single archive at the identity: its questions take a request as it is.
        self._alone = self.archives[0] if len(archives) == 1 and archives[0].pose is None else None
        self._metrics, self._avatars = metrics, Avatars()
        self._path_threads = PathThreads(name, max(PATH_THREADS, os.cpu_count() or 1))

    def path_threads(self, client: str) -> Executor:
        """Return what computes the parts of a client's paths: threads, one a core, shared by all clients in turn."""
        return self._path_threads.of(client)

    def avatar(self, name: str, client: str) -> AvatarModel:
        """Return a client's avatar, or the scene's own. Raises UnknownAvatarError."""
        return self._avatars.get(name, client)

    def _ask(
        self,
        question: Callable[..., _A],
        name: str,
        client: str,
        poses: Sequence[ArrayLike],
        what: tuple[Any, ...],
        around: float,
        options: EngineOptions,
    ) -> _A:
        """Ask about an avatar. The last pose of the last of `poses` tells where its user is.

        question: takes scene, avatar, `poses`, `what`, and `effort`.  poses: (k, 4, 4) each.
        around: margin or reach [m].
        """
        if self._alone is None:
            return self._ask_placed(question, name, client, poses, what, around, options)
        with self._alone.take() as opened:
            data, effort = _terms(opened, **options)
            avatar = self.avatar(name, client)
            if opened.saw((client, name), avatar, poses[-1], around):
                effort = effort._replace(scan=True)
            answers = ask_until_stopped(
                question,
                _count(poses[-1]),
                effort,
                lambda: question(data, avatar, *poses, *what, effort=effort),
            )
        self._metrics.answered(client, name, answers)
        return answers

    def _ask_placed(
        self,
        question: Callable[..., _A],
        name: str,
        client: str,
        poses: Sequence[ArrayLike],
        what: tuple[Any, ...],
        around: float,
        options: EngineOptions,
    ) -> _A:
        """Ask about an avatar in each archive's own frame; see `_ask`."""
        avatar, arrays = self.avatar(name, client), [make_poses(each) for each in poses]
        if len(arrays[0]) != len(arrays[-1]):
            raise BadRequestError(
                f"{len(arrays[0])} poses to begin at and {len(arrays[-1])} to end at: expected as many"
            )

        def prepare(archive: PlacedArchive, opened: Opened) -> tuple[Ask[_A], bool]:
            own = [archive.poses_in(each) for each in arrays]

            def ask(data: SceneData, effort: Effort, rows: slice | None) -> _A:
                return question(data, avatar, *(rows_of(each, rows) for each in own), *what, effort=effort)

            return ask, opened.saw((client, name), avatar, own[-1], around)

        answers = ask_each(self.archives, question, len(arrays[0]), prepare, **options)
        self._metrics.answered(client, name, answers)
        return answers

    def _vectors(self, vectors: ArrayLike, what: str) -> Any:
        """Return vectors (k, 3) as archives at poses take them; one at the identity checks them itself."""
        return vectors if self._alone is not None else make_vectors(vectors, what)

    def collide(
        self,
        name: str,
        poses: ArrayLike,
        margin: float = 0.0,
        *,
        client: str = "",
        **options: Unpack[EngineOptions],
    ) -> CollideAnswers:
        """Return whether avatar `name` touches the scene under each of the poses (k, 4, 4).

        See server/queries/collide.py. options, here and below: tolerance [m], budget_ms and
        budget_visits limit the cost of the answer, see server/queries/context/query_budget.py;
        radius_model sets the size of the scan's spheres, see schemas/archive/radius_model.py, None:
        as the scene was opened.
        """
        return self._ask(collide, name, client, (poses,), (margin,), margin, options)

    def distance(
        self,
        name: str,
        poses: ArrayLike,
        reach: float,
        *,
        client: str = "",
        **options: Unpack[EngineOptions],
    ) -> DistanceAnswers:
        """Return how far avatar `name` is from the scene under each pose, up to `reach` [m].

        See server/queries/distance.py.
        """
        return self._ask(distance, name, client, (poses,), (reach,), reach, options)

    def contacts(
        self,
        name: str,
        poses: ArrayLike,
        limit: int = LISTED,
        margin: float = 0.0,
        cluster_distance: float | None = None,
        *,
        client: str = "",
        **options: Unpack[EngineOptions],
    ) -> ContactsAnswers:
        """Return which pairs of points are in contact under each of the poses, deepest first.

        See server/queries/contacts.py. A cluster is of one archive; the depths of several archives
        are compared by the rounded figure.
        """
        what = (limit, margin, cluster_distance)
        found = self._ask(contacts, name, client, (poses,), what, margin, options)
        return found if len(self.archives) == 1 else limited(found, limit)

    def sweep(
        self,
        name: str,
        pose_from: ArrayLike,
        pose_to: ArrayLike,
        margin: float = 0.0,
        *,
        client: str = "",
        **options: Unpack[EngineOptions],
    ) -> SweepAnswers:
        """Return when avatar `name` first touches the scene on its way between poses; see server/queries/sweep.py."""
        options.setdefault("tolerance", 1e-6)
        what = (margin, options["tolerance"])
        return self._ask(sweep, name, client, (pose_from, pose_to), what, margin, options)

    def raycast(
        self,
        origins: ArrayLike,
        directions: ArrayLike,
        reach: float,
        **options: Unpack[EngineOptions],
    ) -> RaycastAnswers:
        """Return which scan point's sphere rays (k, 3), (k, 3) hit first, up to `reach` [m].

        See server/queries/raycast.py.
        """
        begins, ways = self._vectors(origins, "origins"), self._vectors(directions, "directions")
        if self._alone is None and len(begins) != len(ways):
            raise BadRequestError(f"{len(begins)} origins and {len(ways)} directions: expected as many")

        def prepare(archive: PlacedArchive, _: Opened) -> tuple[Ask[RaycastAnswers], bool]:
            own, along = archive.points_in(begins), archive.directions_in(ways)

            def ask(data: SceneData, effort: Effort, rows: slice | None) -> RaycastAnswers:
                return raycast(data, rows_of(own, rows), rows_of(along, rows), reach, effort)

            return ask, False

        answers = ask_each(self.archives, raycast, _count(begins), prepare, **options)
        self._metrics.answered("", "", answers)
        return answers

    def within(
        self,
        points: ArrayLike,
        reach: float,
        **options: Unpack[EngineOptions],
    ) -> WithinAnswers:
        """Return which scan point is nearest to each loose point (k, 3), up to `reach` [m].

        See server/queries/within.py.
        """
        places = self._vectors(points, "points")

        def prepare(archive: PlacedArchive, _: Opened) -> tuple[Ask[WithinAnswers], bool]:
            own = archive.points_in(places)
            return (lambda data, effort, rows: within(data, rows_of(own, rows), reach, effort)), False

        answers = ask_each(self.archives, within, _count(places), prepare, **options)
        self._metrics.answered("", "", answers)
        return answers

    def objects(
        self,
        objects: Sequence[Sequence[Any]],
        margin: float = 0.0,
        *,
        client: str = "",
        **options: Unpack[EngineOptions],
    ) -> ObjectsAnswers:
        """Return which of several avatars (name, pose, group = 1, mask = all) touch the scene and one another.

        See server/queries/objects.py. Of one another they are asked in the frame of the first
        archive.
        """
        items, poses = make_objects(objects)
        avatars = [self.avatar(item.avatar, client) for item in items]
        groups = np.array([item.group for item in items], np.uint32)
        masks = np.array([item.mask for item in items], np.uint32)

        def prepare(archive: PlacedArchive, _: Opened) -> tuple[Ask[ObjectsAnswers], bool]:
            # Objects of no group meet nobody but the scene.
            first = archive is self.archives[0]
            own, group = archive.poses_in(poses), groups if first else groups & np.uint32(0)
            mask = masks if first else masks & np.uint32(SCENE_GROUP)

            def ask(data: SceneData, effort: Effort, rows: slice | None) -> ObjectsAnswers:
                k = slice(None) if rows is None else rows
                return ask_objects(data, avatars[k], own[k], group[k], mask[k], margin, effort)

            return ask, False

        answers = ask_each(self.archives, ask_objects, len(items), prepare, **options)
        self._metrics.answered(client, "", answers)
        return answers

    def path(
        self,
        name: str,
        poses: ArrayLike,
        op: str = "collide",
        *,
        threads: int = PATH_THREADS,
        radius_model: str | None = None,
        client: str = "",
        stop: Stop = NEVER,
        **parameters: Any,
    ) -> Iterator[Part]:
        """Ask `op` (collide, distance, contacts, sweep) along the poses; the answers come in parts, in order.

        parameters: of `op` beside the poses, tolerance and budgets included; `budget_ms` is for the
        whole path.
        threads: parts computed at a time.  sweep: k - 1 motions, from each pose to the next. Every
        part is the answer of its question for [first, first + n) of `total`. All poses are checked
        before the first part.
        """
        taken: list[Opened] = []
        try:
            for archive in self.archives:
                taken.append(archive.take())
            avatar, array = self.avatar(name, client), make_poses(poses)
            legs = make_legs(self.archives, taken, radius_model, array)
            ask, total = along(legs, avatar, op, parameters, stop)

            def ask_held(start: int, end: int) -> Cost:
                with ExitStack() as stack:  # whoever wanted the parts may be gone, and their holds with them
                    for opened in taken:
                        stack.enter_context(opened.taken())
                    part = ask(start, end)
                self._metrics.answered(client, name, part)
                return part

            most = largest_part(op, parameters)
            ahead = (self.path_threads(client), 2 * threads) if threads > 1 else (None, 1)
            return HeldParts(path_parts(ask_held, total, most, *ahead), taken)
        except BaseException:
            for opened in taken:
                opened.release()
            raise


def _terms(
    opened: Opened,
    tolerance: float = 0.0,
    budget_ms: float | None = None,
    budget_visits: int | None = None,
    radius_model: str | None = None,
    stop: Stop = NEVER,
) -> tuple[SceneData, Effort]:
    """Return what a question with these options reads, and what it may cost."""
    effort = make_effort(tolerance, budget_ms, budget_visits, stop)
    data = opened.data if radius_model is None else opened.radius_model(radius_model)
    return with_stop(data, effort.stop), effort


def _count(rows: ArrayLike) -> int:
    """Return how many rows an argument has; 0 for one that the question is about to refuse."""
    return len(rows) if isinstance(rows, Sized) else 0
