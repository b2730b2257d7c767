"""Stop flag of one request: ends its work early.

The flag is set when the request's time is up, its client has disconnected or the server stops.
Kernels read it every few microseconds and return; what they have not examined by then is `unknown`.
"""

import math
import threading
import time
import weakref

import numpy as np

_PARTS = threading.Lock()
# Interval at which a waiting request checks its stop flag [s].
_LOOK_SECONDS = 0.005


class StopFlag:
    """Flag that the kernels of one request read and any thread may set. Thread-safe; never cleared.

    flag: (1,) int64, 0 until it is set; kernels read it without a lock.
    reason: why it was set, for the answer.
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
            f"the stop flag of all requests was to be set ({reason}): make a StopFlag for the request"
        )

    def part(self) -> StopFlag:
        """Return an independent flag: this one is never set."""
        return StopFlag()


# Stop flag of requests that nothing stops.
NO_STOP: StopFlag = _Never()


class StoppedError(Exception):
    """Request stopped before any of its poses was examined. The scene answers `unknown` for all."""


def seconds_to(deadline: float, stop: StopFlag) -> float | None:
    """Return how long a request may wait before it checks again [s]; None: without limit.

    deadline: on time.perf_counter()'s clock [s]. The result is 0 after the deadline or once the
    stop flag is set, and at most 5 ms for a request that can be stopped.
    """
    if stop:
        return 0.0
    most = math.inf if stop is NO_STOP else _LOOK_SECONDS
    if deadline < math.inf:
        most = min(most, max(0.0, deadline - time.perf_counter()))
    return None if most == math.inf else min(most, threading.TIMEOUT_MAX)
