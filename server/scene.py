"""Scene: an archive opened in this process, and the questions asked of it. The same methods as `Client`."""

import os
import threading
import time
from collections.abc import Callable, Collection, Iterator, Sequence, Sized
from concurrent.futures import Executor
from contextlib import suppress
from pathlib import Path
from typing import Any, TypeVar, Unpack

import numpy as np
from numpy.typing import ArrayLike

from ..schemas.errors import BadRequestError, BusyError
from ..schemas.scene.scene_file import scene_of
from ..schemas.wire.answers import (
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
from ..schemas.wire.messages import AvatarInfo, ReloadAnswer, SceneInfo, StatsAnswer
from ..schemas.wire.requests import make_objects, make_poses
from .archives.archive_generation import HeldParts, Opened
from .archives.archive_info import describe, describe_scene, make_stats
from .avatars.avatar_model import AvatarModel
from .avatars.client_avatars import Avatars
from .observability.metrics import Metrics
from .queries.collide import collide
from .queries.contacts import contacts
from .queries.context.query_budget import Effort, EngineOptions, make_effort
from .queries.context.query_context import SceneData, with_stop
from .queries.distance import distance
from .queries.objects import objects as ask_objects
from .queries.path import PATH_THREADS, largest_part, path_parts, path_question
from .queries.raycast import raycast
from .queries.stopped_answers import ask_until_stopped
from .queries.sweep import sweep
from .queries.within import within
from .residency.voxel_cache import Residency
from .residency.voxel_store import OpenStore, Store
from .runtime.path_threads import PathThreads
from .runtime.process_heap import give_back_freed_memory
from .runtime.stop_flag import NEVER, Stop
from .served.avatar_limits import AvatarLimits
from .simulation.assembly import Simulated

_A = TypeVar("_A", bound=Cost)

DEFAULT_BUDGET = 512 << 20
# How long a reload waits for the last reader of the generation before the one that is current [s]: with a third one
# opened meanwhile, three budgets would be in memory.
RELOAD_WAIT = 10.0


class Scene(Simulated):
    """A served archive. Thread-safe; a context manager.

    name: what clients call it; the archive's folder name unless given. What is in the folder when the scene is opened
    stays what is asked, whatever becomes of the folder, until `reload`.
    """

    def __init__(
        self,
        store: Store,
        name: str,
        budget_bytes: int,
        policy: str,
        open_store: OpenStore,
        radius_model: str | None = None,
    ) -> None:
        """Serve the voxels of `store`; use `Scene.open`."""
        self.name, self._folder, self._open_store = name, store.archive.folder, open_store
        self._budget_bytes, self._policy, self._radius_model = budget_bytes, policy, radius_model
        self._metrics = Metrics()
        self._opened = self._open(store, 0)
        self._before: Opened | None = None  # swapped out; perhaps not ended yet
        self._info = describe_scene(describe(store, name), scene_of(name))
        self._avatars = Avatars()
        self._path_threads = PathThreads(name, max(PATH_THREADS, os.cpu_count() or 1))
        self._closed = False
        self._lock = threading.Lock()
        self._reloading = threading.Lock()

    @classmethod
    def open(
        cls,
        folder: str | Path,
        name: str | None = None,
        *,
        budget_bytes: int = DEFAULT_BUDGET,
        policy: str = "lru",
        open_store: OpenStore = Store,
        radius_model: str | None = None,
    ) -> "Scene":
        """Open the archive in `folder`, keeping at most budget_bytes of decoded voxels in memory.

        policy: which of them go first, and whether others are loaded before they are asked for, see eviction.py.
        open_store: opens the folder, now and at each reload (simulation/effects/through_effect.py).
        radius_model: of questions that name none, see schemas/archive/radius_model.py; None: the archive's one figure.
        Raises FormatError or CorruptError when it is no whole archive, BadRequestError for too small a budget.
        """
        store = open_store(folder)
        try:
            name = name or Path(folder).resolve().name
            return cls(store, name, budget_bytes, policy, open_store, radius_model)
        except BaseException:
            store.close()
            raise

    def __enter__(self) -> "Scene":
        """The scene itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close the archive."""
        self.close()

    def close(self) -> None:
        """Close the archive's files, once no part of a path is being computed and no reload is under way."""
        with self._lock:
            closed, self._closed = self._closed, True
        self._path_threads.close()
        if not closed:
            with self._reloading:
                self._opened.release()
                self._opened.join()

    def reload(self) -> ReloadAnswer:
        """Serve what is in the archive's folder now, opened and warmed beside what is served, then swapped for it.

        What was asked before is answered of the old generation, what is asked after this returns of the new one;
        avatars stay. The old one is closed with its last reader: until then both keep voxels in memory, `budget_bytes`
        each. Raises FormatError, CorruptError or BadRequestError, saying why, when the new one cannot be opened, and
        BusyError when the one before the old is still being read; the old one is served on.
        """
        begin = time.perf_counter()
        with self._reloading, self.take() as old:
            if self._before is not None and not self._before.ended.wait(RELOAD_WAIT):
                raise BusyError(
                    f"{self.name}: the generation before the one served is still asked, by a path perhaps: reload later"
                )
            store = self._open_store(self._folder)
            try:
                new = self._open(store, old.number + 1)
            except BaseException:
                store.close()
                raise
            try:
                new.warm()
                new.follow(old, lambda: self._closed)
                with self._lock:
                    if self._closed:
                        raise BadRequestError(f"{self.name}: closed while it was reloaded: open it again")
                    info = describe_scene(describe(store, self.name), scene_of(self.name))
                    self._opened, self._before, self._info = new, old, info
            except BaseException:
                new.release()
                raise
            old.release()
        before, now = old.store.archive.header, store.archive.header
        return ReloadAnswer(
            self.name, before.generation, now.generation, now.points, time.perf_counter() - begin
        )

    def _open(self, store: Store, number: int) -> Opened:
        """A generation as this scene serves it."""
        return Opened(
            store, self._budget_bytes, self._policy, number, self._metrics.loaded, self._radius_model
        )

    def take(self) -> Opened:
        """What is asked now, to be released: for a `with`. BadRequestError when closed."""
        while True:
            opened = self._opened
            if opened.take():
                return opened
            if opened is self._opened:  # nobody swapped it: it was closed
                return opened.taken()

    def path_threads(self, client: str) -> Executor:
        """Return what computes the parts of a client's paths: threads, one a core, that all clients share in turn."""
        return self._path_threads.of(client)

    def avatar(self, name: str, client: str) -> AvatarModel:
        """Return a client's avatar, or the scene's own. Raises UnknownAvatarError."""
        return self._avatars.get(name, client)

    @property
    def _data(self) -> SceneData:
        """What a question without a radius model reads now."""
        return self._opened.data

    @property
    def residency(self) -> Residency:
        """The resident voxels, for counters and checks."""
        return self._data.residency

    def warm(self) -> None:
        """Ask one of everything, a load included, so that nobody waits for compilers after; start the threads."""
        self._path_threads.start()
        with self.take() as opened:
            opened.warm()

    def info(self) -> SceneInfo:
        """What is served: counts, bounds, lattice, radius, sources."""
        return self._info

    def stats(self, keys: bool = False) -> StatsAnswer:
        """What is in memory, what was asked, and what had to be waited for. keys: name the resident voxels, too."""
        with self.take() as opened:
            coarse = opened.data.coarse
            return make_stats(
                opened.store,
                self.name,
                opened.data.residency,
                self._metrics,
                coarse_bytes=0 if coarse is None else coarse.bytes,
                avatars=self._avatars.stats(),
                keys=keys,
            )

    def limit_avatars(self, limits: AvatarLimits) -> None:
        """Limit the memory of clients' avatars from now on; those that are there stay."""
        self._avatars.limits = limits

    def drop_unused_avatars(self, alive: Collection[str], seconds: float) -> None:
        """Forget avatars that were not used for so long [s], but for those of clients in `alive`."""
        if self._avatars.drop_unused(alive, seconds):
            give_back_freed_memory()

    def add_avatar(
        self, name: str, points: ArrayLike, radius: float | None = None, *, client: str = ""
    ) -> AvatarInfo:
        """Add an avatar of points (n, 3) float64, avatar frame [m].

        radius: of each point's sphere [m]; None: half the mean closest-point distance of the points.
        client: whose it is; avatars of different clients do not meet. The same name again with the same points and
        radius changes nothing; with others it is a BadRequestError. TooLargeError: over the limits.
        """
        model = self._avatars.add(name, points, radius, client)
        return AvatarInfo(name, len(model.points), model.radius, model.bounding_radius)

    def _terms(
        self,
        opened: Opened,
        tolerance: float = 0.0,
        budget_ms: float | None = None,
        budget_visits: int | None = None,
        radius_model: str | None = None,
        stop: Stop = NEVER,
    ) -> tuple[SceneData, Effort]:
        """What a question with these options reads, and what it may cost."""
        effort = make_effort(tolerance, budget_ms, budget_visits, stop)
        data = opened.data if radius_model is None else opened.radius_model(radius_model)
        return with_stop(data, effort.stop), effort

    def _ask(
        self,
        question: Callable[..., _A],
        name: str,
        client: str,
        poses: ArrayLike,
        what: tuple[Any, ...],
        around: float,
        options: EngineOptions,
    ) -> _A:
        """Ask about an avatar under some poses; the last one says where its user is.

        question: takes scene, avatar, `what`, and `effort`.  around: margin or reach [m].
        """
        with self.take() as opened:
            data, effort = self._terms(opened, **options)
            avatar = self.avatar(name, client)
            if opened.saw((client, name), avatar, poses, around):
                effort = effort._replace(scan=True)
            answers = ask_until_stopped(
                question, _count(poses), effort, lambda: question(data, avatar, *what, effort=effort)
            )
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
        """Whether avatar `name` touches the scene under each of the poses (k, 4, 4); see server/queries/collide.py.

        options, here and below: tolerance [m], budget_ms, budget_visits: what the answer may cost, see
        server/queries/context/query_budget.py; radius_model: how large the scan's spheres are, see
        schemas/archive/radius_model.py, None: as the scene was opened.
        """
        return self._ask(collide, name, client, poses, (poses, margin), margin, options)

    def distance(
        self,
        name: str,
        poses: ArrayLike,
        reach: float,
        *,
        client: str = "",
        **options: Unpack[EngineOptions],
    ) -> DistanceAnswers:
        """How far avatar `name` is from the scene under each pose, up to `reach` [m].

        See server/queries/distance.py.
        """
        return self._ask(distance, name, client, poses, (poses, reach), reach, options)

    def contacts(
        self,
        name: str,
        poses: ArrayLike,
        limit: int = 100,
        margin: float = 0.0,
        cluster_distance: float | None = None,
        *,
        client: str = "",
        **options: Unpack[EngineOptions],
    ) -> ContactsAnswers:
        """Which pairs of points are in contact under each of the poses, deepest first.

        See server/queries/contacts.py.
        """
        what = (poses, limit, margin, cluster_distance)
        return self._ask(contacts, name, client, poses, what, margin, options)

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
        """When avatar `name` first touches the scene on its way between poses; see server/queries/sweep.py."""
        options.setdefault("tolerance", 1e-6)
        what = (pose_from, pose_to, margin, options["tolerance"])
        return self._ask(sweep, name, client, pose_to, what, margin, options)

    def raycast(
        self,
        origins: ArrayLike,
        directions: ArrayLike,
        reach: float,
        **options: Unpack[EngineOptions],
    ) -> RaycastAnswers:
        """Which scan point's sphere rays (k, 3), (k, 3) hit first, up to `reach` [m]; see server/queries/raycast.py."""
        with self.take() as opened:
            data, effort = self._terms(opened, **options)
            answers = ask_until_stopped(
                raycast, _count(origins), effort, lambda: raycast(data, origins, directions, reach, effort)
            )
        self._metrics.answered("", "", answers)
        return answers

    def within(
        self,
        points: ArrayLike,
        reach: float,
        **options: Unpack[EngineOptions],
    ) -> WithinAnswers:
        """Which scan point is nearest to each loose point (k, 3), up to `reach` [m]; see server/queries/within.py."""
        with self.take() as opened:
            data, effort = self._terms(opened, **options)
            answers = ask_until_stopped(
                within, _count(points), effort, lambda: within(data, points, reach, effort)
            )
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
        """Which of several avatars (name, pose, group = 1, mask = all) touch the scene and one another.

        See server/queries/objects.py.
        """
        with self.take() as opened:
            data, effort = self._terms(opened, **options)
            items, poses = make_objects(objects)
            avatars = [self.avatar(item.avatar, client) for item in items]
            groups = np.array([item.group for item in items], np.uint32)
            masks = np.array([item.mask for item in items], np.uint32)
            answers = ask_until_stopped(
                ask_objects,
                len(items),
                effort,
                lambda: ask_objects(data, avatars, poses, groups, masks, margin, effort),
            )
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
        """Ask `op` (collide, distance, contacts, sweep) along the poses; the answers come part by part, in order.

        parameters: what `op` takes beside the poses, tolerance and budgets included; `budget_ms` is for the whole path.
        threads: parts computed at a time.  sweep: k - 1 motions, from each pose to the next. Every part is the answer
        of its question for [first, first + n) of `total`. All poses are checked before the first part.
        """
        opened = self.take()
        try:
            data, avatar = opened.radius_model(radius_model), self.avatar(name, client)
            ask, total = path_question(data, avatar, make_poses(poses), op, parameters, stop)

            def ask_held(start: int, end: int) -> Cost:
                with opened.taken():  # whoever wanted the parts may be gone, and their hold with them
                    part = ask(start, end)
                self._metrics.answered(client, name, part)
                return part

            most = largest_part(op, parameters)
            ahead = (self.path_threads(client), 2 * threads) if threads > 1 else (None, 1)
            return HeldParts(path_parts(ask_held, total, most, *ahead), opened)
        except BaseException:
            opened.release()
            raise

    def drop_client(self, client: str) -> None:
        """Forget the avatars of a client that is gone."""
        self._avatars.drop_client(client)
        with suppress(BadRequestError), self.take() as opened:  # closed, it keeps nothing for anybody
            opened.prefetcher.leave_client(client)
        self._metrics.drop_client(client)


def _count(rows: ArrayLike) -> int:
    """Return how many rows an argument has; 0 for one that the question is about to refuse."""
    return len(rows) if isinstance(rows, Sized) else 0
