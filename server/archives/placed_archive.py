"""One archive of a scene, at a pose in the world, as it is served: its generations and its hot reload.

An archive at the identity is queried with the poses of a request unchanged. The archives of two
halves of a scan, on one lattice, therefore answer as the archive of the whole. An archive at a pose
is queried with inverse(archive pose) @ pose, in float64, rounded once. This is exact if the archive
pose is a signed permutation with a shift that float64 adds exactly, and within some nanometres
otherwise. Witnesses are transformed back in the same way.

A generation is the content of the archive's folder at one opening, with what is resident of it. It
counts its readers; the last one to leave closes its files and releases its memory. A reload opens the
next generation and swaps the two. Each request is answered from the generation that it began with.
"""

import threading
import time
from collections.abc import Callable
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...schemas.archive.units import UNITS_PER_METRE
from ...schemas.archive.voxel_grid import MAX_COORDINATE
from ...schemas.errors import BadRequestError, BusyError, FormatError
from ...schemas.wire.scene_messages import ReloadAnswer, SceneInfo
from ...schemas.wire.warming_parts import PARTS
from ..avatars.avatar_model import AvatarModel
from ..queries.engine_table import warm_engines
from ..queries.level_of_detail import open_level_data, with_level
from ..queries.query_inputs import SceneData, make_scene_data, make_tree, with_radius_model
from ..queries.rays_and_points import make_directions
from ..residency.level_store import fill_level, open_level_store
from ..residency.prefetch import Prefetcher, User, UserTracks
from ..residency.voxel_cache import EvictionPolicy, VoxelCache, prefetches
from ..residency.voxel_store import OpenStore, VoxelStore
from ..runtime.threads import start_thread
from .rigid_transform import archive_pose, inverse_pose, rotate_vectors, transform_points, transform_poses
from .scene_info import describe

_Floats = NDArray[np.float64]

# How long a reload waits for the last reader of the generation before the current one [s]. A third
# open generation would take a third budget of memory.
RELOAD_WAIT = 10.0
# A request of more poses does not update the user's position: its last pose may be anywhere.
_MAX_USER_POSES = 8
# Limit of margin or reach [m] (reach.py refuses other requests).
_MAX_AROUND = 16.0
_FLOAT64 = np.dtype(np.float64)  # comparing dtypes is faster than comparing with the type
_NUMBER = (float, int)  # `float | int` would be constructed for each request
# Voxels within this distance of a user are prefetched, however far its requests reach [m].
_USER_REACH = 1.0
# Number of radius models whose tables are cached. Clients may name any number of models.
_MAX_MODELS = 64


