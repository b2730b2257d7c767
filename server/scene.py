"""Scene: an archive opened in this process, and the questions asked of it. The same methods as `Client`."""

import os
import threading
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, Unpack

import numpy as np
from numpy.typing import ArrayLike

from ..schemas.answers import (
    CollideAnswers,
    ContactsAnswers,
    DistanceAnswers,
    ObjectsAnswers,
    Part,
    RaycastAnswers,
    SweepAnswers,
    WithinAnswers,
)
from ..schemas.errors import BadRequestError, UnknownAvatarError
from ..schemas.messages import WIRE_VERSION, AvatarInfo, SceneInfo, SourceInfo
from ..schemas.requests import QuestionOptions, make_objects, make_poses
from .avatar import AvatarModel, make_avatar
from .collide import collide
from .contacts import contacts
from .distance import distance
from .effort import EXACT, Effort, make_effort
from .objects import objects as ask_objects
from .path import PATH_THREADS, largest_part, path_parts, path_question
from .rays import raycast
from .request import SceneData, make_scene_data, with_radius_model
from .residency import Residency
from .session import Walker
from .store import Store
from .sweep import sweep
from .within import within

DEFAULT_BUDGET = 512 << 20
# Radius models whose tables are remembered; asked for by name, and by clients, so there may be any number.
MOST_MODELS = 64


