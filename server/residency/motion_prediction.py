"""Prediction of users' motion: which voxels will come within reach, and when.

Voxels in the direction of travel come first. A user is expected to go on straight, with the mean
velocity of its last poses, for as long as loading takes. The voxels in a ring around the user's
position follow, in case the user turns. This module loads, pins and evicts nothing, and reads no
clock: callers pass `now` in seconds, all from the same clock.

Thread-safe. One lock guards the poses and is held for microseconds. Callers may hold other locks
when they take it; no lock is taken while it is held.
"""

import math
import threading
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..kernels.core.reach import Items, VoxelTree, find_lists
from ..runtime.stop_flag import NO_STOP

User = tuple[str, str]
Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

# At most this many users; a new user replaces the one whose last pose is the oldest.
MAX_USERS = 4096
# A displacement since the last pose of more than MAX_SPEED times the time passed (at most
# MAX_PAUSE), plus SLACK, is a teleport. Nobody walks, runs or drives indoors at MAX_SPEED [m/s].
# SLACK allows for poses that arrive late and all at once [m].
MAX_SPEED, MAX_PAUSE, SLACK = 15.0, 1.0, 1.0
# Without a pose for this long, a user is assumed to stand at the last one [s].
STALE = 0.5
# The weight of a motion in a user's velocity falls to 1/e in this time [s]. The first poses weigh
# little together: up to LEAST_WEIGHT, 10 ms, they may be scatter and count in part.
MEMORY, LEAST_WEIGHT = 0.2, 0.05
# A reach is widened by this share of itself, and by one step: by more than the rounding of the
# computations with it.
RELATIVE_SLACK = 1e-6


class PrefetchOptions(NamedTuple):
    """Parameters of prefetching: how far ahead to look.

    loads: horizon as a multiple of the time one load takes, clamped to `least` and `most` [s].
    ring: width of the ring around a user's position, beyond reach, whose voxels are wanted [m].
    settled: time a user must have been present without a teleport before the ring counts [s].
    most_wanted: rows a user, of its way and of its ring each.
    """

    # Measured with scripts/simulate_cache in a town of 4e7 points (1,215 voxels of 8 m), 8 users
    # for 300 s, a cache of a tenth of the bytes; `--ahead` sets the varied parameter; a load takes
    # 2.4 ms unless stated. Percentages are wasted prefetches, of the bytes prefetched (stroll, run,
    # tour).
    #   ring 0 m: 3, 2, 4 %, and the tour has 2 misses; 1: 6, 10, 8 %, no misses;
    #   2: 12, 18, 11 %; 4: 37, 37, 26 %.
    # For 120 s, counted in voxels, with a ring of 2 m:
    #   least 1.5 s instead of 0.5 (ring 1): 15, 34, 40 % instead of 10, 13, 14; no misses in
    #   either case.
    #   loads, of 128 ms each (--load-ms 100 --mb-ms 100): 2 and 4 have one miss more than 8 (run);
    #   8: 18, 26, 23 %; 16: 24, 40, 45 %.
    # A quadratic fit to half a second of poses, with the moments of touching of the ball itself, gained
    # nothing: in a town of 4e6 points, 60 s, a cache of 35 % of the bytes, loads of 80 ms and more, both
    # have no misses after the first second and waste 10, 6 to 7, 26 %. With a ring of 0 m, the fit has
    # 0, 0, 1 such misses, the velocity 1, 1, 0.
    # most_wanted is only a bound: 8 was as good.
    loads: float = 8.0
    least: float = 0.5
    most: float = 4.0
    ring: float = 1.0
    # Without it, nine tenths of the prefetches for users who teleport every second were wasted,
    # 1,354 voxels.
    settled: float = 2.0
    most_wanted: int = 128

    def horizon(self, load_seconds: float) -> float:
        """Return how far ahead to look when one load takes `load_seconds` [s]."""
        return min(max(self.loads * load_seconds, self.least), self.most)


PREFETCH_OPTIONS = PrefetchOptions()


class PredictedVoxels(NamedTuple):
    """Voxels that users will need.

    rows: (n,) int64, each once, soonest first.
    need: (n,) float64, seconds from now until the avatar could touch the voxel; 0: it does now.
    Rows of the ring that the predicted path does not touch have a need beyond the horizon, nearest
    first.
    """

    rows: Integers
    need: Floats


class _Track:
    """Motion of a user.

    last: time of the last pose [s]; -inf: none.  center: its position [m].  reach: of it [m].
    velocity: the weighted mean of the motions since then [m/s].
    since: time of the first pose or the last teleport.
    """

    __slots__ = ("_moved", "_weight", "center", "last", "reach", "since", "velocity")

    def __init__(self) -> None:
        self.center, self.reach, self.last = (0.0, 0.0, 0.0), 0.0, -math.inf
        self._restart(-math.inf)

    def _restart(self, now: float) -> None:
        """Forget how the user moved."""
        self.since, self.velocity = now, (0.0, 0.0, 0.0)
        self._moved, self._weight = self.velocity, 0.0

    def record(self, now: float, center: tuple[float, float, float], reach: float) -> bool:
        """Record a pose; see `UserTracks.record_pose`."""
        passed, teleport = now - self.last, False
        if -MAX_PAUSE < passed < 0.0:
            return False
        if passed < 0.0 or passed == math.inf:
            self._restart(now)
        elif math.dist(center, self.center) > MAX_SPEED * min(passed, MAX_PAUSE) + SLACK:
            teleport = True
            self._restart(now)
        else:
            # Exponential smoothing, for any intervals between poses; at an interval of 0, the limit.
            share = -math.expm1(-passed / MEMORY)
            gain, kept = share / passed if passed > 0.0 else 1.0 / MEMORY, 1.0 - share
            (x, y, z), (ox, oy, oz), (mx, my, mz) = center, self.center, self._moved
            x, y, z = kept * mx + gain * (x - ox), kept * my + gain * (y - oy), kept * mz + gain * (z - oz)
            self._moved, self._weight = (x, y, z), kept * self._weight + share
            known = max(self._weight, LEAST_WEIGHT)
            self.velocity = x / known, y / known, z / known
        self.last, self.center, self.reach = now, center, reach
        return teleport