class ArchiveGeneration:
    """Store and resident voxels of an archive, open until its last reader leaves. Thread-safe.

    data: scene data that every query reads, with the scene's default radius model.
    radius_model: function that returns the scene data with the radius model of a name; None: the
    default. It raises BadRequestError for an invalid model, or one that the archive does not store.
    Only readers may use `data` and `radius_model`.
    level: store and cache of the level of detail; None if none is open. Only readers may use it.
    sources: number of the sources that the archive lists; those of the next archive follow.
    kept: data that other modules store with this generation, by module name.
    number: counts the generations of this archive, from 0.
    ended: event that is set when the last reader has left and everything is closed.
    """

    data: SceneData
    radius_model: Callable[[str | None], SceneData]

    def __init__(
        self,
        store: VoxelStore,
        budget_bytes: int,
        policy: str = "lru",
        number: int = 0,
        took: Callable[[float], None] | None = None,
        radius_model: str | None = None,
        level_bytes: int | None = None,
    ) -> None:
        """Open a generation whose first reader is the caller, which must `release` it.

        budget_bytes: limit of memory for voxels and level.  policy: see `EvictionPolicy`.
        level_bytes: of it for the level; None: see `open_level_store`.
        number: of this generation.  took: called with the duration of each load [s].
        radius_model: the default; None: the archive's single radius. Raise BadRequestError for one
        that the archive does not store, FormatError for a level of detail, whose points are not all.
        """
        archive = store.archive
        if archive.header.is_level:
            raise FormatError(
                f"{archive.folder}: a level of detail, expected an archive: give the folder of its archive, or "
                "restore it"
            )
        self.store, self.number = store, number
        self.sources = archive.header.listed_sources
        self.kept: dict[str, Any] = {}
        self.ended = threading.Event()
        self._lock = threading.Lock()
        self._readers = 1
        self._ending: threading.Thread | None = None
        self.level = level = open_level_store(store, budget_bytes, level_bytes)
        try:
            budget_bytes -= level.residency.budget_bytes if level else 0
            residency = VoxelCache(
                store,
                budget_bytes,
                EvictionPolicy(budget_bytes, policy),
                # What was given to the level may leave too little for a voxel.
                refuse_large=level is None or level_bytes is None,
            )
            residency.on_load_time = took
            ahead, lattice, tree = prefetches(policy), archive.header.lattice, make_tree(archive)
            self.prefetcher = Prefetcher(
                residency,
                UserTracks(tree, lattice.origin, lattice.step),
                prefetch=ahead,
                idle=fill_level(level) if level and level.fits else None,
                level=level and level.residency,
            )
            single = make_scene_data(archive, residency, tree)
            of_level = level and open_level_data(
                level.store.archive, level.residency, archive, settles_exact=ahead or level_bytes is not None
            )

            @lru_cache(_MAX_MODELS)
            def with_model(text: str | None) -> SceneData:
                chosen = radius_model if text is None else text
                return with_level(with_radius_model(single, archive, chosen), of_level)

            self.radius_model, self.data = with_model, with_model(None)
        except BaseException:
            self._close_level()
            raise

    def take(self) -> bool:
        """Add a reader, which must `release`. Return False if the last reader has already left."""
        with self._lock:
            if self._readers:
                self._readers += 1
                return True
        return False

    def release(self) -> None:
        """Remove a reader. The last one closes the files and frees the memory."""
        with self._lock:
            self._readers -= 1
            if self._readers:
                return
        if self.prefetcher.running:
            # `_end` waits for the prefetcher's thread. The calling thread may be in garbage
            # collection with any lock held, so another thread waits.
            self._ending = start_thread("end", self._end)
        else:
            self._end()

    def join(self) -> None:
        """Wait until everything is closed, if the last reader has left.

        Do not call it during garbage collection, which may hold a lock that closing needs.
        """
        if self._ending is not None:
            self._ending.join()

    def _end(self) -> None:
        """Stop prefetching, drop the memory and close the files."""
        self.prefetcher.stop()
        del self.data, self.radius_model, self.prefetcher, self.kept
        self._close_level()
        self.level = None  # a reload keeps this generation until the next
        self.store.close()
        self.ended.set()

    def _close_level(self) -> None:
        if self.level is not None:
            self.level.store.close()

    def __enter__(self) -> Self:
        """Return this generation; the caller is already a reader."""
        return self

    def __exit__(self, *_: object) -> None:
        """Release this generation."""
        self.release()

    def taken(self) -> Self:
        """Add a reader and return this generation. Raise BadRequestError if it has ended."""
        if not self.take():
            raise BadRequestError(f"{self.store.archive.folder}: this scene is closed: open it again")
        return self

    def record_user(self, user: User, avatar: AvatarModel, poses: Any, around: float) -> bool:
        """Record the position of a user: the last of at most _MAX_USER_POSES poses of its avatar.

        poses: (k, 4, 4) or (4, 4), avatar to archive, not checked yet.
        around: margin or reach, in addition to the radii of avatar and scan [m].
        Return whether the voxels in reach are used in passing (`QueryBudget.scan`), because there
        are more poses or the user teleported.
        """
        # A request with other arguments will be refused, or has no voxels to prefetch.
        if not isinstance(poses, np.ndarray) or poses.dtype != _FLOAT64:
            return False
        if poses.shape[1:] != (4, 4):
            if poses.shape != (4, 4):
                return False
            poses = poses[None]
        if not len(poses) or not len(avatar.points):
            return False
        if not isinstance(around, _NUMBER) or not 0 <= around <= _MAX_AROUND:
            return False
        if len(poses) > _MAX_USER_POSES:
            return True
        (a, b, c, tx), (d, e, f, ty), (g, h, i, tz), _ = poses[-1].tolist()
        x, y, z = avatar.arrays.center[0].tolist()
        x, y, z = a * x + b * y + c * z + tx, d * x + e * y + f * z + ty, g * x + h * y + i * z + tz
        limit = MAX_COORDINATE
        if not (abs(x) <= limit and abs(y) <= limit and abs(z) <= limit):
            return False
        near = around if around < _USER_REACH else _USER_REACH
        reach = avatar.bounding_radius + self.data.radius_units / UNITS_PER_METRE + near
        return self.prefetcher.record_pose(user, (x, y, z), reach)

    def warm(self, *parts: str) -> None:
        """Run the queries of these parts once, with a load; see `Scene.warm`."""
        archive = self.store.archive
        row = int(np.argmin(self.store.sizes))
        corner = archive.coordinates[row] * archive.header.lattice.voxel_steps + archive.voxels["low"][row]
        place = archive.header.lattice.to_world(corner).tolist()
        if self.level is not None:  # the kernels that lay a voxel of it out
            with self.level.residency.hold([int(np.argmin(self.level.store.sizes))]):
                pass
        for part in parts or PARTS:
            warm_engines(self.data, place, part)

    def load_voxels_of(self, other: "ArchiveGeneration", stopped: Callable[[], bool]) -> None:
        """Load the voxels that are resident in `other`, until `stopped` returns True.

        If not all fit, load those that were used last. After a reload, requests at the users'
        positions then do not wait for the disk.
        """
        residency, keys = self.data.residency, self.store.archive.voxels["key"]
        wanted = other.store.archive.voxels["key"][other.data.residency.recent()]
        at = np.minimum(np.searchsorted(keys, wanted), len(keys) - 1)
        rows, room = [], residency.buffer.total_bytes
        for row in at[keys[at] == wanted][::-1].tolist():
            room -= residency.bytes_of([row])
            if room < 0:
                break
            rows.append(row)
        for row in reversed(rows):
            if stopped():
                return
            with residency.hold([row]):
                pass


