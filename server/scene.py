"""Scene: placed archives opened in this process, and their queries. It has the methods of `Client`."""

import threading
import time
from collections.abc import Collection, Mapping, Sequence
from contextlib import ExitStack, suppress
from pathlib import Path

from numpy.typing import ArrayLike

from ..schemas.errors import BadRequestError, SolidcloudError
from ..schemas.scene.scene_file import SceneFile, read_scene, scene_name, scene_of
from ..schemas.wire.key_expressions import User, check_name
from ..schemas.wire.motion_messages import FRAME_SECONDS, Moved
from ..schemas.wire.scene_messages import AvatarInfo, ReloadAnswer, SceneInfo
from ..schemas.wire.stats import StatsAnswer
from .archives.archive_info import describe_scene
from .archives.placed_archive import PlacedArchive
from .archives.scene_info import join_infos, make_stats
from .observability.request_stats import RequestStats
from .queries.context.query_context import SceneData
from .residency.voxel_cache import VoxelCache
from .residency.voxel_store import OpenStore, VoxelStore
from .runtime.process_heap import give_back_freed_memory
from .runtime.stop_flag import NO_STOP, StopFlag
from .scene_interface import EVERYBODY, AvatarLimits
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
from .simulation.make_simulation import make_simulation
from .simulation.simulation import Simulation

DEFAULT_BUDGET = 512 << 20


