"""Deadlines of requests: one thread sets the stop flag of each request whose time is up.

The thread runs for the life of the process. A server starts it before it answers requests; in any
other process the first deadline starts it. It waits without the interpreter's lock until the
earliest deadline, so thousands of deadlines that are met cost one heap operation each.
"""

import heapq
import itertools
import threading
import time
import weakref

from .stop_flag import StopFlag
from .threads import start_thread

# Entries whose request has ended stay until their time, or until the heap has grown by this factor
# since it was last compacted.
_DEAD_SHARE = 2
_LEAST_ENTRIES = 256


class Deadlines:
    """Stop flags by the time at which they are to be set. Thread-safe.

    A flag without other references is dropped.
    """

    def __init__(self) -> None:
        """Start without a thread."""
        self._changed = threading.Condition()
        self._heap: list[tuple[float, int, weakref.ref[StopFlag], str]] = []
        self._numbers = itertools.count()
        self._compact_at = _LEAST_ENTRIES
        self._thread: threading.Thread | None = None

    def start(self) -> None:
        """Start the thread, unless it runs. It keeps the priority of the thread that starts it."""
        with self._changed:
            self._start()

    def add(self, stop: StopFlag, when: float, reason: str) -> None:
        """Set `stop` with this reason at `when`, on time.perf_counter()'s clock [s]."""
        with self._changed:
            heapq.heappush(self._heap, (when, next(self._numbers), weakref.ref(stop), reason))
            if len(self._heap) > self._compact_at:
                self._compact()
            self._start()
            if self._heap[0][0] == when:
                self._changed.notify()

    def _start(self) -> None:
        """Start the thread, unless it runs. If that raises, the next deadline tries again."""
        if self._thread is None:
            self._thread = start_thread("deadlines", self._run)

    def _compact(self) -> None:
        """Drop the entries whose flag no longer exists or is set."""
        self._heap = [entry for entry in self._heap if (stop := entry[2]()) is not None and not stop]
        heapq.heapify(self._heap)
        self._compact_at = max(_LEAST_ENTRIES, _DEAD_SHARE * len(self._heap))

    def _run(self) -> None:
        """Set each flag at its time."""
        while True:
            with self._changed:
                while not self._heap or (left := self._heap[0][0] - time.perf_counter()) > 0:
                    self._changed.wait(min(left, threading.TIMEOUT_MAX) if self._heap else None)
                _, _, reference, reason = heapq.heappop(self._heap)
            stop = reference()
            if stop is not None:
                stop.set(reason)
            del stop  # the entry must not keep the flag alive while the thread waits


_DEADLINES = Deadlines()


def stop_at(stop: StopFlag, when: float, reason: str) -> None:
    """Set `stop` at `when`, on time.perf_counter()'s clock [s], if it is still referenced then."""
    _DEADLINES.add(stop, when, reason)


def start_deadlines() -> None:
    """Start the thread now, so that it does not inherit the low priority of a slow request."""
    _DEADLINES.start()
