"""Turns in which requests load voxels: one request at a time, first in, first out.

A load is 0.1 ms of interpreted code between some twenty calls that release the interpreter's lock.
Threads that load at the same time take that lock from one another at every such call. On two cores,
with a cache of a quarter of the scene, one thread answers 113 queries per second; 16 threads answer
113 in turns and 49 without turns (`scripts/bench_thrash`).
"""

import threading
import time
from collections import deque

from ..runtime.stop_flag import StopFlag, seconds_to

# A turn that takes longer, for a slow disk or a wait for memory, does not block others [s].
MAX_TURN_SECONDS = 0.025
# A request that misses at most this many voxels does not wait for a turn behind those that miss
# more. Eight threads answer about as many queries per second with 4 as with 0, and a third fewer
# with 16.
LOADS_WITHOUT_TURN = 4


class LoadTurns:
    """First-in, first-out queue of the requests that load voxels of one cache. Thread-safe.

    The turn of a request is a lock of its own, which is released when the turn begins.
    """

    def __init__(self) -> None:
        """Let the first request have its turn at once."""
        self._lock = threading.Lock()
        self._queue: deque[threading.Lock] = deque()
        self._current: threading.Lock | None = None
        self._since = 0.0  # when the current turn began, on the monotonic clock [s]

    def take(self, deadline: float, stop: StopFlag) -> "threading.Lock | None":
        """Wait for a turn and return it; return None if the deadline or the stop flag comes first.

        `give_back` ends the turn.
        deadline: on time.perf_counter()'s clock [s].
        """
        turn = threading.Lock()
        turn.acquire()
        with self._lock:
            self._queue.append(turn)
            self._advance()
        while (left := seconds_to(deadline, stop)) != 0:
            if turn.acquire(timeout=MAX_TURN_SECONDS if left is None else min(left, MAX_TURN_SECONDS)):
                return turn
            with self._lock:
                self._advance()
        with self._lock:
            if turn in self._queue:
                self._queue.remove(turn)
                return None
        return turn  # granted between the last wait and the deadline

    def give_back(self, turn: "threading.Lock | None") -> None:
        """End a turn; do nothing for None or a turn that has ended or was superseded."""
        with self._lock:
            if turn is not None and turn is self._current:
                self._current = None
                self._advance()

    def _advance(self) -> None:
        """Grant the first request in the queue its turn, unless a turn within its time is held."""
        now = time.monotonic()
        if self._queue and (self._current is None or now - self._since >= MAX_TURN_SECONDS):
            self._current, self._since = self._queue.popleft(), now
            self._current.release()
