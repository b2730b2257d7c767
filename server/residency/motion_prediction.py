"""Prediction of users' motion: which voxels will come within reach, and when.

Voxels in the direction of travel come first. A quadratic in time is fitted to a user's last poses
(velocity and acceleration, and therefore turning) and extrapolated for as long as loading takes.
The voxels in a ring around the user's position follow, in case the user turns. This module loads,
pins and evicts nothing, and reads no clock: callers pass `now` in seconds, all from the same clock.

Thread-safe. One lock guards the poses and is held for microseconds. Callers may hold other locks
when they take it; no lock is taken while it is held. `path_distances` takes no lock: the caller
that evicts holds its own.
"""

import threading
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..kernels.prediction.track_prediction import (
    PredictionLimits,
    SceneIndex,
    rows_in_reach,
    write_path_distances,
)
from ..kernels.prediction.user_tracks import (
    COUNT,
    LAST,
    MAX_SPEED,
    PIECES,
    RELATIVE_SLACK,
    TRACK_WORDS,
    PredictionOptions,
    plan_tracks,
    record_pose,
    record_poses,
    rows_kept,
)

User = tuple[str, str]

# A user without a pose for this long is assumed to have left [s].
EXPIRY = 10.0
# Initial and largest capacity in users, 2 KB each. The capacity doubles when it is exhausted; at
# the largest, a new user replaces the one whose last pose is the oldest.
INITIAL_USERS, MAX_USERS = 16, 4096


