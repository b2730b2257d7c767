"""The stop flag of one request: ends its work early.

Whoever watches a request sets the flag: its time is up, its client is gone, the server stops. Kernels
read it every few microseconds and return; what they had not looked at then is `unknown`.
"""

import math
import time

import numpy as np


class Stop:
    """A flag that the kernels of one request read and any thread may set. Thread-safe; never cleared.

    flag: (1,) int64, 0 until it is set; kernels read it without a lock.  reason: why it was set, for the answer.
    until: when the request's time is up, on the clock of `time.perf_counter` [s]: no load is waited for longer.
    """

    __slots__ = ("flag", "reason", "until")

    def __init__(self, until: float = math.inf) -> None:
        """Make a flag that is not set."""
        self.flag = np.zeros(1, np.int64)
        self.reason = ""
        self.until = until

    def set(self, reason: str) -> None:
        """Set the flag. The first reason is kept."""
        if not self.flag[0]:
            self.reason = reason
            self.flag[0] = 1

    def __bool__(self) -> bool:
        """Return whether the flag is set."""
        return bool(self.flag[0])

    @property
    def late(self) -> bool:
        """Whether the time is up, though nobody set the flag yet."""
        return self.until < math.inf and time.perf_counter() >= self.until


# Of requests that nobody watches.
NEVER = Stop()


class StoppedError(Exception):
    """A request was stopped before any of its poses could be looked at. The scene answers `unknown` for all."""
