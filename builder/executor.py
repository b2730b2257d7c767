"""Runs pure work units: in this process, in a pool of processes, or on a cluster. Results come in the units' order."""

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from types import TracebackType
from typing import Any, Protocol, Self, TypeVar

from ..schemas.errors import SolidcloudError
from ..schemas.interrupts import check, children_ignore
from .config import BuildConfig
from .progress import Progress

Unit = TypeVar("Unit")
Result = TypeVar("Result")
Ticket = TypeVar("Ticket")

# Below this many points a second process costs more (1 to 2 s to start and to load the kernels) than it saves.
POINTS_WORTH_A_PROCESS = 4_000_000
# Units handed out and not done, and results that wait for those before them, a process.
WAITING, AHEAD = 4, 64
# How often whoever waits for a unit looks whether it is interrupted.
ASK_SECONDS = 0.1


class Executor(Protocol):
    """Maps a picklable function over work units. A context manager.

    jobs: units that run at a time.  at_once: so many that do, where that is fewer, for want of memory.
    """

    jobs: int
    at_once: int

    def __enter__(self) -> Self:
        """The executor itself."""
        ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Stop; after a failure, without starting what still waits."""
        ...

    def map(
        self,
        function: Callable[[Unit], Result],
        units: Sequence[Unit],
        progress: Progress,
        size: Callable[[Unit], int],
    ) -> Iterator[Result]:
        """function(unit) for each unit, in order; progress advances by size(unit) as units are done.

        What a unit raises is raised here, and ends all.
        """
        ...


class Hands(Protocol[Ticket]):
    """Who does units somewhere else. A ticket stands for a unit that was handed out.

    jobs, at_once: as of `Executor`.
    """

    jobs: int
    at_once: int

    def hand_out(self, function: Callable[[Any], Any], unit: Any) -> Ticket:
        """Have function(unit) done."""
        ...

    def done(self, tickets: Sequence[Ticket]) -> Iterable[Ticket]:
        """Those of the tickets whose units are done, once one is."""
        ...

    def result(self, ticket: Ticket) -> Any:
        """The result of a unit that is done; raises what it raised."""
        ...


def results_in_order(
    hands: Hands[Ticket],
    function: Callable[[Unit], Result],
    units: Sequence[Unit],
    progress: Progress,
    size: Callable[[Unit], int],
) -> Iterator[Result]:
    """function(unit) for each unit, in order, done by others; progress advances by size(unit) as each is done.

    Some units are handed out ahead, so that no process waits for another's long one; results that wait their turn
    stay bounded by AHEAD a process. A unit that fails ends all when it does. With `at_once` fewer than `jobs`, so
    many are handed out at a time.
    """
    most = WAITING * hands.jobs if hands.at_once >= hands.jobs else hands.at_once
    running: dict[Ticket, int] = {}
    results: dict[int, Result] = {}
    given = 0
    for taken in range(len(units)):
        while taken not in results:
            while given < len(units) and len(running) < most and given - taken < AHEAD * hands.jobs:
                running[hands.hand_out(function, units[given])] = given
                given += 1
            for ticket in hands.done(list(running)):
                number = running.pop(ticket)
                results[number] = hands.result(ticket)
                progress.advance(size(units[number]))
        yield results.pop(taken)


def worker_count(jobs: int, points: int) -> int:
    """Processes to use: as asked, or, for 0, one a core where the points are worth it."""
    if jobs:
        return jobs
    return min(os.cpu_count() or 1, max(1, points // POINTS_WORTH_A_PROCESS))


def make_executor(config: BuildConfig, jobs: int) -> Executor:
    """What runs the units: a cluster where one is named, else `jobs` processes, one of which is this one alone."""
    address = config.scheduler or config.cluster
    if address is None:
        return ProcessExecutor(jobs)
    # Loads dask, which nobody else needs.
    from .cluster import ClusterExecutor

    return ClusterExecutor(address, config.memory_bytes)


def _begin_worker() -> None:
    """Leave Ctrl-C to the builder: it stops its workers, and they say nothing. If it is killed, they end with it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})  # blocked since it was started
    threading.Thread(target=_end_with_builder, daemon=True).start()


def _end_with_builder() -> None:
    """Wait for the builder to end, and end: a worker would wait for its next unit for ever, holding its memory."""
    builder = multiprocessing.parent_process()
    if builder is not None:
        builder.join()
        os._exit(1)


class ProcessExecutor:
    """Maps a picklable function over work units in processes of its own; with one job nothing is started."""

    def __init__(self, jobs: int) -> None:
        """Use `jobs` processes."""
        self.jobs = jobs
        self.at_once = jobs
        # Spawned, not forked: a fork copies locks that other threads hold, such as a progress bar's.
        context = multiprocessing.get_context("spawn")
        self._pool = (
            ProcessPoolExecutor(jobs, mp_context=context, initializer=_begin_worker) if jobs > 1 else None
        )

    def __enter__(self) -> Self:
        """The executor itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Stop the processes; after a failure, without starting what still waits; when interrupted, at once."""
        if self._pool is None:
            return
        if kind is not None and not issubclass(kind, Exception):
            # What they were doing is done again: a unit may take a minute, and who pressed Ctrl-C waits.
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
        """See `Executor`, and `results_in_order`."""
        if self._pool is None:
            for unit in units:
                check()
                result = function(unit)
                check()
                yield result
                progress.advance(size(unit))
            return
        yield from results_in_order(self, function, units, progress, size)

    def hand_out(self, function: Callable[[Unit], Result], unit: Unit) -> Future[Result]:
        """See `Hands`."""
        assert self._pool is not None
        with _worker_deaths(), children_ignore():
            return self._pool.submit(function, unit)

    def done(self, tickets: Sequence[Future[Any]]) -> Iterable[Future[Any]]:
        """See `Hands`."""
        while True:
            check()
            if done := wait(tickets, ASK_SECONDS, FIRST_COMPLETED).done:
                return done

    def result(self, ticket: Future[Any]) -> Any:
        """See `Hands`."""
        with _worker_deaths():
            return ticket.result()


@contextmanager
def _worker_deaths() -> Iterator[None]:
    """Say what it may be that ended a worker, noticed when a unit is handed out or when it should be done."""
    try:
        yield
    except BrokenProcessPool:
        check()  # a signal to the whole group ends the workers too
        raise SolidcloudError(
            "a worker process ended at once: out of memory, or an error that cannot be sent here? give fewer --jobs or "
            "a smaller --memory; the same command goes on where it was"
        ) from None
