"""Execution of pure work units in this process, in a process pool, or on a cluster.

Results come in the order of the units. A progress listener learns how much is done; the command
line draws it.
"""

import logging
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from itertools import pairwise
from types import TracebackType
from typing import Any, Protocol, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from ...schemas.errors import SolidcloudError
from ...schemas.runtime.interrupts import blocking_sigint, check_interrupt

Unit = TypeVar("Unit")
Result = TypeVar("Result")
Handle = TypeVar("Handle")

_COMPILING = logging.getLogger("solidcloud.schemas.runtime.compiling")
# With fewer points, a second process costs more (1 to 2 s to start and to load the kernels) than it
# saves.
POINTS_WORTH_A_PROCESS = 4_000_000
# Limits per process: units handed out and not done, and results that wait for earlier ones.
WAITING, AHEAD = 4, 64
# Ranges of voxels per job: the last ones to finish are small compared with the whole.
_RANGES_A_JOB = 8
# Least points of a range, because each range opens the archive again.
_MIN_POINTS = 1 << 20
# How often a wait for a unit checks for an interrupt.
ASK_SECONDS = 0.1


class Progress(Protocol):
    """Listener to the stages of long work.

    The stages follow one another; the amounts of `advance` add up to about the total of the stage.
    """

    def start(self, stage: str, total: int, unit: str, costs: Sequence[float] | None = None) -> None:
        """Begin a stage; total is in `unit`, such as "points".

        costs: (total,) relative expected time of each unit of work, in order, if the units are few
        and unlike; None: they are alike.
        """
        ...

    def advance(self, amount: int) -> None:
        """Report that `amount` more of the stage is done."""
        ...

    def finish(self) -> None:
        """End the stage."""
        ...


class Silent:
    """Progress listener that ignores every report."""

    def start(self, stage: str, total: int, unit: str, costs: Sequence[float] | None = None) -> None:
        """Ignore the beginning of a stage."""

    def advance(self, amount: int) -> None:
        """Ignore the amount."""

    def finish(self) -> None:
        """Ignore the end of a stage."""