class Scene(SceneQuestions):
    """One or more placed archives, served as one. Thread-safe; a context manager.

    name: what clients call it; the name in the scene file, or that of the file or folder, unless
    given. Answers are those of the archives' content at opening, whatever happens to the folders,
    until `reload`.
    """

    def __init__(
        self,
        archives: Sequence[PlacedArchive],
        name: str,
        metrics: RequestStats | None = None,
        file: SceneFile | None = None,
        avatars: Mapping[str, tuple[ArrayLike, float | None]] | None = None,
    ) -> None:
        """Serve archives, which are closed with this scene; call `Scene.open` instead.

        metrics: counts what is answered, and the loads of these archives.
        file: declares effects, objects and limits; None: the effect `stop` alone.
        avatars: the scene's own, which every client may ask about: points (n, 3) [m] and radius, by
        name. Raises BadRequestError if there is no archive, or an avatar is invalid.
        """
        if not archives:
            raise BadRequestError(f"{name}: a scene without archives: expected at least one")
        super().__init__(archives, name, RequestStats() if metrics is None else metrics)
        self._file = scene_of(name) if file is None else file
        self._simulation: Simulation | None = None
        self._making = threading.Lock()
        self._own = [
            self.add_avatar(each, points, radius, client=EVERYBODY)
            for each, (points, radius) in (avatars or {}).items()
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
    ) -> "Scene":
        """Open the folder of an archive, or a scene file (TOML) and everything that it names.

        name: for clients; None: the name in the scene file, else that of the file or folder.
        budget_bytes: maximum of decoded voxels in memory, all archives together.
        policy: of eviction, and whether voxels are prefetched; see eviction.py.
        open_store: opens the folder of an archive, now and at each reload; None: as it is.
        radius_model: of questions that name none, see schemas/archive/radius_model.py; None: the
        archive's single radius. Both are for an archive; a scene file declares them.
        read_points: returns the points (n, 3) of a file of an avatar [m]; None: reads scans and
        meshes.
        Raises FormatError, CorruptError or ScanError for an invalid file, BadRequestError for an
        invalid scene file, or too small a budget.
        """
        path = Path(path)
        if is_scene_file(path):
            if open_store is not None or radius_model is not None:
                raise BadRequestError(f"{path}: a scene file: expected no open_store and no radius_model")
            return cls._open_file(path, name, budget_bytes, policy, read_points)
        metrics = RequestStats()
        archive = PlacedArchive.open(
            path,
            name,
            budget_bytes=budget_bytes,
            policy=policy,
            open_store=open_store or VoxelStore,
            radius_model=radius_model,
            took=metrics.loaded,
        )
        return cls([archive], archive.name, metrics)

    @classmethod
    def _open_file(
        cls, path: Path, name: str | None, budget_bytes: int, policy: str, read_points: ReadPoints | None
    ) -> "Scene":
        """Open a scene file; see `open`. Errors name the file and the place in it."""
        if read_points is None:
            from .avatars.avatar_file import read_avatar  # needs the readers of all formats

            read_points = read_avatar
        file = read_scene(path)
        name = name or scene_name(file, path)
        found = find_archives(file, path)
        avatars = read_avatars(file, path, read_points)
        own = {each.info.name: (each.points, each.info.radius) for each in avatars}
        metrics = RequestStats()
        with ExitStack() as stack:
            archives = open_archives(file, path, name, found, budget_bytes, policy, metrics.loaded)
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

    def close(self) -> None:
        """Close the archives' files, once no part of a path is computed and no reload is in progress."""
        self._path_threads.close()
        with ExitStack() as stack:
            for archive in self.archives:
                stack.callback(archive.close)

    def reload(self) -> ReloadAnswer:
        """Serve what is in the archives' folders now, opened and warmed beside what is served, then swapped.

        Requests that began before are answered from the old generation, requests that begin after
        this returns from the new one; avatars stay. The old one is closed with its last reader:
        until then both keep voxels in memory, `budget_bytes` each. Several archives are reloaded one
        after the other. If one cannot be opened, the archives before it are new, and it and those
        after it are served unchanged.
        Raises FormatError, CorruptError or BadRequestError, saying why, when a new one cannot be
        opened, and BusyError when the generation before the old one is still being read.
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
        if self._simulation is not None:
            self._simulation.reloaded(after)
        return ReloadAnswer(
            self.name, before, after, sum(a.points for a in each), time.perf_counter() - begin
        )

    @property
    def _data(self) -> SceneData:
        """Return what a question without a radius model reads of the first archive."""
        with self.archives[0].take() as opened:
            return opened.data

    @property
    def residency(self) -> VoxelCache:
        """Return the resident voxels of the first archive, for counters and checks."""
        return self.archives[0].residency

    def warm(self) -> None:
        """Ask one of every question of each archive, so that no request waits for compilation; start the threads."""
        self._path_threads.start()
        for archive in self.archives:
            archive.warm()

    def info(self) -> SceneInfo:
        """Return what is served, all archives together, and which effects its frames simulate."""
        found = join_infos(self.name, [(archive.info(), archive.pose) for archive in self.archives])
        return describe_scene(found, self._file, self._own)

    def stats(self, keys: bool = False) -> StatsAnswer:
        """Return what is in memory, what was asked, and what had to be waited for. keys: list resident voxels too."""
        with ExitStack() as stack:
            each = [stack.enter_context(archive.take()) for archive in self.archives]
            return make_stats(self.name, each, self._metrics, self._avatars.stats(), keys=keys)

    def limit_avatars(self, limits: AvatarLimits) -> None:
        """Limit the memory of clients' avatars from now on; existing ones stay."""
        self._avatars.limits = limits

    def drop_unused_avatars(self, alive: Collection[str], seconds: float) -> None:
        """Forget avatars that were not used for so long [s].

        Those of clients in `alive`, and of clients whose users have bodies, stay.
        """
        if self._simulation is not None:
            alive = {*alive, *(user.client for user in self._simulation.users)}
        if self._avatars.drop_unused(alive, seconds):
            give_back_freed_memory()

    def add_avatar(
        self, name: str, points: ArrayLike, radius: float | None = None, *, client: str = ""
    ) -> AvatarInfo:
        """Add an avatar of points (n, 3) float64, avatar frame [m].

        radius: of each point's sphere [m]; None: half the mean closest-point distance of the points.
        client: whose it is; avatars of different clients do not meet. The same name again with the
        same points and radius changes nothing; with others it is a BadRequestError. TooLargeError:
        over the limits.
        """
        model = self._avatars.add(name, points, radius, client)
        return AvatarInfo(name, len(model.points), model.radius, model.bounding_radius)

    @property
    def simulation(self) -> Simulation:
        """Return what simulates the frames of this scene's users; made at its first use."""
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
        client: str = "",
        stop: StopFlag = NO_STOP,
    ) -> Moved:
        """Return where avatar `name` gets from one pose (1, 4, 4) towards another in a frame.

        Nothing is remembered. See `Simulation.move`.
        """
        return self.simulation.move(name, pose_from, pose_to, seconds, client=client, stop=stop)

    def session(self, avatar: str, *, client: str = "") -> LocalSession:
        """Return a session of an avatar, a client's or one of the scene's own, for a `with`.

        It sends motion commands and receives the resulting states; each command is a frame of its
        own. avatar: 1 to 64 of A-Z, a-z, 0-9, '.', '_' and '-'.
        """
        return LocalSession(self.simulation, User(client, check_name(avatar, "avatar of a session")))

    def drop_client(self, client: str) -> None:
        """Forget the bodies and avatars of a client that is gone."""
        if self._simulation is None:
            self.forget_client(client)
        else:
            self._simulation.drop_client(client)

    def forget_client(self, client: str) -> None:
        """Forget the avatars of a client, but not its bodies; for the simulation of this scene."""
        self._avatars.drop_client(client)
        for archive in self.archives:
            with suppress(BadRequestError):  # closed, it keeps nothing for anybody
                archive.leave_client(client)
        self._metrics.drop_client(client)
