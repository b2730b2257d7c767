"""Scene: placed archives opened in this process, with the query methods of `Client`."""

import os
import threading
import time
from collections.abc import Collection, Mapping, Sequence
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

from msgspec import structs
from numpy.typing import ArrayLike

from ..schemas.errors import BadRequestError, CorruptError, SolidcloudError
from ..schemas.scene.scene_file import SceneFile, read_scene, scene_name, scene_of
from ..schemas.wire.key_expressions import User, check_name
from ..schemas.wire.motion_messages import FRAME_SECONDS, WAIT, Moved, checked_late
from ..schemas.wire.overview_messages import OverviewAnswer, OverviewRequest
from ..schemas.wire.requests import AddAvatarRequest, make_positions
from ..schemas.wire.scene_messages import AvatarInfo, ReloadAnswer, SceneInfo
from ..schemas.wire.stats import StatsAnswer
from ..schemas.wire.tile_messages import TileAnswer, VoxelsAnswer, tile_request, voxels_request
from ..schemas.wire.warming_parts import MOTION, PARTS
from .archives.placed_archive import PlacedArchive
from .archives.scene_info import describe_scene, join_infos, make_stats
from .avatars.avatar_model import describe_avatar
from .avatars.avatar_shape import MeshLike, avatar_shape
from .avatars.client_avatars import check_owner
from .observability.request_stats import RequestStats
from .queries.context.query_context import SceneData
from .residency.voxel_cache import VoxelCache
from .residency.voxel_store import OpenStore, VoxelStore
from .runtime.process_heap import give_back_freed_memory
from .runtime.stop_flag import NO_STOP, StopFlag
from .scene_interface import EVERYBODY, AvatarLimits, AvatarShape, list_avatars
from .scenes.residency_watch import ResidencyWatch
from .scenes.scene_archives import (
    ReadPoints,
    error_location,
    find_archives,
    is_scene_file,
    open_archives,
    read_avatars,
)
from .scenes.scene_questions import SceneQuestions
from .simulation.local_session import LocalSession
from .simulation.simulation import Simulation, make_simulation
from .tiles.scene_overview import read_overview
from .tiles.voxel_list import list_voxels
from .tiles.voxel_tile import read_tile

DEFAULT_BUDGET = 512 << 20


class Scene(SceneQuestions):
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
        avatars: Mapping[str, AvatarShape] | None = None,
    ) -> None:
        """Serve archives, which this scene closes with itself; callers use `Scene.open`.

        metrics: statistics of answers, and of the loads of these archives; None: new ones.
        file: declares effects, objects and limits; None: the effect `stop` alone.
        avatars: avatars that every client may use, by name.
        Raise BadRequestError if there is no archive, or an avatar is invalid.
        """
        if not archives:
            raise BadRequestError(f"{name}: a scene without archives: expected at least one")
        super().__init__(archives, name, RequestStats() if metrics is None else metrics)
        self._file = scene_of(name) if file is None else file
        self._simulation: Simulation | None = None
        self._making = threading.Lock()
        self._own = [
            self.add_avatar(each, shape, client=EVERYBODY) for each, shape in (avatars or {}).items()
        ]

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
        read_points: ReadPoints | None = None,
        level_bytes: int | None = None,
    ) -> "Scene":
        """Open the folder of an archive, or a scene file (TOML) and everything that it names.

        name: for clients; None: the name in the scene file, else that of the file or folder.
        budget_bytes: limit of decoded voxels in memory, all archives together.
        policy: eviction policy, and whether voxels are prefetched; see eviction.py.
        open_store: function that opens the folder, now and at each reload; None: `VoxelStore`.
        radius_model: default radius model, see schemas/archive/radius_model.py; None: the archive's
        single radius. `open_store` and `radius_model` are refused for a scene file, which declares
        them itself.
        read_points: returns the points (n, 3) of an avatar's file [m]; None: files are read as by
        `add_avatar`.
        level_bytes: the part of `budget_bytes` for levels of detail, which answer requests with a
        tolerance before voxels are loaded; None: a sixteenth, 0: none.
        Raise FormatError, CorruptError or ScanError for an invalid file, BadRequestError for an
        invalid scene file or a budget that is too small.
        """
        path = Path(path)
        if is_scene_file(path):
            if open_store is not None or radius_model is not None:
                raise BadRequestError(f"{path}: a scene file: expected no open_store and no radius_model")
            return cls._open_file(path, name, budget_bytes, policy, read_points, level_bytes)
        metrics = RequestStats()
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

    @classmethod
    def _open_file(
        cls,
        path: Path,
        name: str | None,
        budget_bytes: int,
        policy: str,
        read_points: ReadPoints | None,
        level_bytes: int | None,
    ) -> "Scene":
        """Open a scene file; see `open`. Errors name the file and the place in it."""
        file = read_scene(path)
        name = name or scene_name(file, path)
        found = find_archives(file, path)
        avatars = read_avatars(file, path, read_points)
        own = {each.info.name: each.shape for each in avatars}
        metrics = RequestStats()
        with ExitStack() as stack:
            archives = open_archives(
                file, path, name, found, budget_bytes, policy, metrics.loaded, level_bytes
            )
            for archive in archives:
                stack.callback(archive.close)
            with error_location(path, "$.effects"):
                scene = cls(archives, name, metrics, file, own)
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
            with ExitStack() as stack:
                each = [stack.enter_context(archive.take()).store.archive for archive in self.archives]
                points = sum(archive.header.points for archive in each)
                voxels = sum(len(archive.voxels) for archive in each)
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
        with ExitStack() as stack:
            each = [stack.enter_context(archive.take()) for archive in self.archives]
            found = make_stats(self.name, each, self._metrics, self._avatars.stats(), keys=keys)
        effects = [] if self._simulation is None else self._simulation.effect_stats()
        return structs.replace(found, effects=effects)

    def overview(self, limit: int = 100_000) -> OverviewAnswer:
        """Return a sample of the points of all archives; see `OverviewAnswer`.

        It is that of the archives' previews: how long it takes does not depend on the number of
        points.
        """
        request = OverviewRequest(limit)
        with ExitStack() as stack:
            opened = [stack.enter_context(archive.take()).store for archive in self.archives]
            return read_overview(request, self.archives, opened)

    def voxels(self, place: ArrayLike, reach: float | None = None, limit: int = 4096) -> VoxelsAnswer:
        """Return the voxels near a place (3,) [m], nearest first; see `VoxelsRequest`."""
        request = voxels_request(place, reach, limit)
        with ExitStack() as stack:
            opened = [stack.enter_context(archive.take()) for archive in self.archives]
            return list_voxels(request, self.archives, opened)

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
                return read_tile(request, placed, opened.store, opened.level_archive)
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
        model = self._avatars.add(name, request.points, request.radius, client, request.inner_points)
        return describe_avatar(name, model, shape.description)

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
