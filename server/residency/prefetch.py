"""Prefetching of voxels, and loads owed to requests whose deadline came first: one thread a scene.

motion_prediction.py lists the voxels that users will need, soonest first. The thread loads them
while no request waits for anything, and updates the list each time users have moved. Voxels that a
user has turned away from are therefore not loaded any more; a load that has begun is finished. A
prefetch evicts only voxels that are needed later than the prefetched one.
"""

import logging
import math
import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Self

from ..runtime.threads import start_loop
from .motion_prediction import User, UserTracks
from .voxel_cache import BackgroundLoad, VoxelCache

log = logging.getLogger(__name__)

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


def _is_needed_later(need: dict[int, float], than: float) -> Callable[[int], bool]:
    """Return a function that tells whether a row is needed later than `than`, or not at all."""
    return lambda row: need.get(row, math.inf) > than


class Prefetcher:
    """Prefetch thread of one residency. A context manager. Thread-safe.

    The thread starts when the first user is seen.
    """

    def __init__(
        self,
        residency: VoxelCache,
        tracks: UserTracks,
        *,
        prefetch: bool = True,
        idle: Callable[[], bool] | None = None,
        clock: Callable[[], float] = time.perf_counter,
        level: VoxelCache | None = None,
    ) -> None:
        """Make a prefetcher without a thread.

        prefetch: whether to prefetch; if False, load only owed voxels and keep users' voxels.
        idle: called repeatedly when there is nothing to load, until it returns False; each call
        does some milliseconds of work.
        clock: returns the time [s].
        level: cache of the level of detail, whose owed loads are done before those of `residency`.
        """
        self._residency, self._tracks, self._clock, self._prefetch = residency, tracks, clock, prefetch
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

    def __enter__(self) -> Self:
        """Return the prefetcher itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Stop; a load that has begun is finished."""
        self.stop()

    def stop(self) -> None:
        """Stop loading, and wait for the thread."""
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
        jumped = self._tracks.record_pose(user, self._clock(), center, reach)
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
            now = self._clock()
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
            wanted = tracks.plan(now, usual)
            need = dict(zip(wanted.rows.tolist(), wanted.need.tolist(), strict=True))
            residency.kept = self._within_share(tracks.kept().tolist(), need)
        except Exception:  # for example out of memory: requested voxels are loaded all the same
            log.exception("the prefetch plan failed")
            return {}, now + MAX_REST
        return need, now + min(max(PLAN_SECONDS, PLAN_REST * (time.thread_time() - begin)), MAX_REST)

    def _use_idle_time(self, idle: Callable[[], bool]) -> float:
        """Do one piece of idle work; return how long to pause afterwards [s]."""
        self._residency.wait_until_idle()
        begin = time.thread_time()
        try:
            left = idle()
        except Exception:
            log.exception("idle work failed and is abandoned")
            left = False
        if not left:
            self._idle = None
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
                if residency.is_resident(row) or self._clock() < self._failed.get(row, -math.inf) + SILENCE:
                    continue
                found = residency.load_in_background(row, _is_needed_later(need, at))
                if found is BackgroundLoad.NO_ROOM:
                    queue.clear()  # voxels needed later would find no room either
                elif found is BackgroundLoad.FAILED:
                    self._failed[row] = self._clock()
                return True
        except Exception:  # for example out of memory: a request for the voxel reports it
            log.exception("a prefetch failed")
            if row >= 0:
                self._failed[row] = self._clock()
            return True
        return False

    def _within_share(self, rows: list[int], need: dict[int, float]) -> frozenset[int]:
        """Select rows, soonest needed first, that fit together in KEPT_SHARE of the budget."""
        left = int(KEPT_SHARE * self._residency.budget_bytes)
        if self._residency.bytes_of(rows) <= left:
            return frozenset(rows)
        kept = []
        for row in sorted(rows, key=lambda row: need.get(row, math.inf)):
            left -= self._residency.bytes_of([row])
            if left < 0:
                break
            kept.append(row)
        return frozenset(kept)