class Scene:
    """A served archive. Thread-safe; a context manager.

    name: what clients call it; the archive's folder name unless given.
    """

    def __init__(self, store: Store, name: str, budget_bytes: int) -> None:
        """Serve the voxels of `store`; use `Scene.open`."""
        self.name = name
        self._store = store
        self._data = make_scene_data(store.archive, Residency(store, budget_bytes))
        self._radius_model = lru_cache(MOST_MODELS)(partial(with_radius_model, self._data, store.archive))
        self._avatars: dict[tuple[str, str], AvatarModel] = {}
        self._pool: ThreadPoolExecutor | None = None
        self._lock = threading.Lock()

    @classmethod
    def open(
        cls, folder: str | Path, name: str | None = None, *, budget_bytes: int = DEFAULT_BUDGET
    ) -> "Scene":
        """Open the archive in `folder`, keeping at most budget_bytes of decoded voxels in memory.

        Raises FormatError or CorruptError when it is no whole archive, BadRequestError for too small a budget.
        """
        store = Store(folder)
        try:
            return cls(store, name or Path(folder).resolve().name, budget_bytes)
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
        """Close the archive's files, once no part of a path is being computed."""
        with self._lock:
            pool, self._pool = self._pool, None
        if pool is not None:
            pool.shutdown(cancel_futures=True)
        self._store.close()

    def _pool_of_threads(self) -> ThreadPoolExecutor:
        """The threads that compute parts of paths, one a core; started when first needed, shared by all paths."""
        with self._lock:
            if self._pool is None:
                workers = max(PATH_THREADS, os.cpu_count() or 1)
                self._pool = ThreadPoolExecutor(workers, thread_name_prefix=f"solidcloud-{self.name}-path")
            return self._pool

    def _avatar(self, name: str, client: str) -> AvatarModel:
        """A client's avatar; UnknownAvatarError."""
        with self._lock:
            avatar = self._avatars.get((client, name))
        if avatar is None:
            raise UnknownAvatarError(f"avatar {name!r} is not known: add it with add_avatar first")
        return avatar

    @property
    def residency(self) -> Residency:
        """The resident voxels, for counters and checks."""
        return self._data.residency

    def warm(self) -> None:
        """Ask one of everything, a load included, so that nobody waits for compilers after."""
        archive = self._store.archive
        row = int(np.argmin(self._store.sizes))
        corner = archive.coordinates[row] * archive.header.lattice.voxel_steps + archive.voxels["low"][row]
        pose = np.eye(4)[None]
        pose[0, :3, 3] = archive.header.lattice.to_world(corner)
        place = pose[:, :3, 3].copy()
        avatar = make_avatar([[0.0, 0, 0], [0.1, 0, 0]])
        both = np.full(2, 0xFFFFFFFF, np.uint32)
        # Budgets that are hardly ever spent: what is bounded has kernels of its own, and so have deadlines.
        later = time.perf_counter() + 3600.0
        for poses in (pose, np.concatenate([pose, pose])):
            Walker(self._data, avatar).collide(poses)
        for effort in (EXACT, Effort(tolerance=1e-3, visits=1 << 20), Effort(deadline=later)):
            for poses in (pose, np.concatenate([pose, pose])):
                collide(self._data, avatar, poses, 0.0, effort)
            distance(self._data, avatar, pose, 0.01, effort)
            contacts(self._data, avatar, pose, effort=effort)
            sweep(self._data, avatar, pose, pose, effort=effort)
            raycast(self._data, place, np.array([[0.0, 0.0, 1.0]]), 0.01, effort)
            within(self._data, place, 0.01, effort)
            ask_objects(self._data, [avatar, avatar], np.concatenate([pose, pose]), both, both, effort=effort)

    def info(self) -> SceneInfo:
        """What is served: counts, bounds, lattice, radius, sources."""
        return describe(self._store, self.name)

    def add_avatar(
        self, name: str, points: ArrayLike, radius: float | None = None, *, client: str = ""
    ) -> AvatarInfo:
        """Add an avatar of points (n, 3) float64, avatar frame [m].

        radius: of each point's sphere [m]; None: half the mean closest-point distance of the points.
        client: whose it is; avatars of different clients do not meet. The same name again with the same points and
        radius changes nothing; with others it is a BadRequestError.
        """
        model = make_avatar(points, radius)
        with self._lock:
            known = self._avatars.setdefault((client, name), model)
        if known is not model and not (
            known.radius == model.radius and np.array_equal(known.points, model.points)
        ):
            raise BadRequestError(
                f"avatar {name!r} exists with other points or another radius: use another name"
            )
        return AvatarInfo(name, len(model.points), model.radius, model.bounding_radius)

    def _terms(
        self,
        tolerance: float = 0.0,
        budget_ms: float | None = None,
        budget_visits: int | None = None,
        radius_model: str | None = None,
    ) -> tuple[SceneData, Effort]:
        """What a question with these options reads, and what it may cost."""
        effort = make_effort(tolerance, budget_ms, budget_visits)
        return self._data if radius_model is None else self._radius_model(radius_model), effort

    def collide(
        self,
        name: str,
        poses: ArrayLike,
        margin: float = 0.0,
        *,
        client: str = "",
        **options: Unpack[QuestionOptions],
    ) -> CollideAnswers:
        """Whether avatar `name` touches the scene under each of the poses (k, 4, 4); see server/collide.py.

        options, here and below: tolerance [m], budget_ms, budget_visits: what the answer may cost, see
        server/effort.py; radius_model: how large the scan's spheres are, see schemas/radius_model.py, None: the
        archive's one figure.
        """
        data, effort = self._terms(**options)
        return collide(data, self._avatar(name, client), poses, margin, effort)

    def walker(
        self, name: str, margin: float = 0.0, *, radius_model: str | None = None, client: str = ""
    ) -> Walker:
        """A session of avatar `name`: its `collide` remembers the last pose; see server/session.py."""
        return Walker(self._radius_model(radius_model), self._avatar(name, client), margin)

    def distance(
        self,
        name: str,
        poses: ArrayLike,
        reach: float,
        *,
        client: str = "",
        **options: Unpack[QuestionOptions],
    ) -> DistanceAnswers:
        """How far avatar `name` is from the scene under each pose, up to `reach` [m]; see server/distance.py."""
        data, effort = self._terms(**options)
        return distance(data, self._avatar(name, client), poses, reach, effort)

    def contacts(
        self,
        name: str,
        poses: ArrayLike,
        limit: int = 100,
        margin: float = 0.0,
        cluster_distance: float | None = None,
        *,
        client: str = "",
        **options: Unpack[QuestionOptions],
    ) -> ContactsAnswers:
        """Which pairs of points are in contact under each of the poses, deepest first; see server/contacts.py."""
        data, effort = self._terms(**options)
        avatar = self._avatar(name, client)
        return contacts(data, avatar, poses, limit, margin, cluster_distance, effort)

    def sweep(
        self,
        name: str,
        pose_from: ArrayLike,
        pose_to: ArrayLike,
        margin: float = 0.0,
        *,
        client: str = "",
        **options: Unpack[QuestionOptions],
    ) -> SweepAnswers:
        """When avatar `name` first touches the scene on its way between poses; see server/sweep.py."""
        options.setdefault("tolerance", 1e-6)
        data, effort = self._terms(**options)
        avatar = self._avatar(name, client)
        return sweep(data, avatar, pose_from, pose_to, margin, effort.tolerance, effort)

    def raycast(
        self,
        origins: ArrayLike,
        directions: ArrayLike,
        reach: float,
        **options: Unpack[QuestionOptions],
    ) -> RaycastAnswers:
        """Which scan point's sphere rays (k, 3), (k, 3) hit first, up to `reach` [m]; see server/rays.py."""
        data, effort = self._terms(**options)
        return raycast(data, origins, directions, reach, effort)

    def within(
        self,
        points: ArrayLike,
        reach: float,
        **options: Unpack[QuestionOptions],
    ) -> WithinAnswers:
        """Which scan point is nearest to each loose point (k, 3), up to `reach` [m]; see server/within.py."""
        data, effort = self._terms(**options)
        return within(data, points, reach, effort)

    def objects(
        self,
        objects: Sequence[Sequence[Any]],
        margin: float = 0.0,
        *,
        client: str = "",
        **options: Unpack[QuestionOptions],
    ) -> ObjectsAnswers:
        """Which of several avatars (name, pose, group = 1, mask = all) touch the scene and one another.

        See server/objects.py.
        """
        data, effort = self._terms(**options)
        items, poses = make_objects(objects)
        avatars = [self._avatar(item.avatar, client) for item in items]
        groups = np.array([item.group for item in items], np.uint32)
        masks = np.array([item.mask for item in items], np.uint32)
        return ask_objects(data, avatars, poses, groups, masks, margin, effort)

    def path(
        self,
        name: str,
        poses: ArrayLike,
        op: str = "collide",
        *,
        threads: int = PATH_THREADS,
        radius_model: str | None = None,
        client: str = "",
        **parameters: Any,
    ) -> Iterator[Part]:
        """Ask `op` (collide, distance, contacts, sweep) along the poses; the answers come part by part, in order.

        parameters: what `op` takes beside the poses, tolerance and budgets included; `budget_ms` is for the whole path.
        threads: parts computed at a time.  sweep: k - 1 motions, from each pose to the next. Every part is the answer
        of its question for [first, first + n) of `total`. All poses are checked before the first part.
        """
        data, avatar = self._radius_model(radius_model), self._avatar(name, client)
        ask, total = path_question(data, avatar, make_poses(poses), op, parameters)
        most = largest_part(op, parameters)
        if threads <= 1:
            return path_parts(ask, total, most)
        return path_parts(ask, total, most, self._pool_of_threads(), 2 * threads)

    def drop_client(self, client: str) -> None:
        """Forget the avatars of a client that is gone."""
        with self._lock:
            for key in [key for key in self._avatars if key[0] == client]:
                del self._avatars[key]


