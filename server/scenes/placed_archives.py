"""Several archives, each at a pose in the world, answer as one scene. The same methods as `Scene`.

What is exact: each archive's answer, by the definition (NUMERICS.md N5), in its own frame. An archive at the identity
is asked with the very poses, so the archives of two halves of a scan, on one lattice, answer as that of the whole. One
at a pose is asked under inverse(pose) @ pose of the avatar, float64, rounded once: exact for a signed permutation and
shifts that float64 adds exactly, within some nanometres of it for others. Witnesses are carried back the same way.

Contact with any is contact; unknown for any is unknown; clear is what is clear of all, and `outside` what is outside of
all. What a request may cost is for all of them together: each archive is given what those before it left.
"""

import time
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import ExitStack
from functools import partial
from typing import Any, NamedTuple, TypeVar, Unpack

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...schemas.errors import BadRequestError, SolidcloudError
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
from ...schemas.wire.messages import AvatarInfo, ReloadAnswer, SceneInfo, StatsAnswer
from ...schemas.wire.requests import make_objects, make_poses, make_vectors
from ..archives.archive_generation import HeldParts, Opened
from ..archives.merge_answers import carried, limited, merged
from ..archives.rigid_transform import Pose, archive_pose, inverse_of, moved, turned, under
from ..archives.scene_info import info_of_several, sources_asked, stats_of_several
from ..avatars.avatar_model import AvatarModel
from ..observability.metrics import Metrics
from ..queries.collide import collide
from ..queries.contacts import contacts
from ..queries.context.query_budget import NO_LIMIT, Effort, EngineOptions, make_effort
from ..queries.context.query_context import SceneData, with_stop
from ..queries.distance import distance
from ..queries.objects import SCENE_GROUP
from ..queries.objects import objects as ask_objects
from ..queries.path import PATH_THREADS, largest_part, path_parts
from ..queries.raycast import make_directions, raycast
from ..queries.stopped_answers import ask_until_stopped
from ..queries.sweep import sweep
from ..queries.within import within
from ..runtime.stop_flag import NEVER, Stop
from ..scene import Scene
from ..served.avatar_limits import AvatarLimits
from ..simulation.assembly import Simulated
from .placed_paths import LISTED, Ask, Leg, along, in_budget

_A = TypeVar("_A", bound=Cost)
_Floats = NDArray[np.float64]


class _Archive(NamedTuple):
    """One archive. pose, inverse: archive to world, and back; None: at the identity."""

    scene: Scene
    pose: Pose | None
    inverse: Pose | None

    def poses_in(self, poses: _Floats) -> _Floats:
        """Poses (k, 4, 4) of the world in the archive's frame."""
        return poses if self.inverse is None else under(self.inverse, poses)

    def points_in(self, points: _Floats) -> _Floats:
        """Points (k, 3) of the world in the archive's frame."""
        return points if self.inverse is None else moved(self.inverse, points)

    def ways_in(self, directions: _Floats) -> _Floats:
        """Directions (k, 3) of the world, of any length, in the archive's frame."""
        return directions if self.inverse is None else turned(self.inverse, make_directions(directions))


