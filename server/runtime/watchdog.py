"""Watchdog: a thread that checks running work every few milliseconds."""

import logging
import math
import os
import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress

log = logging.getLogger(__name__)

# Interval of the checks [s]. A check costs some 10 µs of the interpreter's time.
PERIOD = 0.005
# How long the thread continues to check after work has ended [s]. Waking it costs the first request
# more than a check does.
LINGER = 1.0
# Increment of the nice value of threads with slow requests: Linux gives them a tenth of the
# processor time of others.
_NICER = 10


class Watchdog:
    """Calls a function at intervals while work is running.

    look: takes the time on `time.monotonic`'s clock [s] and returns whether any work is running. It
    is called every `period` seconds while that is so, and every `idle` seconds otherwise.
    """

    def __init__(
        self, look: Callable[[float], bool], *, period: float = PERIOD, idle: float = LINGER
    ) -> None:
        """Make a watchdog that is not running yet."""
        self._look, self._period, self._idle = look, period, idle
        self._woken = threading.Event()
        self._closed = False
        self.asleep = True

    def wake(self) -> None:
        """Have the thread check now, and regularly from now on."""
        self.asleep = False
        self._woken.set()

    def close(self) -> None:
        """End the thread after its next check."""
        self._closed = True
        self._woken.set()

    def run(self) -> None:
        """Check until the watchdog is closed. Runs in a thread."""
        until = 0.0
        self.asleep = False
        while not self._closed:
            now = time.monotonic()
            if self._is_busy(now):
                until = now + LINGER
            if now < until:
                if self._woken.wait(self._period):
                    self._woken.clear()
                continue
            # Work that begins after this line wakes the thread, even if it does not wait yet.
            self._woken.clear()
            self.asleep = True
            if not self._is_busy(time.monotonic()) and not self._closed:
                self._woken.wait(self._idle)
            self.asleep = False

    def _is_busy(self, now: float) -> bool:
        """Check once; return whether any work is running."""
        try:
            return self._look(now)
        except Exception:  # affects this check only
            log.exception("a check of running work failed")
            return True


def cpu_seconds(thread_id: int) -> float:
    """Return the processor time a thread has used so far [s]; inf if the system does not report it.

    thread_id: as `threading.get_native_id` returns it.
    """
    if sys.platform != "linux":
        return math.inf
    try:
        # The clock of a thread as the kernel numbers it (CPUCLOCK_PERTHREAD_MASK | CPUCLOCK_SCHED).
        # It takes 7 µs, /proc/self/task/*/schedstat 53 µs and the interpreter's lock three times.
        return time.clock_gettime(~thread_id << 3 | 6)
    except OSError:  # the thread has ended
        return math.inf


def lower_priority(thread_id: int) -> None:
    """Lower the priority of a thread permanently, if the system has priorities of threads.

    thread_id: as `threading.get_native_id` returns it. Raising a priority again requires
    privileges. Threads started by the thread inherit its priority.
    """
    if sys.platform == "linux":  # elsewhere this would change the whole process
        with suppress(OSError):  # the thread has ended, or a limit forbids it
            now = os.getpriority(os.PRIO_PROCESS, thread_id)
            os.setpriority(os.PRIO_PROCESS, thread_id, now + _NICER)
