"""Scene: placed archives opened in this process, with the query methods of `Client`."""

import os
import threading
import time
from collections.abc import Collection, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from msgspec import structs
from numpy.typing import ArrayLike

from ..schemas.archive.pose_arrays import make_poses
from ..schemas.errors import BadRequestError, CorruptError, SolidcloudError
from ..schemas.scene.scene_file import SceneFile, read_scene, scene_name, scene_of
from ..schemas.wire.answers import Cost, Part
from ..schemas.wire.key_expressions import User, check_name
from ..schemas.wire.motion_messages import FRAME_SECONDS, WAIT, Moved, checked_late
from ..schemas.wire.overview_messages import OverviewAnswer, OverviewRequest
from ..schemas.wire.question_rules import Question
from ..schemas.wire.requests import AddAvatarRequest, make_objects, make_positions, make_vectors
from ..schemas.wire.scene_messages import AvatarInfo, ReloadAnswer, SceneInfo
from ..schemas.wire.stats import StatsAnswer
from ..schemas.wire.tile_messages import TileAnswer, VoxelsAnswer, tile_request, voxels_request
from ..schemas.wire.warming_parts import MOTION, PARTS
from .archives.ask_archives import (
    PathParts,
    PlacedItems,
    PlaceItems,
    ask_along,
    ask_each,
    hold_archives,
    release,
)
from .archives.merge_answers import limit_pairs
from .archives.placed_archive import ArchiveGeneration, PlacedArchive
from .archives.residency_watch import ResidencyWatch, make_stats
from .archives.scene_info import describe_scene, join_infos
from .avatars.avatar_model import AvatarModel, describe_avatar
from .avatars.avatar_shape import MeshLike, avatar_shape
from .avatars.client_avatars import Avatars, check_owner
from .observability.request_stats import RequestStats
from .open_scene_file import (
    FoundAvatar,
    error_location,
    find_archives,
    is_scene_file,
    open_archives,
    read_avatars,
)
from .queries.engine_table import ENGINES
from .queries.load_and_search import unknown_answers
from .queries.objects import SCENE_GROUP
from .queries.path import PATH_THREADS, largest_part, path_parts
from .queries.query_inputs import EXACT, QueryBudget, SceneData, make_budget, with_stop
from .residency.voxel_cache import VoxelCache
from .residency.voxel_store import OpenStore, VoxelStore
from .runtime.path_threads import PathThreads
from .runtime.process_heap import give_back_freed_memory
from .runtime.stop_flag import NO_STOP, StopFlag, StoppedError
from .scene_interface import AvatarLimits, AvatarShape, QueryMethods, list_avatars
from .simulation.simulation import LocalSession, Simulation, make_simulation
from .tiles.scene_overview import read_overview
from .tiles.voxel_list import list_voxels
from .tiles.voxel_tile import read_tile

_A = TypeVar("_A", bound=Cost)

DEFAULT_BUDGET = 512 << 20


