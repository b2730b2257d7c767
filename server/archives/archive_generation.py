"""One generation of an archive, opened: what questions read of it, and how many still do.

A scene swaps one for another while it is asked (`Scene.reload`). Who reads takes the one that is current and lets it go
when the answer is there; files and memory of one that was swapped out go with its last reader.
"""

import math
import threading
import time
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import suppress
from functools import lru_cache
from typing import Any, Self

import numpy as np

from ...schemas.archive.units import UNITS_PER_METRE
from ...schemas.archive.voxel_grid import MAX_COORDINATE
from ...schemas.errors import BadRequestError, CorruptError
from ...schemas.wire.answers import Part
from ...schemas.wire.questions import QUESTIONS
from ..avatars.avatar_model import AvatarModel, make_avatar
from ..queries.collide import collide
from ..queries.context.query_budget import EXACT, QueryBudget
from ..queries.context.query_context import SceneData, check_request, make_scene_data, with_radius_model
from ..queries.engines import ENGINES
from ..queries.objects import objects as ask_objects
from ..residency.arena import ArenaBuffer
from ..residency.coarse_bounds import Coarse, settle
from ..residency.eviction import make_policy, prefetches
from ..residency.index_proof import Bounds
from ..residency.motion_prediction import Neighbourhood, User
from ..residency.prefetch import Prefetcher
from ..residency.voxel_cache import Residency
from ..residency.voxel_store import Store
from ..runtime.threads import start_thread

# A user is where the last of so many poses is; more are looked over, not walked.
MOST_SEEN = 8
# Margins and reaches that are asked for [m], and scales of avatars; others will be refused
# (kernels/core/pose_transform.py).
MOST_AROUND, LEAST_SCALE = 16.0, 1e-3
NUMBER = (float, int)  # `float | int` would be made anew for each request
# A user is taken to need what is so near to it, however far it asks [m].
NEAR = 1.0
# Of the budget, what coarse tops may take: 6 KB each.
COARSE_SHARE = 1 / 16
# Radius models whose tables are remembered; asked for by name, and by clients, so there may be any number.
MOST_MODELS = 64


