"""Watchdog: a thread that checks running work every few milliseconds, such as the jobs of requests.

A request that computes for long keeps its thread, but another thread replaces it as a worker. The
watchdog starts these threads, because a thread inherits the low priority of a slow one.
"""

import logging
import math
import os
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable
from contextlib import suppress
from typing import Any

from ..runtime.stop_flag import StopFlag
from .fair_queues import FairQueues, Ticket, TicketState

log = logging.getLogger(__name__)

# Interval of the checks [s]. A check costs some 10 µs of the interpreter's time.
PERIOD = 0.005
# How long the thread continues to check after work has ended [s]. Waking it costs the first request
# more than a check does.
LINGER = 1.0
# Increment of the nice value of threads with slow requests: Linux gives them a tenth of the
# processor time of others.
_NICER = 10
# How long a request may hold a worker, and how long it may compute before it is slow [s]. Nearly
# all requests take less, and others wait at most this long for a slow one.
SLOW_SECONDS = 0.01


class Watchdog:
    """Calls a function at intervals while work is running.

    look: function of the time on `time.monotonic`'s clock [s] that returns whether any work is
    running. While it returns True, and for LINGER afterwards, it is called every `period` seconds;
    otherwise every `idle` seconds and after `wake`.
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
        """Wake the thread to check now, and regularly from now on."""
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


class RequestJob:
    """Current work of one thread.

    ticket: of the request; None if the thread refuses a request.
    takes: whether the thread is a worker, which must be replaced when it is slow.
    sending: whether the thread sends the answer.  stop: stop flag of the request.
    begun: when the work or the sending of the answer began [s].
    again: whether the request must be carried out again.
    ended: whether the answer is no longer needed.
    left: for a refusal, whether its thread was replaced.
    cpu: processor time of the thread at the beginning [s].
    low: whether the thread has a lower priority.
    """

    __slots__ = (
        "again",
        "begun",
        "cpu",
        "ended",
        "left",
        "low",
        "sending",
        "stop",
        "takes",
        "thread_id",
        "ticket",
    )

    def __init__(
        self, ticket: Ticket | None, takes: bool, *, sending: bool = False, part_seconds: float = math.inf
    ) -> None:
        """Begin the job in the calling thread. part_seconds: see `StopFlag`."""
        self.ticket, self.takes, self.sending = ticket, takes, sending
        self.begun = time.monotonic()
        self.thread_id = threading.get_native_id()
        self.stop = StopFlag(part_seconds)
        self.cpu = time.thread_time()
        self.again = self.ended = self.left = False
        self.low = ticket is not None and ticket.slow

    @property
    def client(self) -> str:
        """Return the client that sent the request; "" if there is none."""
        return "" if self.ticket is None else self.ticket.client

    @property
    def turn(self) -> str:
        """Return the turn of the request; "" if there is none."""
        return "" if self.ticket is None else self.ticket.turn

    @property
    def is_computing(self) -> bool:
        """Return whether the thread has computed, not waited, for at least SLOW_SECONDS."""
        return cpu_seconds(self.thread_id) - self.cpu >= SLOW_SECONDS

    def end(self, reason: str) -> None:
        """Stop the request permanently."""
        self.ended = True
        self.stop.set(reason)


class JobSupervisor:
    """Supervisor of the jobs of one scene's threads. Thread-safe.

    It replaces the worker of a job that takes long, stops a job whose time is up, and starts
    threads that must not inherit the priority of a slow one.
    """

    def __init__(
        self,
        max_seconds: float,
        queues: FairQueues,
        start_thread: Callable[..., None],
        start_worker: Callable[[], None],
        start_tickets: Callable[[Iterable[Ticket]], None],
    ) -> None:
        """Supervise no jobs yet.

        max_seconds: time limit of a request.  start_thread: starts a named thread.
        start_worker: starts a worker.  start_tickets: carries out requests, each in a thread.
        """
        self._max_seconds, self._queues = max_seconds, queues
        self._start_thread, self._start_worker, self._start_tickets = (
            start_thread,
            start_worker,
            start_tickets,
        )
        self.lock = threading.Lock()  # guards the flags `again` and `left` of jobs, and `sending`
        self._jobs: set[RequestJob] = set()  # running now
        self._to_start: deque[tuple[str, Callable[..., object], tuple[Any, ...]]] = deque()

    @property
    def jobs(self) -> list[RequestJob]:
        """Return the jobs that run now."""
        return list(self._jobs)

    @property
    def threads_to_start(self) -> int:
        """Return the number of threads that the next check starts."""
        return len(self._to_start)

    def start_later(self, name: str, run: Callable[..., object], *arguments: Any) -> None:
        """Let the next check start a thread. It retries while the system has no thread left."""
        self._to_start.append((name, run, arguments))

    def add(self, job: RequestJob) -> None:
        """Supervise a job."""
        with self.lock:
            self._jobs.add(job)

    def remove(self, job: RequestJob) -> None:
        """End the supervision of a job."""
        with self.lock:
            self._jobs.discard(job)

    def check(self, now: float) -> bool:
        """Check all jobs; return whether there are any. now: on the monotonic clock [s]."""
        while self._to_start:
            name, run, arguments = self._to_start[0]
            self._start_thread(name, run, *arguments)
            self._to_start.popleft()
        jobs = self.jobs
        for job in jobs:
            if now - job.begun >= SLOW_SECONDS:
                self._check_job(job, now)
        return bool(jobs)

    def _check_job(self, job: RequestJob, now: float) -> None:
        """Replace the worker of a job that takes long, and stop a job whose time is up."""
        most = self._max_seconds
        if job.ticket is None:
            with self.lock:
                replace = job in self._jobs and not job.left
                job.left = job.left or replace
            if replace and job.takes:
                self._start_worker()
            return
        if not job.low:
            self._replace(job, job.ticket)
        if not job.sending and now - job.begun >= most:
            job.stop.set(f"the request took longer than {most:g} s, the most that this server spends on one")

    def _replace(self, job: RequestJob, ticket: Ticket) -> None:
        """Start a new thread in place of the job's thread.

        A job that waits for a voxel, a client or a processor occupies only its thread; one that
        computes occupies a slow place.
        """
        left, computing = ticket.left, not job.sending and job.is_computing
        if left and not computing:
            return
        started = self._queues.move_to_slow(ticket) if computing else self._queues.move_to_waiting(ticket)
        if started is not None:
            if computing:
                job.low = True
                lower_priority(job.thread_id)
            if job.takes and not left:
                self._start_worker()
            self._start_tickets(started)
        elif computing and not job.stop and ticket.state in (TicketState.WORKING, TicketState.WAITS):
            # All slow places are taken: stop the request, which restarts when one becomes free.
            with self.lock:
                job.again = not job.sending
            if job.again:
                job.stop.set("more slow requests than the server takes at a time")


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
