"""One archive of a scene, at a pose in the world: the generation that answers now, and its hot reload.

An archive at the identity answers with the very poses of a request, so the archives of two halves
of a scan, on one lattice, answer as the archive of the whole. One at a pose is asked under
inverse(pose) @ pose of the avatar, in float64, rounded once: exact for a signed permutation and
shifts that float64 adds exactly, within some nanometres for others. Witnesses are carried back the
same way.
"""

import threading
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...schemas.errors import BadRequestError, BusyError
from ...schemas.wire.messages import ReloadAnswer, SceneInfo
from ..queries.raycast import make_directions
from ..residency.voxel_cache import Residency
from ..residency.voxel_store import OpenStore, Store
from .archive_generation import Opened
from .archive_info import describe
from .rigid_transform import archive_pose, inverse_of, moved, turned, under

_Floats = NDArray[np.float64]

# How long a reload waits for the last reader of the generation before the one that is current [s]:
# with a third one opened meanwhile, three budgets would be in memory.
RELOAD_WAIT = 10.0


class PlacedArchive:
    """An archive that a scene serves. Thread-safe.

    The content of the folder at opening answers, whatever becomes of the folder, until `reload`.
    pose, inverse: (4, 4), archive to world and back; None: at the identity.
    """

    def __init__(
        self,
        store: Store,
        name: str,
        budget_bytes: int,
        policy: str = "lru",
        open_store: OpenStore = Store,
        radius_model: str | None = None,
        pose: ArrayLike | None = None,
        took: Callable[[float], None] | None = None,
    ) -> None:
        """Serve the voxels of `store`; call `PlacedArchive.open` instead.

        name: of the scene, for messages.  took: called with the duration of each voxel load [s].
        Raises BadRequestError or BadTransformError for a pose that is not rigid.
        """
        self.name, self._folder, self._open_store = name, store.archive.folder, open_store
        self._budget_bytes, self._policy, self._radius_model = budget_bytes, policy, radius_model
        self._took = took
        self.pose = archive_pose(pose)
        self.inverse = None if self.pose is None else inverse_of(self.pose)
        self._opened = self._open(store, 0)
        self._before: Opened | None = None  # replaced; some requests may still read it
        self._info = describe(store, name)
        self._closed = False
        self._lock = threading.Lock()
        self._reloading = threading.Lock()

    @classmethod
    def open(
        cls,
        folder: str | Path,
        name: str | None = None,
        *,
        budget_bytes: int,
        policy: str = "lru",
        open_store: OpenStore = Store,
        radius_model: str | None = None,
        pose: ArrayLike | None = None,
        took: Callable[[float], None] | None = None,
    ) -> "PlacedArchive":
        """Open the archive in `folder`; see `Scene.open`."""
        store = open_store(folder)
        try:
            name = name or Path(folder).resolve().name
            return cls(store, name, budget_bytes, policy, open_store, radius_model, pose, took)
        except BaseException:
            store.close()
            raise

    def _open(self, store: Store, number: int) -> Opened:
        """Return a generation, opened as this archive is served."""
        return Opened(store, self._budget_bytes, self._policy, number, self._took, self._radius_model)

    def take(self) -> Opened:
        """Return the current generation for a `with`, which releases it. BadRequestError when closed."""
        while True:
            opened = self._opened
            if opened.take():
                return opened
            if opened is self._opened:  # not replaced, but closed
                return opened.taken()

    @property
    def residency(self) -> Residency:
        """Return the resident voxels, for counters and checks."""
        return self._opened.data.residency

    def info(self) -> SceneInfo:
        """Return the description of the archive alone, in its own frame."""
        return self._info

    def warm(self) -> None:
        """Ask one of every question, with a load, so that no request waits for compilation."""
        with self.take() as opened:
            opened.warm()

    def leave_client(self, client: str) -> None:
        """Hold no voxels for a client that is gone. BadRequestError when closed."""
        with self.take() as opened:
            opened.prefetcher.leave_client(client)

    def reload(self) -> ReloadAnswer:
        """Serve what is in the folder now; see `Scene.reload`."""
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
                    info = describe(store, self.name)
                    self._opened, self._before, self._info = new, old, info
            except BaseException:
                new.release()
                raise
            old.release()
        before, now = old.store.archive.header, store.archive.header
        return ReloadAnswer(
            self.name, before.generation, now.generation, now.points, time.perf_counter() - begin
        )

    def close(self) -> None:
        """Close the files once no reload is in progress. Closing twice is allowed."""
        with self._lock:
            closed, self._closed = self._closed, True
        if not closed:
            with self._reloading:
                self._opened.release()
                self._opened.join()

    def poses_in(self, poses: _Floats) -> _Floats:
        """Return poses (k, 4, 4) of the world in the archive's frame."""
        return poses if self.inverse is None else under(self.inverse, poses)

    def points_in(self, points: _Floats) -> _Floats:
        """Return points (k, 3) of the world in the archive's frame."""
        return points if self.inverse is None else moved(self.inverse, points)

    def directions_in(self, directions: _Floats) -> _Floats:
        """Return directions (k, 3) of the world, of any length, in the archive's frame."""
        return directions if self.inverse is None else turned(self.inverse, make_directions(directions))