class PlacedArchive:
    """Archive that a scene serves. Thread-safe.

    Until `reload`, answers are those of the folder's content at opening, whatever happens to it.
    pose, inverse: (4, 4) float64, archive to world and back; None: the identity.
    """

    def __init__(
        self,
        folder: str | Path,
        name: str | None = None,
        *,
        budget_bytes: int,
        policy: str = "lru",
        open_store: OpenStore = VoxelStore,
        store: VoxelStore | None = None,
        radius_model: str | None = None,
        pose: ArrayLike | None = None,
        took: Callable[[float], None] | None = None,
        level_bytes: int | None = None,
    ) -> None:
        """Open the archive in `folder`; see `Scene.open`.

        name: of the scene, for messages; None: that of the folder.
        open_store: opens the folder, now and at each reload.  store: the folder, opened by it; None: open it
        now. This closes it.
        pose: (4, 4), archive to world; None: the identity.
        took: called with the duration of each voxel load [s].
        level_bytes: see `ArchiveGeneration`.
        Raise BadRequestError or BadTransformError for a pose that is not rigid.
        """
        self.name = name or Path(folder).resolve().name
        self.pose = archive_pose(pose)
        self.inverse = None if self.pose is None else inverse_pose(self.pose)
        self._folder, self._open_store = Path(folder), open_store
        self._make_generation = partial(
            ArchiveGeneration,
            budget_bytes=budget_bytes,
            policy=policy,
            took=took,
            radius_model=radius_model,
            level_bytes=level_bytes,
        )
        self._opened = self._open(0, store)
        # Generation replaced by the last reload; some requests may still read it.
        self._before: ArchiveGeneration | None = None
        self._info = describe(self._opened.store, self.name)
        self._closed = False
        self._lock = threading.Lock()
        self._reloading = threading.Lock()

    def _open(self, number: int, store: VoxelStore | None = None) -> ArchiveGeneration:
        """Open the folder as it is now, unless it is open."""
        store = store or self._open_store(self._folder)
        try:
            return self._make_generation(store, number=number)
        except BaseException:
            store.close()
            raise

    def take(self) -> ArchiveGeneration:
        """Return the current generation with one more reader, for a `with`.

        Raise BadRequestError if the archive is closed.
        """
        while True:
            opened = self._opened
            if opened.take():
                return opened
            if opened is self._opened:  # not replaced, but closed
                return opened.taken()

    @property
    def residency(self) -> VoxelCache:
        """Return the cache of the current generation, for counters and checks."""
        return self._opened.data.residency

    def info(self) -> SceneInfo:
        """Return the description of the archive, in its own frame."""
        return self._info

    def warm(self, *parts: str) -> None:
        """Run the queries of these parts once, with a load; see `Scene.warm`."""
        with self.take() as opened:
            opened.warm(*parts)

    def leave_client(self, client: str) -> None:
        """Stop keeping voxels for a disconnected client. Raise BadRequestError if closed."""
        with self.take() as opened:
            opened.prefetcher.leave_client(client)

    def reload(self) -> ReloadAnswer:
        """Serve the current content of the folder; see `Scene.reload`."""
        begin = time.perf_counter()
        with self._reloading, self.take() as old:
            if self._before is not None and not self._before.ended.wait(RELOAD_WAIT):
                raise BusyError(
                    f"{self.name}: the previous generation is still in use, perhaps by a path: reload later"
                )
            new = self._open(old.number + 1)
            try:
                new.warm()
                new.load_voxels_of(old, lambda: self._closed)
                with self._lock:
                    if self._closed:
                        raise BadRequestError(f"{self.name}: closed while it was reloaded: open it again")
                    info = describe(new.store, self.name)
                    self._opened, self._before, self._info = new, old, info
            except BaseException:
                new.release()
                raise
            old.release()
        before, now = old.store.archive.header, new.store.archive.header
        return ReloadAnswer(
            self.name, before.generation, now.generation, now.points, time.perf_counter() - begin
        )

    def close(self) -> None:
        """Wait for a reload in progress, then close the files. Closing twice is allowed."""
        with self._lock:
            closed, self._closed = self._closed, True
        if not closed:
            with self._reloading:
                self._opened.release()
                self._opened.join()

    def poses_in(self, poses: _Floats) -> _Floats:
        """Transform poses (k, 4, 4) from the world to the archive's frame."""
        return poses if self.inverse is None else transform_poses(self.inverse, poses)

    def points_in(self, points: _Floats) -> _Floats:
        """Transform points (k, 3) from the world to the archive's frame [m]."""
        return points if self.inverse is None else transform_points(self.inverse, points)

    def directions_in(self, vectors: _Floats) -> _Floats:
        """Transform directions (k, 3) from the world to the archive's frame.

        At the identity their length is unchanged; otherwise it is 1. Raise BadRequestError for a
        zero vector.
        """
        return vectors if self.inverse is None else rotate_vectors(self.inverse, make_directions(vectors))
