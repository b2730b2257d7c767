"""Loads voxels before anybody asks for them, and those that somebody could not wait for: one thread a scene.

What users will need the neighbourhood says (motion_prediction.py), soonest first; the thread loads it while no request
waits for anything, and finds out what is wanted anew each time users have moved. So what a user has turned from is not
loaded any more; a load that has begun is finished. A voxel goes for another only if it is wanted later than that one.
"""

import logging
import math
import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Self

from ..runtime.threads import start_thread
from .held import Ahead
from .motion_prediction import Neighbourhood, User
from .voxel_cache import Residency

log = logging.getLogger(__name__)

# What is wanted is found out at most so often [s]: at 5 m/s a user moves a quarter of a metre meanwhile. And with very
# many users so seldom that it rests so many times as long as it takes: 64 of them take 0.2 ms, 512 take 3
# (scripts/bench_cache), most of it without the interpreter.
PLAN_SECONDS, PLAN_REST = 0.05, 10.0
# How long nothing may be heard of a user whose voxels are kept [s].
SILENCE = 10.0
MOST_REST = 0.25
# What is done when there is nothing to be loaded rests so many times as long as it works: it is Python in good part,
# and who answers waits for the interpreter meanwhile.
IDLE_REST = 4.0
# Of the budget, what is kept for who stands in it; the rest is there for whoever asks.
KEPT_SHARE = 0.5
# Of the times that loads took, this share is shorter than what is reckoned with.
USUAL = 0.9


def _wanted_later(need: dict[int, float], than: float) -> Callable[[int], bool]:
    """Whether a voxel is needed later than that, or by nobody."""
    return lambda row: need.get(row, math.inf) > than