class Executor(Protocol):
    """Map a picklable function over work units. A context manager.

    jobs: number of units that can run at a time.  at_once: number that do run at a time, lower than
    `jobs` if memory is short.
    """

    jobs: int
    at_once: int

    def __enter__(self) -> Self:
        """Return the executor itself."""
        ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Stop the executor; after a failure, without starting the waiting units."""
        ...

    def map(
        self,
        function: Callable[[Unit], Result],
        units: Sequence[Unit],
        progress: Progress,
        size: Callable[[Unit], int],
    ) -> Iterator[Result]:
        """Yield function(unit) for each unit, in order.

        Progress advances by size(unit) as units finish.

        An exception of a unit is raised here and ends the iteration.
        """
        ...


class RemoteBackend(Protocol[Handle]):
    """Remote execution of units. A handle represents a unit that was handed out.

    jobs, at_once: as for `Executor`.
    """

    jobs: int
    at_once: int

    def submit(self, function: Callable[[Any], Any], unit: Any) -> Handle:
        """Start function(unit) and return its handle."""
        ...

    def done(self, handles: Sequence[Handle]) -> Iterable[Handle]:
        """Wait until at least one unit is done; return the handles of those that are."""
        ...

    def result(self, handle: Handle) -> Any:
        """Return the result of a unit that is done; raise the exception that it raised."""
        ...


def results_in_order(
    backend: RemoteBackend[Handle],
    function: Callable[[Unit], Result],
    units: Sequence[Unit],
    progress: Progress,
    size: Callable[[Unit], int],
) -> Iterator[Result]:
    """Yield function(unit) for each unit, in order, executed by `backend`.

    Progress advances by size(unit) as units finish. Some units are handed out ahead, which keeps
    processes from waiting for a long unit of another. The number of results that wait for their
    turn is bounded by AHEAD per process. A unit that fails ends the iteration at once. If `at_once`
    is less than `jobs`, only that many units are handed out at a time.
    """
    most = WAITING * backend.jobs if backend.at_once >= backend.jobs else backend.at_once
    running: dict[Handle, int] = {}
    results: dict[int, Result] = {}
    given = 0
    for taken in range(len(units)):
        while taken not in results:
            while given < len(units) and len(running) < most and given - taken < AHEAD * backend.jobs:
                running[backend.submit(function, units[given])] = given
                given += 1
            for handle in backend.done(list(running)):
                number = running.pop(handle)
                results[number] = backend.result(handle)
                progress.advance(size(units[number]))
        yield results.pop(taken)


def worker_count(jobs: int, points: int) -> int:
    """Return the number of processes: `jobs`, or for 0 one per core if there are enough points."""
    if jobs:
        return jobs
    return min(os.cpu_count() or 1, max(1, points // POINTS_WORTH_A_PROCESS))


def _begin_worker(compile_messages: int) -> None:
    """Ignore SIGINT, because the builder stops its workers.

    End this worker if the builder is killed.
    compile_messages: level of messages on compilation in the builder, which may print its own.
    """
    _COMPILING.setLevel(compile_messages)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})  # blocked since the process started
    threading.Thread(target=_end_with_builder, daemon=True).start()


def _end_with_builder() -> None:
    """Wait for the builder to end, then exit.

    Otherwise a worker would wait for its next unit forever and keep its memory.
    """
    builder = multiprocessing.parent_process()
    if builder is not None:
        builder.join()
        os._exit(1)


class ProcessExecutor:
    """Map a picklable function over work units in child processes; one job starts none."""

    def __init__(self, jobs: int) -> None:
        """Start `jobs` processes, or none for a single job."""
        self.jobs = jobs
        self.at_once = jobs
        # Spawn, not fork: a fork copies locks that other threads hold, such as those of a progress
        # bar.
        context = multiprocessing.get_context("spawn")
        level = (_COMPILING.level,)
        self._pool = (
            ProcessPoolExecutor(jobs, mp_context=context, initializer=_begin_worker, initargs=level)
            if jobs > 1
            else None
        )

    def __enter__(self) -> Self:
        """Return the executor itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Stop the processes.

        After a failure the waiting units are not started; after an interrupt the processes end at
        once.
        """
        if self._pool is None:
            return
        if kind is not None and not issubclass(kind, Exception):
            # The running units are repeated later. A unit may take a minute, too long to wait after
            # Ctrl-C.
            for process in list((self._pool._processes or {}).values()):
                process.terminate()
        self._pool.shutdown(wait=True, cancel_futures=kind is not None)

    def map(
        self,
        function: Callable[[Unit], Result],
        units: Sequence[Unit],
        progress: Progress,
        size: Callable[[Unit], int],
    ) -> Iterator[Result]:
        """Yield the results, as `Executor` and `results_in_order` describe."""
        if self._pool is None:
            for unit in units:
                check_interrupt()
                result = function(unit)
                check_interrupt()
                yield result
                progress.advance(size(unit))
            return
        yield from results_in_order(self, function, units, progress, size)

    def submit(self, function: Callable[[Unit], Result], unit: Unit) -> Future[Result]:
        """Submit a unit, as `RemoteBackend` describes."""
        assert self._pool is not None
        with _worker_deaths(), blocking_sigint():
            return self._pool.submit(function, unit)

    def done(self, handles: Sequence[Future[Any]]) -> Iterable[Future[Any]]:
        """Wait until units are done, as `RemoteBackend` describes."""
        while True:
            check_interrupt()
            if done := wait(handles, ASK_SECONDS, FIRST_COMPLETED).done:
                return done

    def result(self, handle: Future[Any]) -> Any:
        """Return the result of a unit, as `RemoteBackend` describes."""
        with _worker_deaths():
            return handle.result()


@contextmanager
def _worker_deaths() -> Iterator[None]:
    """Convert the error of a worker that died to a SolidcloudError that says what to do."""
    try:
        yield
    except BrokenProcessPool:
        check_interrupt()  # a signal to the whole process group also ends the workers
        raise SolidcloudError(
            "a worker process ended abruptly: out of memory, or an error that cannot be sent here? give fewer "
            "--jobs or a smaller --memory; the same command resumes the build"
        ) from None


def voxel_ranges(points: NDArray[np.int64], jobs: int) -> list[range]:
    """Cut rows, of `points` points each, into ranges of similar numbers of points, largest first.

    A range exceeds the planned size by at most one row. Which rows are in which range depends on
    `jobs`; results must not.
    """
    if not len(points):
        return []
    ends = np.cumsum(points)
    planned = max(_MIN_POINTS, int(ends[-1]) // (_RANGES_A_JOB * jobs))
    starts = np.flatnonzero(np.diff((ends - points) // planned, prepend=-1))
    cuts = [*starts.tolist(), len(points)]
    runs = [range(a, b) for a, b in pairwise(cuts)]
    return sorted(runs, key=lambda run: -int(points[run.start : run.stop].sum()))


def jobs_of(executor: Executor | None) -> int:
    """Return the number of units that run at a time."""
    return executor.jobs if executor else 1


def run_units(
    executor: Executor | None,
    function: Callable[[Unit], Result],
    units: Sequence[Unit],
    progress: Progress,
    size: Callable[[Unit], int],
) -> Iterator[Result]:
    """Yield the results of `Executor.map`; without an executor run the units in this process."""
    if executor:
        yield from executor.map(function, units, progress, size)
        return
    for unit in units:
        yield function(unit)
        progress.advance(size(unit))
