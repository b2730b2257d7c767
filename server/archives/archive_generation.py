"""Generation of an archive: the content of its folder at one opening, with what is resident of it.

A generation counts its readers; the last one to leave closes its files and releases its memory.
"""

import threading
from collections.abc import Callable
from functools import lru_cache
from typing import Any, Self

import numpy as np

from ...schemas.archive.units import UNITS_PER_METRE
from ...schemas.archive.voxel_grid import MAX_COORDINATE
from ...schemas.errors import BadRequestError, FormatError
from ...schemas.wire.warming_parts import PARTS
from ..avatars.avatar_model import AvatarModel
from ..queries.engine_table import warm_engines
from ..queries.level_of_detail import open_level_data, with_level
from ..queries.query_inputs import SceneData, make_scene_data, make_tree, with_radius_model
from ..residency.eviction import EvictionPolicy, prefetches
from ..residency.level_store import level_filler, open_level_store
from ..residency.motion_prediction import User, UserTracks
from ..residency.prefetch import Prefetcher
from ..residency.voxel_cache import VoxelCache
from ..residency.voxel_store import VoxelStore
from ..runtime.threads import start_thread

# A request of more poses does not update the user's position: its last pose may be anywhere.
_MAX_USER_POSES = 8
# Limit of margin or reach [m] (voxels_in_reach.py refuses other requests).
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

        budget_bytes: limit of memory for voxels and level.  policy: see eviction.py.
        level_bytes: of it for the level; None: see `open_level_store`.
        number: of this generation.  took: called with the duration of each load [s].
        radius_model: the default; None: the archive's single radius. Raise BadRequestError for one
        that the archive does not store, FormatError for a level of detail, whose points are not all.
        """
        if store.archive.header.is_level:
            raise FormatError(
                f"{store.archive.folder}: a level of detail, expected an archive: give the folder of its archive, or "
                "restore it"
            )
        self.store, self.number = store, number
        self.sources = store.archive.header.listed_sources
        self.kept: dict[str, Any] = {}
        self.ended = threading.Event()
        self._lock = threading.Lock()
        self._readers = 1
        self._ending: threading.Thread | None = None
        self.level = open_level_store(store, budget_bytes, level_bytes)
        try:
            self._assemble(budget_bytes, policy, took, radius_model, level_given=level_bytes is not None)
        except BaseException:
            self._close_level()
            raise

    def _assemble(
        self,
        budget_bytes: int,
        policy: str,
        took: Callable[[float], None] | None,
        radius_model: str | None,
        *,
        level_given: bool,
    ) -> None:
        """Make caches, prefetcher and scene data. level_given: whether memory was given to the level.

        The other parameters are as in `__init__`.
        """
        archive, level = self.store.archive, self.level
        budget_bytes -= level.residency.budget_bytes if level else 0
        residency = VoxelCache(
            self.store,
            budget_bytes,
            EvictionPolicy(budget_bytes, policy),
            # What was given to the level may leave too little for a voxel.
            refuse_large=level is None or not level_given,
        )
        residency.on_load_time = took
        ahead, lattice, tree = prefetches(policy), archive.header.lattice, make_tree(archive)
        self.prefetcher = Prefetcher(
            residency,
            UserTracks(tree, lattice.origin, lattice.step),
            prefetch=ahead,
            idle=level_filler(level),
            level=level and level.residency,
        )
        single = make_scene_data(archive, residency, tree)
        of_level = level and open_level_data(
            level.store.archive, level.residency, archive, settles_exact=ahead or level_given
        )

        @lru_cache(_MAX_MODELS)
        def with_model(text: str | None) -> SceneData:
            chosen = radius_model if text is None else text
            return with_level(with_radius_model(single, archive, chosen), of_level)

        self.radius_model, self.data = with_model, with_model(None)

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