class SeveralScenes(Simulated):
    """Several served archives as one scene. Thread-safe; a context manager.

    name: what clients call it.  archives: each with its pose, archive to world; None: at the identity. Avatars are kept
    by the first of them, for all.
    """

    def __init__(self, scenes: Sequence[tuple[Scene, ArrayLike | None]], name: str) -> None:
        """scenes: at least one, which from now on are closed with this. Raises BadRequestError, BadTransformError."""
        if not scenes:
            raise BadRequestError(f"{name}: a scene of no archives: expected one at least")
        self.name = name
        self.archives = [
            (scene, archive_pose(pose, f"pose of archive {number}"))
            for number, (scene, pose) in enumerate(scenes)
        ]
        self._archives = [
            _Archive(scene, pose, None if pose is None else inverse_of(pose)) for scene, pose in self.archives
        ]
        self._first = self.archives[0][0]
        self._metrics = Metrics()

    def __enter__(self) -> "SeveralScenes":
        """The scene itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close the archives."""
        self.close()

    def close(self) -> None:
        """Close all archives, as `Scene.close` does."""
        with ExitStack() as stack:
            for scene, _ in self.archives:
                stack.callback(scene.close)

    def warm(self) -> None:
        """Ask one of everything of each archive, loads included, so that nobody waits for compilers after."""
        for scene, _ in self.archives:
            scene.warm()

    def reload(self) -> ReloadAnswer:
        """Serve what is in the archives' folders now, one after the other, as `Scene.reload` does.

        Where one cannot be opened those before it are new, and it and those behind are served on as they were.
        """
        begin = time.perf_counter()
        each: list[ReloadAnswer] = []
        for number, (scene, _) in enumerate(self.archives):
            try:
                each.append(scene.reload())
            except SolidcloudError as error:
                new = f": of {len(self.archives)} archives the first {number} are reloaded" if number else ""
                error.args = (f"archive {number}: {error}{new}",)
                raise
        before, after = (sum(getattr(a, f"generation_{side}") for a in each) for side in ("before", "after"))
        return ReloadAnswer(
            self.name, before, after, sum(a.points for a in each), time.perf_counter() - begin
        )

    def info(self) -> SceneInfo:
        """What is served: counts added, bounds in the world, sources one archive's behind the other's."""
        return info_of_several(self.name, [(scene.info(), pose) for scene, pose in self.archives])

    def stats(self, keys: bool = False) -> StatsAnswer:
        """What is in memory of all archives, what was asked of the scene, and what had to be waited for."""
        each = [scene.stats(keys) for scene, _ in self.archives]
        loads = [seconds for scene, _ in self.archives for seconds in scene.residency.load_times()]
        return stats_of_several(self.name, each, loads, self._metrics)

    def add_avatar(
        self, name: str, points: ArrayLike, radius: float | None = None, *, client: str = ""
    ) -> AvatarInfo:
        """Add an avatar; see `Scene.add_avatar`."""
        return self._first.add_avatar(name, points, radius, client=client)

    def avatar(self, name: str, client: str) -> AvatarModel:
        """A client's avatar, or the scene's own; UnknownAvatarError."""
        return self._first.avatar(name, client)

    def limit_avatars(self, limits: AvatarLimits) -> None:
        """Limit the memory of clients' avatars; see `Scene.limit_avatars`."""
        self._first.limit_avatars(limits)

    def drop_unused_avatars(self, alive: Collection[str], seconds: float) -> None:
        """Forget avatars that are not used; see `Scene.drop_unused_avatars`."""
        self._first.drop_unused_avatars(alive, seconds)

    def drop_client(self, client: str) -> None:
        """Forget the avatars of a client that is gone."""
        for scene, _ in self.archives:
            scene.drop_client(client)
        self._metrics.drop_client(client)

    def _each(
        self,
        question: Callable[..., _A],
        k: int,
        prepare: Callable[[_Archive, Opened], tuple[Ask[_A], bool]],
        tolerance: float = 0.0,
        budget_ms: float | None = None,
        budget_visits: int | None = None,
        radius_model: str | None = None,
        stop: Stop = NEVER,
    ) -> _A:
        """Ask every archive about k poses (rays, points, motions, objects), and merge.

        question: what is asked.  prepare: what asks an archive, and whether what is looked at is passed by
        (`Effort.scan`).
        """
        effort = make_effort(tolerance, budget_ms, budget_visits, stop)
        visits = np.zeros(k, np.int64)
        answers: list[_A] = []
        first = 0
        for archive in self._archives:
            with archive.scene.take() as opened:
                data = with_stop(opened.radius_model(radius_model), effort.stop)
                ask, scan = prepare(archive, opened)
                own = effort._replace(scan=scan)
                found = ask_until_stopped(question, k, own, partial(in_budget, ask, data, own, visits))
                answers.append(carried(found, archive.pose, first))
                first += sources_asked(opened)
            if effort.visits < NO_LIMIT:
                visits += found.node_visits  # type: ignore[attr-defined]  # all answers have them
        return merged(answers)

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
        """Ask about an avatar; poses: (k, 4, 4) each, the last of the last ones is where its user is.

        question: takes scene, avatar, poses, `what`, and `effort`.  around: margin or reach [m].
        """
        avatar, arrays = self.avatar(name, client), [make_poses(each) for each in poses]

        def prepare(archive: _Archive, opened: Opened) -> tuple[Ask[_A], bool]:
            own = [archive.poses_in(each) for each in arrays]

            def ask(data: SceneData, effort: Effort, rows: slice) -> _A:
                return question(data, avatar, *(each[rows] for each in own), *what, effort=effort)

            return ask, opened.saw((client, name), avatar, own[-1], around)

        answers = self._each(question, len(arrays[0]), prepare, **options)
        self._metrics.answered(client, name, answers)
        return answers

    def collide(
        self,
        name: str,
        poses: ArrayLike,
        margin: float = 0.0,
        *,
        client: str = "",
        **options: Unpack[EngineOptions],
    ) -> CollideAnswers:
        """Whether avatar `name` touches any archive under each of the poses (k, 4, 4); see `Scene.collide`."""
        return self._ask(collide, name, client, [poses], (margin,), margin, options)

    def distance(
        self,
        name: str,
        poses: ArrayLike,
        reach: float,
        *,
        client: str = "",
        **options: Unpack[EngineOptions],
    ) -> DistanceAnswers:
        """How far avatar `name` is from the nearest of all archives under each pose; see `Scene.distance`."""
        return self._ask(distance, name, client, [poses], (reach,), reach, options)

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
        """Which pairs are in contact, of all archives together, deepest first; see `Scene.contacts`.

        Depths are compared by the rounded figure. A cluster is of one archive.
        """
        what = (limit, margin, cluster_distance)
        return limited(self._ask(contacts, name, client, [poses], what, margin, options), limit)

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
        """When avatar `name` first touches any archive on its way between poses; see `Scene.sweep`."""
        options.setdefault("tolerance", 1e-6)
        pose_from, pose_to = make_poses(pose_from), make_poses(pose_to)
        _check_as_many(len(pose_from), "poses to begin at", len(pose_to), "to end at")
        what = (margin, options["tolerance"])
        return self._ask(sweep, name, client, [pose_from, pose_to], what, margin, options)

    def raycast(
        self,
        origins: ArrayLike,
        directions: ArrayLike,
        reach: float,
        **options: Unpack[EngineOptions],
    ) -> RaycastAnswers:
        """Which sphere of all archives rays (k, 3), (k, 3) hit first, up to `reach` [m]; see `Scene.raycast`."""
        begins, ways = make_vectors(origins, "origins"), make_vectors(directions, "directions")
        _check_as_many(len(begins), "origins", len(ways), "directions")

        def prepare(archive: _Archive, _: Opened) -> tuple[Ask[RaycastAnswers], bool]:
            own, along = archive.points_in(begins), archive.ways_in(ways)
            return (lambda data, effort, k: raycast(data, own[k], along[k], reach, effort)), False

        answers = self._each(raycast, len(begins), prepare, **options)
        self._metrics.answered("", "", answers)
        return answers

    def within(self, points: ArrayLike, reach: float, **options: Unpack[EngineOptions]) -> WithinAnswers:
        """Which point of all archives is nearest to each loose point (k, 3), up to `reach` [m]; see `Scene.within`."""
        places = make_vectors(points, "points")

        def prepare(archive: _Archive, _: Opened) -> tuple[Ask[WithinAnswers], bool]:
            own = archive.points_in(places)
            return (lambda data, effort, k: within(data, own[k], reach, effort)), False

        answers = self._each(within, len(places), prepare, **options)
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
        """Which of several avatars touch any archive, and one another; see `Scene.objects`.

        What they do to one another is asked in the frame of the first archive.
        """
        items, poses = make_objects(objects)
        avatars = [self.avatar(item.avatar, client) for item in items]
        groups = np.array([item.group for item in items], np.uint32)
        masks = np.array([item.mask for item in items], np.uint32)

        def prepare(archive: _Archive, _: Opened) -> tuple[Ask[ObjectsAnswers], bool]:
            # Objects of no group meet nobody but the scene.
            first = archive is self._archives[0]
            own, group = archive.poses_in(poses), groups if first else groups & np.uint32(0)
            mask = masks if first else masks & np.uint32(SCENE_GROUP)

            def ask(data: SceneData, effort: Effort, k: slice) -> ObjectsAnswers:
                return ask_objects(data, avatars[k], own[k], group[k], mask[k], margin, effort)

            return ask, False

        answers = self._each(ask_objects, len(items), prepare, **options)
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
        """Ask `op` along the poses, of all archives together; the answers come part by part; see `Scene.path`."""
        avatar, array = self.avatar(name, client), make_poses(poses)
        taken: list[Opened] = []
        try:
            for archive in self._archives:
                taken.append(archive.scene.take())
            firsts = [0, *np.cumsum([sources_asked(opened) for opened in taken]).tolist()]
            legs = [
                Leg(
                    opened.radius_model(radius_model),
                    archive.pose,
                    first,
                    archive.poses_in(array),
                )
                for opened, archive, first in zip(taken, self._archives, firsts, strict=False)
            ]
            ask, total = along(legs, avatar, op, parameters, stop)

            def ask_held(start: int, end: int) -> Cost:
                with ExitStack() as stack:  # whoever wanted the parts may be gone, and their holds with them
                    for opened in taken:
                        stack.enter_context(opened.taken())
                    part = ask(start, end)
                self._metrics.answered(client, name, part)
                return part

            most = largest_part(op, parameters)
            ahead = (self._first.path_threads(client), 2 * threads) if threads > 1 else (None, 1)
            parts: Any = path_parts(ask_held, total, most, *ahead)
        except BaseException:
            for opened in taken:
                opened.release()
            raise
        for opened in taken:  # each lets one go
            parts = HeldParts(parts, opened)
        held: Iterator[Part] = parts
        return held


def _check_as_many(a: int, what: str, b: int, other: str) -> None:
    """BadRequestError unless there are as many of one as of the other."""
    if a != b:
        raise BadRequestError(f"{a} {what} and {b} {other}: expected as many")