def describe(store: Store, name: str) -> SceneInfo:
    """What the archive of `store` holds: counts, bounds, lattice, radius, sources. Reads no voxel."""
    header = store.archive.header
    lattice = header.lattice
    return SceneInfo(
        scene=name,
        format_version=header.format_version,
        wire_version=WIRE_VERSION,
        points=header.points,
        voxels=len(store.sizes),
        bounds=lattice.to_world(np.stack([header.low, header.high])).tolist(),
        origin=list(lattice.origin),
        lattice_step=lattice.step,
        lattice_source=header.lattice_source,
        voxel_size=lattice.voxel_size,
        radius=header.radius,
        radius_model=header.radius_model,
        radius_models=list(header.models),
        radius_error=header.radius_error,
        radius_sample=header.radius_sample,
        moved_max=header.moved_max,
        degree=header.degree,
        leaf=header.leaf,
        sources=[
            SourceInfo(s.path, s.index, s.sha256, s.count, s.format, s.pose.tolist(), s.skipped)
            for s in header.sources
            if not s.fault
        ],
        skipped=[s.fault for s in header.sources if s.fault],
        record_bytes=int(store.archive.voxels["frame_bytes"].sum(dtype=np.int64)),
        resident_bytes=int(store.sizes.sum()),
        unknown=[lattice.to_world(box).tolist() for box in header.unknown],
        unknown_everywhere=header.unknown_everywhere,
    )
