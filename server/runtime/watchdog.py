"""A thread that looks, every few milliseconds, at what is at work. No zenoh here."""

import logging
import math
import os
import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress

log = logging.getLogger(__name__)

# How often the thread looks [s]. A look costs some 10 µs of the interpreter.
PERIOD = 0.005
# How long the thread goes on looking after there was something at work [s]. Being woken costs the first request more
# than a look does.
LINGER = 1.0
# What is added to the nice value of threads whose requests are slow: Linux gives them a tenth of what others get.
_NICER = 10


class Watchdog:
    """Calls a function at intervals while there is something to look at.

    look: takes the time on `time.monotonic`'s clock [s] and returns whether anything is at work. It is called every
    `period` seconds then, and once in `idle` seconds otherwise.
    """

    def __init__(
        self, look: Callable[[float], bool], *, period: float = PERIOD, idle: float = LINGER
    ) -> None:
        """Make a watchdog that does not look yet."""
        self._look, self._period, self._idle = look, period, idle
        self._woken = threading.Event()
        self._closed = False
        self.asleep = True

    def wake(self) -> None:
        """Have the thread look now, and from now on."""
        self.asleep = False
        self._woken.set()

    def close(self) -> None:
        """End the thread after its next look."""
        self._closed = True
        self._woken.set()

    def run(self) -> None:
        """Look until the watchdog is closed. A thread's work."""
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
            # Whoever begins after this wakes the thread, even before it waits.
            self._woken.clear()
            self.asleep = True
            if not self._is_busy(time.monotonic()) and not self._closed:
                self._woken.wait(self._idle)
            self.asleep = False

    def _is_busy(self, now: float) -> bool:
        """Look once."""
        try:
            return self._look(now)
        except Exception:  # of this look alone
            log.exception("a look at what is at work")
            return True


def cpu_seconds(thread_id: int) -> float:
    """Return the processor time that a thread has taken so far [s]; inf where the system does not say.

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
    """Lower the priority of a thread for good, where the system has priorities of threads.

    thread_id: as `threading.get_native_id` returns it. Raising a priority again takes privileges, and threads that are
    started by such a thread have its priority.
    """
    if sys.platform == "linux":  # elsewhere this would change the whole process
        with suppress(OSError):  # the thread has ended, or a limit forbids it
            now = os.getpriority(os.PRIO_PROCESS, thread_id)
            os.setpriority(os.PRIO_PROCESS, thread_id, now + _NICER)