class PrefetchOptions(NamedTuple):
    """Parameters of prefetching: how far ahead to look.

    loads: horizon as a multiple of the time one load takes, clamped to `least` and `most` [s].
    ring: width of the ring around a user's position, beyond reach, whose voxels are wanted [m].
    settled: time a user must have been present without a teleport before the ring counts [s].
    most_wanted: rows a user.  motion: limits of predictions.
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
    #   history 1 s instead of 0.5, ring 0, 3 % of the bytes, loads of 79 ms: 1, 1, 5 late misses
    #   instead of 0, 1, 2; without acceleration 1, 1, 3; its bound and fading hardly matter.
    # most_wanted is only a bound: 8 was as good.
    loads: float = 8.0
    least: float = 0.5
    most: float = 4.0
    ring: float = 1.0
    # Without it, nine tenths of the prefetches for users who teleport every second were wasted,
    # 1,354 voxels.
    settled: float = 2.0
    most_wanted: int = 128
    motion: PredictionLimits = PredictionLimits(history=0.5, speed=MAX_SPEED, acceleration=6.0, fade=0.5)

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

    rows: NDArray[np.int64]
    need: NDArray[np.float64]


class UserTracks:
    """Users of one scene and the voxels they will need."""

    def __init__(
        self,
        index: SceneIndex,
        voxel_steps: int,
        origin: ArrayLike,
        step: float,
        ahead: PrefetchOptions = PREFETCH_OPTIONS,
    ) -> None:
        """Begin without users.

        voxel_steps: edge of a voxel [steps].  origin (3,), step: of the lattice [m].
        """
        self.ahead = ahead
        self._index, self._step = index, step
        self._options = PredictionOptions(
            0.0, ahead.ring, ahead.settled, ahead.most_wanted, np.array(origin, np.float64), step, voxel_steps,
            ahead.motion,
        )  # fmt: skip
        self._lock = threading.Lock()
        self._users: dict[User, int] = {}  # user -> its row in `_tracks`, ascending
        self._tracks = np.zeros((INITIAL_USERS, TRACK_WORDS))
        # The predicted paths of the last plan [steps] and the plan's number; replaced, never
        # written. `_distances` is the distance of each row from these paths [m], valid where
        # `_distance_plan` equals the plan's number. The system commits the pages of both as rows
        # are queried.
        self._planned_paths = np.empty((0, PIECES + 1, 3)), 1
        self._distance_plan, self._distances = np.zeros(len(index.keys), np.int64), np.zeros(len(index.keys))

    def without_users(self) -> "UserTracks":
        """Return tracks with the same options and no users."""
        return UserTracks(
            self._index, self._options.voxel_steps, self._options.origin, self._step, self.ahead
        )

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
        x, y, z = center
        with self._lock:
            row = self._users.get(user)
            if row is None:
                row = self._add(user)
            return bool(record_pose(self._tracks, row, now, x, y, z, reach))

    def record_poses(
        self,
        users: Sequence[User],
        times: NDArray[np.float64],
        centers: NDArray[np.float64],
        reaches: NDArray[np.float64],
    ) -> NDArray[np.bool_]:
        """Call `record_pose` for n poses in order; return whether each is a teleport (n,).

        n is at most MAX_USERS.
        """
        teleports = np.empty(len(users), np.bool_)
        with self._lock:
            known = self._users
            rows = [known[user] if user in known else self._add(user) for user in users]
            record_poses(self._tracks, np.array(rows, np.int64), times, centers, reaches, teleports)
        return teleports

    def _add(self, user: User) -> int:
        """Add a user and return its row."""
        count = len(self._users)
        if count == MAX_USERS:
            silent = int(np.argmin(self._tracks[:count, LAST]))
            self._drop(lambda row: row == silent)
            count -= 1
        if count == len(self._tracks):
            grown = np.zeros((2 * count, TRACK_WORDS))
            grown[:count] = self._tracks
            self._tracks = grown
        self._tracks[count, COUNT] = 0
        self._users[user] = count
        return count

    def _drop(self, gone: Callable[[int], bool]) -> None:
        """Remove the users whose rows satisfy `gone`; the others move up, in order."""
        left = [(user, row) for user, row in self._users.items() if not gone(row)]
        if len(left) < len(self._users):
            self._tracks[: len(left)] = self._tracks[[row for _, row in left]]
            self._users = {user: row for row, (user, _) in enumerate(left)}

    def leave(self, user: User) -> None:
        """Remove a user, if it is known."""
        with self._lock:
            row = self._users.get(user)
            self._drop(lambda other: other == row)

    def leave_client(self, client: str) -> None:
        """Remove all users of a client."""
        with self._lock:
            rows = {row for user, row in self._users.items() if user[0] == client}
            self._drop(rows.__contains__)

    def expire(self, now: float, after: float = EXPIRY) -> None:
        """Remove users whose last pose is more than `after` seconds old."""
        with self._lock:
            silent = now - self._tracks[: len(self._users), LAST] > after
            if silent.any():
                self._drop(lambda row: bool(silent[row]))

    def _snapshot(self) -> NDArray[np.float64]:
        """Return a copy of the tracks, which kernels read without the lock."""
        with self._lock:
            return self._tracks[: len(self._users)].copy()

    def plan(self, now: float, load_seconds: float) -> PredictedVoxels:
        """Predict the voxels that users will need.

        Each row is listed once, with the earliest need of all users; equal needs are in order of
        the users' arrival.
        load_seconds: current time to load one voxel including queueing, an upper percentile of the
        measured times.
        """
        options = self._options._replace(horizon=self.ahead.horizon(load_seconds))
        rows, need, paths = plan_tracks(self._snapshot(), now, options, self._index)
        self._planned_paths = paths, self._planned_paths[1] + 1
        order = np.argsort(need, kind="stable")
        return PredictedVoxels(rows[order], need[order])

    def kept(self, now: float, after: float = EXPIRY) -> NDArray[np.int64]:
        """Return the rows (n,), ascending, that users can touch at their current positions.

        Users whose last pose is more than `after` seconds old are ignored.
        """
        return np.unique(rows_kept(self._snapshot(), now, after, self._options, self._index))

    def rows_in_reach(
        self, centers: NDArray[np.float64], reaches: NDArray[np.float64]
    ) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return starts (k + 1,) and rows of the voxels that each of k balls can touch.

        centers: (k, 3) [m].  reaches: the radii (k,) [m].
        """
        options = self._options
        steps = np.ascontiguousarray((centers - options.origin) / options.step)
        spans = np.ascontiguousarray(reaches / options.step * (1.0 + RELATIVE_SLACK) + 1.0)
        starts, needed = np.zeros(len(steps) + 1, np.int64), 8 * len(steps) + 8
        while True:
            rows = np.empty(needed, np.int64)
            needed = rows_in_reach(steps, spans, self._index, options.voxel_steps, starts, rows)
            if needed <= len(rows):
                return starts, rows[:needed]

    def path_distances(self, rows: ArrayLike) -> NDArray[np.float64]:
        """Return the distance (n,) of each row's box from the nearest user's predicted path [m].

        The paths are those of the last plan; without users the distance is inf. Not thread-safe.
        Distances are cached until the next plan: for 10,000 rows and 8 users, computing them takes
        a millisecond, and looking them up some 20 µs (scripts/bench_cache).
        """
        each = np.asarray(rows, np.int64)
        paths, number = self._planned_paths
        new = each[self._distance_plan[each] != number]
        if len(new):
            far = np.empty(len(new))
            write_path_distances(paths, new, self._index, far)
            self._distances[new], self._distance_plan[new] = far * self._step, number
        return self._distances[each]