class Scene(QueryMethods):
    """One or more placed archives, queried as one. Thread-safe; a context manager.

    name: name of the scene for clients. Until `reload`, answers are those of the archives' content
    at opening, whatever happens to the folders.
    """

    def __init__(
        self,
        archives: Sequence[PlacedArchive],
        name: str,
        metrics: RequestStats | None = None,
        file: SceneFile | None = None,
        avatars: Sequence[FoundAvatar] = (),
    ) -> None:
        """Serve archives, which this scene closes with itself; callers use `Scene.open`.

        metrics: statistics of answers, and of the loads of these archives; None: new ones.
        file: declares effects, objects and limits; None: the effect `stop` alone.
        avatars: avatars that every client may use.
        Raise BadRequestError if there is no archive.
        """
        if not archives:
            raise BadRequestError(f"{name}: a scene without archives: expected at least one")
        self.name, self.archives = name, list(archives)
        # A single archive at the identity takes the arguments of a request unchanged.
        self._alone = self.archives[0] if len(archives) == 1 and archives[0].pose is None else None
        self._metrics, self._avatars = RequestStats() if metrics is None else metrics, Avatars()
        self._path_threads = PathThreads(name, max(PATH_THREADS, os.cpu_count() or 1))
        self._file = scene_of(name) if file is None else file
        self._simulation: Simulation | None = None
        self._making = threading.Lock()
        self._own = [each.info for each in avatars]
        for each in avatars:
            self._avatars.provide(each.info.name, each.model)

    @classmethod
    def open(
        cls,
        path: str | Path,
        name: str | None = None,
        *,
        budget_bytes: int = DEFAULT_BUDGET,
        policy: str = "lru",
        open_store: OpenStore | None = None,
        radius_model: str | None = None,
        level_bytes: int | None = None,
    ) -> "Scene":
        """Open the folder of an archive, or a scene file (TOML) and everything that it names.

        name: for clients; None: the name in the scene file, else that of the file or folder.
        budget_bytes: limit of decoded voxels in memory, all archives together.
        policy: eviction policy, and whether voxels are prefetched; see voxel_cache.py.
        open_store: function that opens the folder, now and at each reload; None: `VoxelStore`.
        radius_model: default radius model, see schemas/archive/radius_model.py; None: the archive's
        single radius. `open_store` and `radius_model` are refused for a scene file, which declares
        them itself.
        level_bytes: the part of `budget_bytes` for levels of detail, which answer requests with a
        tolerance before voxels are loaded; None: a sixteenth, 0: none.
        Raise FormatError, CorruptError or ScanError for an invalid file, BadRequestError for an
        invalid scene file or a budget that is too small.
        """
        path, metrics = Path(path), RequestStats()
        if not is_scene_file(path):
            archive = PlacedArchive(
                path,
                name,
                budget_bytes=budget_bytes,
                policy=policy,
                open_store=open_store or VoxelStore,
                radius_model=radius_model,
                took=metrics.loaded,
                level_bytes=level_bytes,
            )
            return cls([archive], archive.name, metrics)
        if open_store is not None or radius_model is not None:
            raise BadRequestError(f"{path}: a scene file: expected no open_store and no radius_model")
        file = read_scene(path)
        name = name or scene_name(file, path)
        with ExitStack() as stack:
            found = find_archives(file, path, stack)
            avatars = read_avatars(file, path)
            archives = open_archives(
                file, path, name, found, budget_bytes, policy, metrics.loaded, level_bytes
            )
            for archive in archives:
                stack.callback(archive.close)
            with error_location(path, "$.effects"):
                scene = cls(archives, name, metrics, file, avatars)
                scene._simulation = make_simulation(scene, file)
            stack.pop_all()
        return scene

    def __enter__(self) -> "Scene":
        """Return the scene itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close the archives."""
        self.close()

    def __repr__(self) -> str:
        """Return the name, the size and the avatars in one line."""
        try:
            with self._taken() as each:
                points = sum(opened.store.archive.header.points for opened in each)
                voxels = sum(len(opened.store.archive.voxels) for opened in each)
        except BadRequestError:
            return f"<Scene {self.name!r}: closed>"
        size = f"{points:,} points in {voxels:,} voxels" + (
            f" of {len(each)} archives" if len(each) > 1 else ""
        )
        return f"<Scene {self.name!r}: {size}, {list_avatars(self._avatars.names())}>"

    def close(self) -> None:
        """Wait for parts of paths and reloads in progress, then close the archives' files."""
        self._path_threads.close()
        with ExitStack() as stack:
            for archive in self.archives:
                stack.callback(archive.close)

    def reload(self) -> ReloadAnswer:
        """Serve the current content of the archives' folders.

        A new generation of each archive is opened and warmed while the old one is served, and then
        replaces it. Requests that began before are answered from the old generation, requests that
        begin after this returns from the new one. Avatars stay. The old generation is closed when
        its last reader leaves; until then both keep voxels in memory, `budget_bytes` each.

        Several archives are reloaded one after the other. If one cannot be opened, the archives
        before it are new, and it and those after it are served unchanged.
        Raise FormatError, CorruptError or BadRequestError if a new generation cannot be opened, and
        BusyError if the generation before the old one is still being read.
        """
        begin = time.perf_counter()
        each: list[ReloadAnswer] = []
        for number, archive in enumerate(self.archives):
            try:
                each.append(archive.reload())
            except SolidcloudError as error:
                if len(self.archives) > 1:
                    count = len(self.archives)
                    new = f": of {count} archives the first {number} are reloaded" if number else ""
                    error.args = (f"archive {number}: {error}{new}",)
                raise
        before, after = (sum(getattr(a, f"generation_{side}") for a in each) for side in ("before", "after"))
        return ReloadAnswer(
            self.name, before, after, sum(a.points for a in each), time.perf_counter() - begin
        )

    @contextmanager
    def _taken(self) -> Iterator[list[ArchiveGeneration]]:
        """Return the current generation of each archive, for a `with`."""
        with ExitStack() as stack:
            yield [stack.enter_context(archive.take()) for archive in self.archives]

    @property
    def _data(self) -> SceneData:
        """Return the scene data of the first archive, with the default radius model."""
        with self.archives[0].take() as opened:
            return opened.data

    @property
    def residency(self) -> VoxelCache:
        """Return the voxel cache of the first archive, for counters and checks."""
        return self.archives[0].residency

    def warm(self, *parts: str) -> None:
        """Run every query and some frames, to compile before the first request; start threads.

        parts: of schemas/wire/warming_parts.py, in their order; none: all. Users that are present do
        not notice: the frames are those of another simulation.
        """
        self._path_threads.start()
        for archive in self.archives:
            archive.warm(*parts)
        if MOTION in (parts or PARTS):
            make_simulation(self, self._file).warm()

    def info(self) -> SceneInfo:
        """Return the description of all archives together, with the effects of the scene file."""
        found = join_infos(self.name, [(archive.info(), archive.pose) for archive in self.archives])
        return describe_scene(found, self._file, self._own)

    def stats(self, keys: bool = False) -> StatsAnswer:
        """Return statistics of cache, requests and waits. keys: also list the resident voxels."""
        with self._taken() as each:
            found = make_stats(self.name, each, self._metrics, self._avatars.stats(), keys=keys)
        effects = [] if self._simulation is None else self._simulation.effect_stats()
        return structs.replace(found, effects=effects)

    def overview(self, limit: int = 100_000) -> OverviewAnswer:
        """Return a sample of the points of all archives; see `OverviewAnswer`.

        It is that of the archives' previews: how long it takes does not depend on the number of
        points.
        """
        request = OverviewRequest(limit)
        with self._taken() as each:
            return read_overview(request, self.archives, [opened.store for opened in each])

    def voxels(self, place: ArrayLike, reach: float | None = None, limit: int = 4096) -> VoxelsAnswer:
        """Return the voxels near a place (3,) [m], nearest first; see `VoxelsRequest`."""
        request = voxels_request(place, reach, limit)
        with self._taken() as each:
            return list_voxels(request, self.archives, each)

    def residency_changes(self) -> ResidencyWatch:
        """Return the changes of what is resident from now on, for a `with`; see `ResidencyChanges`."""
        return ResidencyWatch(self.archives)

    def tile(
        self, archive: int, voxel: Sequence[int], detail: int = 0, level: int | None = None
    ) -> TileAnswer:
        """Return points or spheres of a voxel; see `TileRequest`. Raise BadRequestError, CorruptError.

        The record is read from the archive's file, and not added to the voxels in memory.
        """
        request = tile_request(archive, voxel, detail, level)
        if request.archive >= len(self.archives):
            raise BadRequestError(f"archive {archive}: expected below {len(self.archives)}")
        placed = self.archives[request.archive]
        with placed.take() as opened:
            try:
                coarse = opened.level.store.archive if opened.level else None
                return read_tile(request, placed, opened.store, coarse)
            except OSError as error:
                raise CorruptError(
                    f"voxel {request.voxel}: cannot be read ({error}): check the disk"
                ) from error

    def limit_avatars(self, limits: AvatarLimits) -> None:
        """Limit the memory of clients' avatars from now on; existing ones stay."""
        self._avatars.limits = limits

    def drop_unused_avatars(self, alive: Collection[str], seconds: float) -> None:
        """Drop avatars that were not used for `seconds` [s].

        Avatars of clients in `alive`, and of clients whose users have bodies, stay.
        """
        if self._simulation is not None:
            alive = {*alive, *(user.client for user in self._simulation.users)}
        if self._avatars.drop_unused(alive, seconds):
            give_back_freed_memory()

    def add_avatar(
        self,
        name: str,
        points: "ArrayLike | str | os.PathLike[str] | MeshLike | AvatarShape",
        radius: float | None = None,
        *,
        client: str = "",
        up: str | None = None,
        units: str | None = None,
        scale: float = 1.0,
        hollow: bool = False,
    ) -> AvatarInfo:
        """Add an avatar: points (n, 3), the path of a scan or mesh file, or a mesh object.

        name: 1 to 64 characters.
        points: in the avatar's frame [m]. A file has any format that `solidcloud build` reads. A
        mesh object has `vertices` and `faces`, such as a `trimesh.Trimesh`. The surface of a mesh
        is covered with points, so that no part of it is farther than the radius from one. So is the
        inside of a closed mesh. An open mesh and points are surfaces: what they surround untouched
        is `clear`.
        radius: of each point's sphere [m]; None: half the mean closest-point distance of the
        points, for a mesh a hundredth of the square root of its area.
        up, units: of a file: its axis that points up and its unit, in the words of scan lists, such
        as "y" and "mm"; None: as its format states (glTF: "y"), otherwise "z" and "m".
        scale: factor of all lengths, the radius too, 0.001 to 1000.
        hollow: leave the inside of a closed mesh empty.
        client: owner; clients may use the same names for different avatars. Adding the same avatar
        again changes nothing. The answer's `description` says what was taken.
        Raise BadRequestError for an avatar without points, or if the name belongs to a different
        one, ScanError if the file cannot be read, TooLargeError beyond the limits.
        """
        shape = avatar_shape(points, radius, up=up, units=units, scale=scale, hollow=hollow)
        request = AddAvatarRequest(name, make_positions(shape.points), shape.radius, shape.inner_points)
        model = self._avatars.add(request, client)
        return describe_avatar(name, model, shape.description)

    def avatar(self, name: str, client: str) -> AvatarModel:
        """Return an avatar of the client or of the scene. Raise UnknownAvatarError."""
        return self._avatars.get(name, client)

    def ask(self, question: Question[_A], *arguments: Any, client: str = "", **options: Any) -> _A:
        """Answer a question for all archives together; server/queries defines each answer.

        arguments: the fields of its request, in their order, avatars by name.
        client: owner of the avatars.
        options: the remaining fields by name, and

        - budget_ms, and tolerance [m] and relative_tolerance of questions that take them: see
          server/queries/query_inputs.py,
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
                k = len(make_poses(rows)) if question.about_avatars else len(rows)
                answers = unknown_answers(question, k, budget)
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
            ahead = (self._path_threads.of(client), 2 * threads) if threads > 1 else (None, 1)
            return PathParts(path_parts(ask_part, total, most, *ahead), held)
        except BaseException:
            release(held)
            raise

    @property
    def simulation(self) -> Simulation:
        """Return the simulation of this scene's users, which is made at its first use."""
        with self._making:
            if self._simulation is None:
                self._simulation = make_simulation(self, self._file)
            return self._simulation

    def move(
        self,
        name: str,
        pose_from: ArrayLike,
        pose_to: ArrayLike,
        seconds: float = FRAME_SECONDS,
        *,
        late: str = WAIT,
        client: str = "",
        stop: StopFlag = NO_STOP,
    ) -> Moved:
        """Return the pose that an avatar reaches from one pose to another in a frame.

        pose_from, pose_to: (4, 4) or (1, 4, 4) float64, avatar to world.
        seconds: duration of the frame. Nothing is stored. See `Simulation.move`.
        late: "wait" for voxels that are not in memory, or answer by "bounds": WIRE.md, "Sessions".
        """
        return self.simulation.move(name, pose_from, pose_to, seconds, late=late, client=client, stop=stop)

    def session(self, avatar: str, *, late: str = WAIT, client: str = "") -> LocalSession:
        """Return a session of an avatar of the client or of the scene, for a `with`.

        It takes motion commands and returns the resulting states. Each command is simulated in a
        separate frame. avatar: 1 to 64 of A-Z, a-z, 0-9, '.', '_' and '-'.
        late: what frames do about voxels that are not in memory: "wait" until they are loaded, or
        go only as far as "bounds" of these voxels prove the way clear.
        """
        check_owner(client)
        user = User(client, check_name(avatar, "avatar of a session"))
        return LocalSession(self.simulation, user, checked_late(late))

    def plot(
        self,
        avatar: str | None = None,
        poses: ArrayLike | None = None,
        answers: Any = None,
        *,
        path: str | os.PathLike[str] | None = None,
        heights: tuple[float, float] | None = None,
        axes: Any = None,
        points: int = 2_000_000,
        client: str = "",
    ) -> Any:
        """Draw a floor plan with poses marked by verdict; return the figure of matplotlib.

        avatar: its name.  poses: (4, 4) or (k, 4, 4), avatar to world; None: the whole scene is drawn.
        answers: of any query about these poses; None: those of `collide`.
        path: file to write too, PNG, SVG or PDF by its suffix.
        heights: range of heights to draw [m]; None: those of the avatar at its median pose, above
        the floor, or without an avatar all.
        axes: matplotlib's axes to draw into; None: a new figure.
        points: number of points to read, those near the poses first. Other voxels are drawn as
        boxes.  client: owner of the avatar.
        Raise BadRequestError for poses without an avatar or answers, SolidcloudError if matplotlib
        is not installed (extra `report`), and the errors of `collide`.
        """
        from .pictures.floor_plan import plot_scene, write_figure

        figure = plot_scene(self, avatar, poses, answers, heights, axes, points, client)
        if path is not None:
            write_figure(figure, Path(path))
        return figure

    def drop_client(self, client: str) -> None:
        """Drop the bodies and avatars of a disconnected client, and stop keeping voxels for it."""
        if self._simulation is None:
            self.forget_client(client)
        else:
            self._simulation.drop_client(client)

    def forget_client(self, client: str) -> None:
        """Drop the avatars of a client and stop keeping voxels for it; its bodies stay.

        The simulation of this scene calls it.
        """
        self._avatars.drop_client(client)
        for archive in self.archives:
            with suppress(BadRequestError):  # a closed archive keeps no voxels
                archive.leave_client(client)
        self._metrics.drop_client(client)


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