class UserTracks:
    """Users of one scene and the voxels they will need."""

    def __init__(
        self,
        tree: VoxelTree,
        origin: ArrayLike,
        step: float,
        ahead: PrefetchOptions = PREFETCH_OPTIONS,
    ) -> None:
        """Begin without users.

        tree: boxes around the points of the scene's voxels.  origin (3,), step: of the lattice [m].
        """
        self.ahead = ahead
        self._tree, self._step = tree, step
        self._origin = np.array(origin, np.float64)
        self._lock = threading.Lock()
        self._users: dict[User, _Track] = {}

    @property
    def users(self) -> list[User]:
        """Return the known users, in order of arrival."""
        return list(self._users)

    def record_pose(self, user: User, now: float, center: tuple[float, float, float], reach: float) -> bool:
        """Record a pose and return whether it is a teleport, which discards the poses before it.

        center: of the avatar's root sphere [m].  reach: its radius with spheres and margin [m].
        A pose older than the last one is ignored, unless it is so old that its time must come from
        another clock: then the track of the user restarts.
        """
        with self._lock:
            track = self._users.get(user)
            if track is None:
                if len(self._users) == MAX_USERS:
                    del self._users[min(self._users, key=lambda each: self._users[each].last)]
                track = self._users[user] = _Track()
            return track.record(now, center, reach)

    def _drop(self, gone: Callable[[User, _Track], bool]) -> None:
        """Remove the users that satisfy `gone`."""
        with self._lock:
            self._users = {user: track for user, track in self._users.items() if not gone(user, track)}

    def leave_client(self, client: str) -> None:
        """Remove all users of a client."""
        self._drop(lambda each, _: each[0] == client)

    def expire(self, now: float, after: float) -> None:
        """Remove users whose last pose is more than `after` seconds old."""
        self._drop(lambda _, track: now - track.last > after)

    def _snapshot(self) -> Floats:
        """Return (u, 9) of u users: position [m], velocity [m/s], reach [m], times `last` and `since` [s]."""
        with self._lock:
            rows = [(*t.center, *t.velocity, t.reach, t.last, t.since) for t in self._users.values()]
        return np.array(rows).reshape(-1, 9)

    def plan(self, now: float, load_seconds: float) -> PredictedVoxels:
        """Predict the voxels that users will need.

        Each row is listed once, with the earliest need of all users.
        load_seconds: current time to load one voxel including queueing, an upper percentile of the
        measured times.
        """
        ahead, users = self.ahead, self._snapshot()
        last, since, k = users[:, 7], users[:, 8], len(users)
        horizon, late = ahead.horizon(load_seconds), np.maximum(now - last, 0.0)
        seconds = np.where(late <= STALE, late + horizon, 0.0)
        centers, reaches = self._balls(users[:, :3], users[:, 6])
        velocity = users[:, 3:6] / self._step
        rings = np.where(now - since >= ahead.settled, ahead.ring / self._step, 0.0)
        # Of each user its way, along which a cube around the ball moves, and then the ball with its
        # ring, which has no width where the user has not settled.
        ends = np.concatenate([centers + velocity * seconds[:, None], centers])
        spans = np.concatenate([reaches, reaches + rings])
        items = Items(np.tile(centers, (2, 1)), ends, spans, np.tile(reaches, 2))
        lists = find_lists(self._tree, items, NO_STOP.flag)
        count = np.diff(lists.starts)
        item, n = np.repeat(np.arange(2 * k), count), lists.starts[-1]
        # Seconds from now: along the way as far as the user has come; in the ring from the horizon
        # to twice the horizon at its outer edge.
        speed = np.sqrt((velocity * velocity).sum(axis=1))
        per_step = np.concatenate([1.0 / np.maximum(speed, 1e-300), horizon / np.maximum(rings, 1e-300)])
        first = np.concatenate([-late, np.full(k, horizon)])
        need = np.maximum(first[item] + lists.near[:n] * per_step[item], 0.0)
        first_few = np.arange(n) - lists.starts[item] < ahead.most_wanted
        rows, need = lists.rows[:n][first_few], need[first_few]
        order = np.argsort(need, kind="stable")
        order = order[np.sort(np.unique(rows[order], return_index=True)[1])]
        return PredictedVoxels(rows[order], need[order])

    def kept(self) -> Integers:
        """Return the rows (n,), ascending, that users can touch at their last positions."""
        users = self._snapshot()
        return np.unique(self.rows_in_reach(users[:, :3], users[:, 6])[1])

    def rows_in_reach(self, centers: Floats, reaches: Floats) -> tuple[Integers, Integers]:
        """Return the voxels that balls can touch: (n,) numbers of balls, ascending, and (n,) rows.

        centers: (k, 3) [m].  reaches: the radii (k,) [m].
        """
        places, spans = self._balls(centers, reaches)
        lists = find_lists(self._tree, Items(places, places, spans, spans), NO_STOP.flag)
        return np.repeat(np.arange(len(places)), np.diff(lists.starts)), lists.rows[: lists.starts[-1]]

    def _balls(self, centers: Floats, reaches: Floats) -> tuple[Floats, Floats]:
        """Convert balls from metres to steps; radii are widened by more than the rounding of their uses."""
        return (centers - self._origin) / self._step, reaches / self._step * (1.0 + RELATIVE_SLACK) + 1.0
