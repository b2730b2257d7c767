"""One generation of an archive, opened: what questions read of it, and how many still do.

A scene swaps one for another while it is asked (`Scene.reload`). Who reads takes the one that is current and lets it go
when the answer is there; files and memory of one that was swapped out go with its last reader.
"""

import threading
import time
from collections.abc import Callable, Generator, Iterator
from functools import lru_cache, partial
from typing import Self

import numpy as np

from ..schemas.answers import Part
from ..schemas.errors import BadRequestError
from .avatar import make_avatar
from .collide import collide
from .contacts import contacts
from .distance import distance
from .effort import EXACT, Effort
from .objects import objects as ask_objects
from .rays import raycast
from .request import SceneData, make_scene_data, with_radius_model
from .residency import Residency
from .session import Walker
from .store import Store
from .sweep import sweep
from .within import within

# Radius models whose tables are remembered; asked for by name, and by clients, so there may be any number.
MOST_MODELS = 64


class Opened:
    """An archive's store and resident voxels, held open by who reads them. Thread-safe.

    data: what every question reads, spheres of the archive's one figure.  radius_model: the same under a radius model,
    by its name; BadRequestError for one that is none, or not stored. Both are there for who has taken it.
    number: tells those of one scene apart.  ended: set once the last reader is gone and all is closed.
    """

    data: SceneData
    radius_model: Callable[[str | None], SceneData]

    def __init__(self, store: Store, budget_bytes: int, number: int = 0) -> None:
        """Hold `store` open for a first reader, the scene, which must `release` it."""
        self.store, self.number = store, number
        self.ended = threading.Event()
        self.data = make_scene_data(store.archive, Residency(store, budget_bytes))
        self.radius_model = lru_cache(MOST_MODELS)(partial(with_radius_model, self.data, store.archive))
        self._lock = threading.Lock()
        self._readers = 1

    def take(self) -> bool:
        """Read it too, until `release`; False where the last reader is gone already."""
        with self._lock:
            if self._readers:
                self._readers += 1
                return True
        return False

    def release(self) -> None:
        """Read it no more. The last reader closes its files and gives its memory back."""
        with self._lock:
            self._readers -= 1
            if self._readers:
                return
        del self.data, self.radius_model
        self.store.close()
        self.ended.set()

    def __enter__(self) -> Self:
        """What was taken."""
        return self

    def __exit__(self, *_: object) -> None:
        """Let it go."""
        self.release()

    def taken(self) -> Self:
        """Itself, taken once more. BadRequestError where the last reader is gone already."""
        if not self.take():
            raise BadRequestError(f"{self.store.archive.folder}: this scene is closed: open it again")
        return self

    def warm(self) -> None:
        """Ask one of everything, a load included, so that nobody waits for compilers after."""
        data, archive = self.data, self.store.archive
        row = int(np.argmin(self.store.sizes))
        corner = archive.coordinates[row] * archive.header.lattice.voxel_steps + archive.voxels["low"][row]
        pose = np.eye(4)[None]
        pose[0, :3, 3] = archive.header.lattice.to_world(corner)
        place = pose[:, :3, 3].copy()
        avatar = make_avatar([[0.0, 0, 0], [0.1, 0, 0]])
        both = np.full(2, 0xFFFFFFFF, np.uint32)
        # Budgets that are hardly ever spent: what is bounded has kernels of its own, and so have deadlines.
        later = time.perf_counter() + 3600.0
        for poses in (pose, np.concatenate([pose, pose])):
            Walker(self.taken, avatar).collide(poses)
        for effort in (EXACT, Effort(tolerance=1e-3, visits=1 << 20), Effort(deadline=later)):
            for poses in (pose, np.concatenate([pose, pose])):
                collide(data, avatar, poses, 0.0, effort)
            distance(data, avatar, pose, 0.01, effort)
            contacts(data, avatar, pose, effort=effort)
            sweep(data, avatar, pose, pose, effort=effort)
            raycast(data, place, np.array([[0.0, 0.0, 1.0]]), 0.01, effort)
            within(data, place, 0.01, effort)
            ask_objects(data, [avatar, avatar], np.concatenate([pose, pose]), both, both, effort=effort)

    def follow(self, other: "Opened", stopped: Callable[[], bool]) -> None:
        """Load the voxels that `other` has in memory, as many of those used last as fit; until `stopped`.

        So that who asks where it asked before does not wait for a disk because of a reload.
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


class HeldParts(Iterator[Part]):
    """The parts of a path, holding the generation they are of until the last was taken or nobody wants more."""

    def __init__(self, parts: Generator[Part, None, None], opened: Opened) -> None:
        self._parts = parts
        self._opened: Opened | None = opened

    def __next__(self) -> Part:
        try:
            return next(self._parts)
        except BaseException:  # the end, too
            self.close()
            raise

    def close(self) -> None:
        """Take no more."""
        opened, self._opened = self._opened, None
        if opened is not None:
            self._parts.close()
            opened.release()

    def __del__(self) -> None:
        self.close()