class Opened:
    """An archive's store and resident voxels, held open by who reads them. Thread-safe.

    data: what every question reads, spheres as a scene has them by default.  radius_model: the same under a radius
    model, by its name, None: as by default; BadRequestError for one that is none, or not stored. Both are there for who
    has taken it.
    kept: what others keep of this generation, by their names; it goes with it.
    number: tells those of one scene apart.  ended: set once the last reader is gone and all is closed.
    """

    data: SceneData
    radius_model: Callable[[str | None], SceneData]

    def __init__(
        self,
        store: Store,
        budget_bytes: int,
        policy: str = "lru",
        number: int = 0,
        took: Callable[[float], None] | None = None,
        radius_model: str | None = None,
    ) -> None:
        """Hold `store` open for a first reader, the scene, which must `release` it.

        policy: see eviction.py.  took: told the seconds that each load took.  radius_model: by default; None: the
        archive's one figure. BadRequestError for one that the archive does not hold.
        """
        self.store, self.number = store, number
        self.kept: dict[str, Any] = {}
        self.ended = threading.Event()
        bounds, lattice = Bounds(store.archive), store.archive.header.lattice
        around = Neighbourhood(bounds.index, lattice.voxel_steps, lattice.origin, lattice.step)
        ahead = prefetches(policy)
        coarse = _make_coarse(store, budget_bytes) if ahead else None
        if coarse is not None:
            budget_bytes -= coarse.bytes
        residency = Residency(store, budget_bytes, make_policy(policy, budget_bytes, around.nearness))
        residency.took = took
        if coarse is not None:
            arena, remember = residency.buffer.arena, coarse.remember
            residency.loaded = lambda row, where: remember(row, arena, where)
        # Where there is not room for all, it is for those that somebody came near.
        fill = Filling(coarse, store) if coarse is not None and coarse.holds_all else None
        self.prefetcher = Prefetcher(residency, around, ahead=ahead, idle=fill)
        figure = make_scene_data(store.archive, residency, bounds, coarse)
        data = figure if radius_model is None else with_radius_model(figure, store.archive, radius_model)
        self.data = data

        @lru_cache(MOST_MODELS)
        def under(text: str | None) -> SceneData:
            return data if text is None else with_radius_model(figure, store.archive, text)

        self.radius_model = under
        self._lock = threading.Lock()
        self._readers = 1
        self._ending: threading.Thread | None = None

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
        if self.prefetcher.running:
            # Its thread is waited for, which nobody may do who is collecting garbage, and so may hold any lock.
            self._ending = start_thread("end", self._end)
        else:
            self._end()

    def join(self) -> None:
        """Wait until all is closed, where the last reader is gone; not while garbage is collected."""
        if self._ending is not None:
            self._ending.join()

    def _end(self) -> None:
        """Stop loading, close all."""
        self.prefetcher.stop()
        del self.data, self.radius_model, self.prefetcher, self.kept
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

    def saw(self, user: User, avatar: AvatarModel, poses: Any, other: float) -> bool:
        """A user asks about an avatar under some poses, the last of which is where it is, if they are few.

        other: what is added to the avatar's spheres and the scan's, margin or reach [m]. Returns whether what is in
        reach is not stayed with: there are many poses, or it came there by no motion.
        """
        # What is not so will be refused, or is none to look ahead for.
        if not isinstance(poses, np.ndarray) or poses.dtype != np.float64 or poses.shape[1:] != (4, 4):
            return False
        if not len(poses) or not len(avatar.points):
            return False
        if not isinstance(other, NUMBER) or not 0 <= other <= MOST_AROUND:
            return False
        if len(poses) > MOST_SEEN:
            return True
        (a, b, c, tx), (d, e, f, ty), (g, h, i, tz), _ = poses[-1].tolist()
        x, y, z = avatar.arrays.center[0].tolist()
        x, y, z = a * x + b * y + c * z + tx, d * x + e * y + f * z + ty, g * x + h * y + i * z + tz
        scale = math.sqrt(a * a + d * d + g * g)
        most = MAX_COORDINATE
        if not (
            LEAST_SCALE <= scale <= 1 / LEAST_SCALE and abs(x) <= most and abs(y) <= most and abs(z) <= most
        ):
            return False
        # Who asks how far away things are will not stand in all of them.
        near = other if other < NEAR else NEAR
        reach = avatar.bounding_radius * scale + self.data.radius_units / UNITS_PER_METRE + near
        return self.prefetcher.saw(user, (x, y, z), reach)

    def warm(self) -> None:
        """Ask one of everything, a load included, so that nobody waits for compilers after."""
        data, archive = self.data, self.store.archive
        data.bounds.trees()  # before the first load, which tightens them
        row = int(np.argmin(self.store.sizes))
        corner = archive.coordinates[row] * archive.header.lattice.voxel_steps + archive.voxels["low"][row]
        pose = np.eye(4)[None]
        pose[0, :3, 3] = archive.header.lattice.to_world(corner)
        place = pose[:, :3, 3].copy()
        x, y, z = place[0].tolist()
        self.prefetcher.warm((x, y, z))
        avatar = make_avatar([[0.0, 0, 0], [0.1, 0, 0]])
        both = np.full(2, 0xFFFFFFFF, np.uint32)
        some: dict[str, Any] = {
            "avatar": avatar, "poses": pose, "pose_from": pose, "pose_to": pose, "points": place, "origins": place,
            "directions": np.array([[0.0, 0.0, 1.0]]), "reach": 0.01,
        }  # fmt: skip
        # Budgets that are hardly ever spent: what is bounded has kernels of its own, and so have deadlines.
        later = time.perf_counter() + 3600.0
        for budget in (EXACT, QueryBudget(tolerance=1e-3, visits=1 << 20), QueryBudget(deadline=later)):
            collide(
                data, avatar, np.concatenate([pose, pose]), 0.0, budget
            )  # several poses take other kernels
            for question in (one for one in QUESTIONS.values() if not one.whole):
                samples = [some[name] for name in question.arguments if name in question.required]
                tolerance = max(budget.tolerance, question.other_defaults.get("tolerance", 0.0))
                ENGINES[question.name](data, *samples, budget=budget._replace(tolerance=tolerance))
            ask_objects(data, [avatar, avatar], np.concatenate([pose, pose]), both, both, budget=budget)
        if (
            data.coarse is not None
        ):  # a load has made the coarse bounds of a voxel: ask as if it were not resident
            reach = check_request(data, avatar, pose, data.radius_units)
            nowhere = data.arrays._replace(where=np.full_like(data.arrays.where, -1))
            settle(nowhere, data.coarse.arrays, avatar.arrays, pose, reach)

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


def _make_coarse(store: Store, budget_bytes: int) -> Coarse | None:
    """Room for the coarse tops of all voxels, or of as many as COARSE_SHARE of the budget holds; None where the budget
    is too small for any beside the largest voxel."""
    voxels, largest = len(store.sizes), int(store.sizes.max(initial=0))
    most = min(int(budget_bytes * COARSE_SHARE), budget_bytes - ArenaBuffer.rounded(largest))
    coarse = Coarse(voxels, most)
    return coarse if len(coarse.arrays.count) else None


class Filling:
    """Coarse tops of voxels that were never loaded, one at a call, until all have one or there is no room."""

    def __init__(self, coarse: Coarse, store: Store) -> None:
        self._coarse, self._store, self._left = coarse, store, coarse.missing()

    def __call__(self) -> bool:
        """Make one; False where nothing is left to be made."""
        row = next(self._left, None)
        if row is None:
            return False
        # Not read, it has none: whoever asks for the voxel is told why.
        with suppress(CorruptError, OSError):
            self._coarse.fill(self._store, row)
        return True


class HeldParts(Iterator[Part]):
    """Parts of a path, which hold the generations they come from until the last part was taken or is not wanted."""

    def __init__(self, parts: Generator[Part, None, None], taken: Sequence[Opened]) -> None:
        """Hold generations that were taken for these parts."""
        self._parts = parts
        self._taken = list(taken)

    def __next__(self) -> Part:
        try:
            return next(self._parts)
        except BaseException:  # the end, too
            self.close()
            raise

    def close(self) -> None:
        """Take no more."""
        taken, self._taken = self._taken, []
        if taken:
            self._parts.close()
            for opened in taken:
                opened.release()

    def __del__(self) -> None:
        self.close()
