"""Prefetching: users' motion, the voxels that they will need, and the thread that loads these.

A user is expected to go on straight, with the mean velocity of its last poses, for as long as loading
takes (`UserTracks`). Voxels in the direction of travel come first; those in a ring around the user's
position follow, in case the user turns.

One thread a scene (`Prefetcher`) loads them while no request waits for anything, and updates the list
each time users have moved. Voxels that a user has turned away from are therefore not loaded any more;
a load that has begun is finished. A prefetch evicts only voxels that are needed later than the
prefetched one. The thread also does the loads owed to requests whose deadline came first.
"""

import logging
import math
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from itertools import accumulate
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..kernels.core.reach import Items, VoxelTree, find_lists
from ..runtime.stop_flag import NO_STOP
from ..runtime.threads import start_loop
from .voxel_cache import BackgroundLoad, VoxelCache

log = logging.getLogger(__name__)

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

# Least time between two plans [s], in which a user at 5 m/s moves a quarter of a metre. The pause
# after a plan is also at least PLAN_REST times the plan's duration: 0.7 ms for 8 users, 1.7 for 64, 12
# for 512 (scripts/bench_cache), mostly with the interpreter's lock.
PLAN_SECONDS, PLAN_REST = 0.05, 10.0
# The voxels of a user are kept for this long after its last pose [s]. A voxel whose prefetch failed
# is not prefetched again for as long.
SILENCE = 10.0
# The longest pause [s].
MAX_REST = 0.25
# A pause between pieces of idle work is this many times as long as the work, because requests wait
# for the interpreter's lock during its Python code.
IDLE_REST = 4.0
# Share of the budget that is kept for users' current positions; the rest is available to all
# requests.
KEPT_SHARE = 0.5
# Quantile of the measured load times that predictions assume.
LOAD_TIME_QUANTILE = 0.9


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
    """Users of one scene and the voxels they will need. Thread-safe.

    It loads, pins and evicts nothing, and reads no clock: callers pass `now` in seconds, all from the
    same clock. One lock guards the poses and is held for microseconds. Callers may hold other locks
    when they take it; no lock is taken while it is held.
    """

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

    def plan(self, now: float, load_seconds: float) -> dict[int, float]:
        """Predict the voxels that users will need: row -> seconds from now, soonest first.

        The seconds are until an avatar could touch the voxel, the earliest of all users; 0: one does
        now. Rows of the ring that the predicted path does not touch have more than the horizon.
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
        return dict(zip(rows[order].tolist(), need[order].tolist(), strict=True))

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


def _is_needed_later(need: dict[int, float], than: float) -> Callable[[int], bool]:
    """Return a function that tells whether a row is needed later than `than`, or not at all."""
    return lambda row: need.get(row, math.inf) > than


class Prefetcher:
    """Prefetch thread of one residency. Thread-safe.

    The thread starts when the first user is seen.
    """

    def __init__(
        self,
        residency: VoxelCache,
        tracks: UserTracks,
        *,
        prefetch: bool = True,
        idle: Iterator[object] | None = None,
        level: VoxelCache | None = None,
    ) -> None:
        """Make a prefetcher without a thread.

        prefetch: whether to prefetch; if False, load only owed voxels and keep users' voxels.
        idle: advanced when there is nothing to load, until its end; each step does some
        milliseconds of work.
        level: cache of the level of detail, whose owed loads are done before those of `residency`.
        """
        self._residency, self._tracks, self._prefetch = residency, tracks, prefetch
        self._work = threading.Event()
        self._urgent = threading.Event()  # ends a rest
        self._lock = threading.Lock()  # guards starting and stopping
        self._thread: threading.Thread | None = None
        self._stopped = self._seen = False
        self._idle = idle
        self._failed: dict[int, float] = {}  # row -> time; a request for the voxel tries again
        self._caches = [residency] if level is None else [level, residency]
        for cache in self._caches:
            cache.on_owed = self._owed

    def stop(self) -> None:
        """Stop loading, and wait for the thread; a load that has begun is finished."""
        with self._lock:
            self._stopped, thread = True, self._thread
        for cache in self._caches:
            cache.on_owed = None
        self._work.set()
        self._urgent.set()
        if thread is not None and thread is not threading.current_thread():
            thread.join()
        self._residency.kept = frozenset()

    def record_pose(self, user: User, center: tuple[float, float, float], reach: float) -> bool:
        """Record that a user's avatar is within `reach` [m] of `center` [m].

        Return whether it teleported there.
        """
        jumped = self._tracks.record_pose(user, time.perf_counter(), center, reach)
        self._seen = True
        self._wake()
        return jumped

    def leave_client(self, client: str) -> None:
        """Stop keeping and prefetching voxels for a client's avatars."""
        self._tracks.leave_client(client)
        self._seen = True
        self._wake()

    @property
    def running(self) -> bool:
        """Return whether the thread was started."""
        return self._thread is not None

    def _owed(self) -> None:
        """Wake the thread for an owed load, also from a pause."""
        self._urgent.set()
        self._wake()

    def _wake(self) -> None:
        """Wake the thread, starting it if necessary."""
        if self._thread is None:
            self._start()
        if not self._work.is_set():
            self._work.set()

    def _start(self) -> None:
        with self._lock:
            if self._thread is None and not self._stopped:
                self._thread = start_loop("prefetch", self._run)

    def _run(self) -> None:
        """Prefetch until stopped. Runs in the thread."""
        queue: deque[tuple[int, float]] = deque()
        need: dict[int, float] = {}
        due = -math.inf
        while True:
            now = time.perf_counter()
            if self._seen and now >= due:
                self._seen = False
                need, due = self._planned(now)
                queue = deque(need.items() if self._prefetch else ())
            if self._stopped:
                return
            if self._step(queue, need):
                continue
            if self._idle is not None:
                self._rest(self._use_idle_time(self._idle))
                continue
            if self._seen:
                self._rest(due - now)  # until the next plan is due
                continue
            # No more poses arrive: kept voxels are released after SILENCE.
            if not self._work.wait(SILENCE if self._residency.kept else None):
                self._seen = True
            self._work.clear()

    def _rest(self, seconds: float) -> None:
        """Pause; an owed load or `stop` ends the pause."""
        self._urgent.wait(min(max(0.0, seconds), MAX_REST))
        self._urgent.clear()

    def _planned(self, now: float) -> tuple[dict[int, float], float]:
        """Return the voxels that all users will need, and the time of the next plan.

        The voxels come soonest first: row -> seconds until then. Update the set of voxels kept for
        users' current positions.
        """
        begin, residency, tracks = time.thread_time(), self._residency, self._tracks
        try:
            times = sorted(residency.load_times())
            usual = times[int(LOAD_TIME_QUANTILE * (len(times) - 1))] if times else 0.0
            tracks.expire(now, SILENCE)
            need = tracks.plan(now, usual)
            residency.kept = self._within_share(tracks.kept().tolist(), need)
        except Exception:  # for example out of memory: requested voxels are loaded all the same
            log.exception("the prefetch plan failed")
            return {}, now + MAX_REST
        return need, now + min(max(PLAN_SECONDS, PLAN_REST * (time.thread_time() - begin)), MAX_REST)

    def _use_idle_time(self, idle: Iterator[object]) -> float:
        """Do one piece of idle work; return how long to pause afterwards [s]."""
        self._residency.wait_until_idle()
        begin = time.thread_time()
        try:
            next(idle)
        except Exception as error:
            self._idle = None
            if not isinstance(error, StopIteration):
                log.exception("idle work failed and is abandoned")
        return IDLE_REST * (time.thread_time() - begin)

    def _step(self, queue: deque[tuple[int, float]], need: dict[int, float]) -> bool:
        """Load one voxel; return False if there is none to load."""
        residency, row = self._residency, -1
        try:
            for cache in self._caches:
                owed = cache.take_owed()
                if owed is not None:
                    row = owed if cache is residency else -1
                    cache.load_in_background(owed, lambda _: True, owed=True)
                    return True
            while queue:
                row, at = queue.popleft()
                if (
                    residency.is_resident(row)
                    or time.perf_counter() < self._failed.get(row, -math.inf) + SILENCE
                ):
                    continue
                found = residency.load_in_background(row, _is_needed_later(need, at))
                if found is BackgroundLoad.NO_ROOM:
                    queue.clear()  # voxels needed later would find no room either
                elif found is BackgroundLoad.FAILED:
                    self._failed[row] = time.perf_counter()
                return True
        except Exception:  # for example out of memory: a request for the voxel reports it
            log.exception("a prefetch failed")
            if row >= 0:
                self._failed[row] = time.perf_counter()
            return True
        return False

    def _within_share(self, rows: list[int], need: dict[int, float]) -> frozenset[int]:
        """Select rows, soonest needed first, that fit together in KEPT_SHARE of the budget."""
        rows = sorted(rows, key=lambda row: need.get(row, math.inf))
        taken = accumulate(self._residency.bytes_of([row]) for row in rows)
        share = KEPT_SHARE * self._residency.budget_bytes
        return frozenset(row for row, size in zip(rows, taken, strict=True) if size <= share)
