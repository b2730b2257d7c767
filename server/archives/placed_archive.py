"""One archive of a scene at a pose in the world: its current generation and its hot reload.

An archive at the identity is queried with the poses of a request unchanged. The archives of two
halves of a scan, on one lattice, therefore answer as the archive of the whole. An archive at a pose
is queried with inverse(archive pose) @ pose, in float64, rounded once. This is exact if the archive
pose is a signed permutation with a shift that float64 adds exactly, and within some nanometres
otherwise. Witnesses are transformed back in the same way.

A reload opens the next generation (archive_generation.py) and swaps the two. Each request is
answered from the generation that it began with.
"""

import threading
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...schemas.errors import BadRequestError, BusyError
from ...schemas.wire.scene_messages import ReloadAnswer, SceneInfo
from ..queries.rays_and_points import make_directions
from ..residency.voxel_cache import VoxelCache
from ..residency.voxel_store import OpenStore, VoxelStore
from .archive_generation import ArchiveGeneration
from .rigid_transform import archive_pose, inverse_pose, rotate_vectors, transform_points, transform_poses
from .scene_info import describe

_Floats = NDArray[np.float64]

# How long a reload waits for the last reader of the generation before the current one [s]. A third
# open generation would take a third budget of memory.
RELOAD_WAIT = 10.0


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
