"""Stop flags, which end the work of a request early, and the deadlines that set them.

A flag is set when the request's time is up, its client has disconnected or the server stops.
Kernels read it every few microseconds and return; what they have not examined by then is `unknown`.
The deadline that a request names itself sets a part of its flag, without a reason: the answer is as
asked for. Whatever else stops it gives a reason, which the answer carries.
"""

import heapq
import itertools
import math
import threading
import time
import weakref

import numpy as np

from .threads import start_loop

_PARTS = threading.Lock()
# Interval at which a waiting request checks its stop flag [s].
_LOOK_SECONDS = 0.005
# Entries whose request has ended stay until their time, or until the heap has grown by this factor
# since it was last compacted.
_DEAD_SHARE = 2
_LEAST_ENTRIES = 256


class StopFlag:
    """Flag that the kernels of one request read and any thread may set. Thread-safe; never cleared.

    flag: (1,) int64, 0 until it is set; kernels read it without a lock.
    reason: reason for which it was set, for the answer; "" until then, and at the request's own
    deadline.
    part_seconds: time limit of one part of an answer in parts [s].
    """

    __slots__ = ("__weakref__", "_parts", "flag", "part_seconds", "reason")

    def __init__(self, part_seconds: float = math.inf) -> None:
        """Make a flag that is not set."""
        self.flag = np.zeros(1, np.int64)
        self.reason = ""
        self.part_seconds = part_seconds
        self._parts: list[weakref.ref[StopFlag]] = []

    def set(self, reason: str) -> None:
        """Set the flag, and those of its parts. The first reason is kept."""
        if self.flag[0]:
            return
        self.reason = reason
        self.flag[0] = 1
        with _PARTS:
            parts = [part for each in self._parts if (part := each()) is not None]
        for part in parts:
            part.set(reason)

    def part(self) -> "StopFlag":
        """Return a flag for a part of the work; setting this flag sets the part's flag too."""
        part = StopFlag()
        with _PARTS:
            self._parts = [each for each in self._parts if each() is not None]
            self._parts.append(weakref.ref(part))
        if self:
            part.set(self.reason)
        return part

    def __bool__(self) -> bool:
        """Return whether the flag is set."""
        return self.flag.item(0) != 0


class _Never(StopFlag):
    """Flag that cannot be set, shared by all requests without a time limit or watchdog."""

    __slots__ = ()

    def set(self, reason: str) -> None:
        """Raise RuntimeError: the flag is shared."""
        raise RuntimeError(
            f"NO_STOP is shared by all requests and cannot be set ({reason}): make a StopFlag for the request"
        )

    def part(self) -> StopFlag:
        """Return an independent flag: this one is never set."""
        return StopFlag()


# Stop flag of requests that nothing stops.
NO_STOP: StopFlag = _Never()


class StoppedError(Exception):
    """Request stopped before any of its poses was examined. The scene answers `unknown` for all."""


def seconds_to(deadline: float, stop: StopFlag) -> float | None:
    """Return how long a request may wait before its next check [s]; None: without limit.

    deadline: on time.perf_counter()'s clock [s]. The result is 0 after the deadline or once the
    stop flag is set, and at most 5 ms for a request that can be stopped.
    """
    if stop:
        return 0.0
    most = math.inf if stop is NO_STOP else _LOOK_SECONDS
    if deadline < math.inf:
        most = min(most, max(0.0, deadline - time.perf_counter()))
    return None if most == math.inf else min(most, threading.TIMEOUT_MAX)


class Deadlines:
    """Stop flags by the time at which they are to be set. Thread-safe.

    One thread sets the flags. It runs for the life of the process: a server starts it before it
    answers requests, in any other process the first deadline starts it. It waits without the
    interpreter's lock until the earliest deadline, so thousands of deadlines that are met cost one
    heap operation each. A flag without other references is dropped.
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
            self._thread = start_loop("deadlines", self._run)

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
    if when <= time.perf_counter():
        stop.set(reason)
    else:
        _DEADLINES.add(stop, when, reason)


def start_deadlines() -> None:
    """Start the thread now, so that it does not inherit the low priority of a slow request."""
    _DEADLINES.start()