class Prefetcher:
    """The thread of one residency, started when the first user is seen. A context manager. Thread-safe."""

    def __init__(
        self,
        residency: Residency,
        neighbourhood: Neighbourhood,
        *,
        ahead: bool = True,
        idle: Callable[[], bool] | None = None,
        clock: Callable[[], float] = time.perf_counter,
    ) -> None:
        """ahead: load what will be needed; without, only what is owed, and users' voxels are kept.  idle: called again
        and again when there is nothing to be loaded, until it returns False; some milliseconds of work each time."""
        self._residency, self._neighbourhood, self._clock, self._ahead = (
            residency,
            neighbourhood,
            clock,
            ahead,
        )
        self._work = threading.Event()
        self._urgent = threading.Event()  # ends a rest
        self._lock = threading.Lock()  # of starting and stopping
        self._thread: threading.Thread | None = None
        self._stopped = self._seen = False
        self._idle = idle
        self._failed: dict[int, float] = {}  # when; whoever asks for these tries again
        residency.owed = self._owed

    def __enter__(self) -> Self:
        """The prefetcher itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Stop: a load that has begun is finished."""
        self.stop()

    def stop(self) -> None:
        """Load nothing more, and wait for the thread."""
        with self._lock:
            self._stopped, thread = True, self._thread
        self._residency.owed = None
        self._work.set()
        self._urgent.set()
        if thread is not None and thread is not threading.current_thread():
            thread.join()
        self._residency.kept = frozenset()

    def saw(self, user: User, center: tuple[float, float, float], reach: float) -> bool:
        """A user's avatar is around `center` [m], as far as `reach` [m]; whether it came there by no motion."""
        jumped = self._neighbourhood.saw(user, self._clock(), center, reach)
        self._seen = True
        self._wake()
        return jumped

    def warm(self, center: tuple[float, float, float]) -> None:
        """Look ahead for nobody, so that compilers are done; before anybody is seen."""
        user = ("", "")
        self._neighbourhood.saw(user, self._clock(), center, 1.0)
        self._neighbourhood.plan(self._clock(), 0.0)
        self._neighbourhood.kept(self._clock())
        self._neighbourhood.nearness([0])
        self._neighbourhood.leave(user)
        self._neighbourhood.plan(self._clock(), 0.0)

    def leave_client(self, client: str) -> None:
        """Keep and load nothing more for a client's avatars."""
        self._neighbourhood.leave_client(client)
        self._seen = True
        self._wake()

    @property
    def running(self) -> bool:
        """Whether there is a thread to be waited for."""
        return self._thread is not None

    def _owed(self) -> None:
        """A load is owed: it does not wait until a rest is over."""
        self._urgent.set()
        self._wake()

    def _wake(self) -> None:
        """There is work."""
        if self._thread is None:
            self._start()
        if not self._work.is_set():
            self._work.set()

    def _start(self) -> None:
        with self._lock:
            if self._thread is None and not self._stopped:
                self._thread = start_thread("prefetch", self._run)

    def _run(self) -> None:
        """The thread's work."""
        queue: deque[tuple[int, float]] = deque()
        need: dict[int, float] = {}
        due = -math.inf
        while True:
            now = self._clock()
            if self._seen and now >= due:
                self._seen = False
                need, due = self._planned(now)
                queue = deque(need.items() if self._ahead else ())
            if self._stopped:
                return
            if self._step(queue, need):
                continue
            if self._idle is not None:
                self._rest(self._use_idle_time(self._idle))
                continue
            if self._seen:
                self._rest(due - now)  # until they may have moved far enough to look again
                continue
            # Nobody is seen any more: what they stood in is let go when their time is up.
            if not self._work.wait(SILENCE if self._residency.kept else None):
                self._seen = True
            self._work.clear()

    def _rest(self, seconds: float) -> None:
        """Wait, but not while something is owed or all is to stop."""
        self._urgent.wait(min(max(0.0, seconds), MOST_REST))
        self._urgent.clear()

    def _planned(self, now: float) -> tuple[dict[int, float], float]:
        """What is wanted, see `_plan`, and when to look again."""
        begin = time.thread_time()
        try:
            need = self._plan(now)
        except Exception:  # out of memory, say: what is asked for is loaded all the same
            log.exception("what users will need is not known")
            return {}, now + MOST_REST
        return need, now + min(max(PLAN_SECONDS, PLAN_REST * (time.thread_time() - begin)), MOST_REST)

    def _use_idle_time(self, idle: Callable[[], bool]) -> float:
        """Do some of what is done when there is nothing else; how long to rest then [s]."""
        self._residency.wait_for_nobody()
        begin = time.thread_time()
        try:
            left = idle()
        except Exception:
            log.exception("given up")
            left = False
        if not left:
            self._idle = None
        return IDLE_REST * (time.thread_time() - begin)

    def _step(self, queue: deque[tuple[int, float]], need: dict[int, float]) -> bool:
        """Load one voxel; False where there is none to be loaded."""
        residency, row = self._residency, -1
        try:
            owed = residency.take_owed()
            if owed is not None:
                residency.load_ahead(owed, lambda _: True, owed=True)
                return True
            while queue:
                row, at = queue.popleft()
                if residency.is_resident(row) or self._clock() < self._failed.get(row, -math.inf) + SILENCE:
                    continue
                found = residency.load_ahead(row, _wanted_later(need, at))
                if found is Ahead.NO_ROOM:
                    queue.clear()  # what is wanted later would have none either
                elif found is Ahead.FAILED:
                    self._failed[row] = self._clock()
                return True
        except Exception:  # out of memory, say: who asks for the voxel will be told
            log.exception("a voxel is not loaded ahead")
            self._failed[row] = self._clock()
            return True
        return False

    def _plan(self, now: float) -> dict[int, float]:
        """What all users will need, soonest first: row -> seconds until then; what they stand in is kept."""
        times = sorted(self._residency.load_times())
        usual = times[int(USUAL * (len(times) - 1))] if times else 0.0
        self._neighbourhood.expire(now, SILENCE)
        wanted = self._neighbourhood.plan(now, usual)
        need = dict(zip(wanted.rows.tolist(), wanted.need.tolist(), strict=True))
        self._residency.kept = self._within_share(self._neighbourhood.kept(now, SILENCE).tolist(), need)
        return need

    def _within_share(self, rows: list[int], need: dict[int, float]) -> frozenset[int]:
        """Of voxels that users stand in, those that may be kept: what is needed soonest, KEPT_SHARE of the budget."""
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
