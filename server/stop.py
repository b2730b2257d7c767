"""The stop flag of one request: ends its kernels early.

Whoever watches a request sets the flag: its time is up, its client is gone, the server stops. Kernels
read it every few microseconds to milliseconds and return; what they had not looked at then is `unknown`.
"""

import numpy as np


class Stop:
    """A flag that one request's kernels read and any thread may set. Thread-safe; never cleared.

    flag: (1,) int64, 0 until it is set; kernels read it without a lock.  reason: why it was set, for the answer.
    """

    __slots__ = ("flag", "reason")

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
        return bool(self.flag[0])
