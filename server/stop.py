"""The stop flag of one request: ends its work early.

Whoever watches a request sets the flag: its time is up, its client is gone, the server stops. Kernels
read it every few microseconds and return; what they had not looked at then is `unknown`.
"""

import numpy as np


class Stop:
    """A flag that the kernels of one request read and any thread may set. Thread-safe; never cleared.

    flag: (1,) int64, 0 until it is set; kernels read it without a lock.  reason: why it was set, for the answer.
    """

    __slots__ = ("__weakref__", "flag", "reason")

    def __init__(self) -> None:
        """Make a flag that is not set."""
        self.flag = np.zeros(1, np.int64)
        self.reason = ""

    def set(self, reason: str) -> None:
        """Set the flag. The first reason is kept."""
        if not self.flag[0]:
            self.reason = reason
            self.flag[0] = 1

    def __bool__(self) -> bool:
        """Return whether the flag is set."""
        return self.flag.item(0) != 0


class _Never(Stop):
    """A flag that cannot be set: all requests that nobody watches share it."""

    __slots__ = ()

    def set(self, reason: str) -> None:
        """Refuse."""
        raise RuntimeError(
            f"the stop flag of all requests was to be set ({reason}): make a Stop for the request"
        )


# Of requests that nobody watches.
NEVER: Stop = _Never()


class StoppedError(Exception):
    """A request was stopped before any of its poses could be looked at. The scene answers `unknown` for all."""
