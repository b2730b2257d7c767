"""Runs pure work units on a dask cluster: one that is there, or one started here. The only user of distributed.

Who runs what, what happens when a worker dies, and how often a unit is tried again is dask's: a unit is pure, and
written under a temporary name of its own, so that one which was killed half-way, or runs twice, changes nothing.
Results come in the order of the units, as from `executor.py`.
"""

import asyncio
import functools
import importlib.util
import logging
import os
import pickle
import signal
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, TypeVar

from ..schemas.errors import BadRequestError, SolidcloudError
from ..schemas.interrupts import check, children_ignore
from .executor import ASK_SECONDS, Result, Unit, results_in_order
from .memory import CLUSTER_WORKER_KILLED, cluster_worker_limit
from .progress import Progress
from .software import software

try:
    import dask
    from distributed import (
        Client,
        Future,
        KilledWorker,
        LocalCluster,
        Scheduler,
        SchedulerPlugin,
        Worker,
        get_worker,
        wait,
    )
    from distributed.client import FutureCancelledError, FuturesCancelledError
    from distributed.comm.core import connect
except ModuleNotFoundError as missing:
    raise SolidcloudError(
        f"--scheduler and --cluster: the library {missing.name!r} is not installed: pip install 'solidcloud[cluster]'"
    ) from None

Answer = TypeVar("Answer")

# For a scheduler to answer, and to show its first worker.
REACH_SECONDS = 10
# A cluster without any worker for so long is given up: a batch system may take a while to start others in their place,
# dask a second. One that is killed while it starts dask does not always start anew.
LONELY_SECONDS, LONELY_LOCAL_SECONDS = 300, 60
# How often it is looked whether there is any worker while a unit is waited for, and whether the builder is interrupted.
LOOK_SECONDS = 5.0

LOCAL = "local:"
_START_WORKERS = "start its workers as `dask worker tcp://HOST:PORT --nthreads 1 --nworkers N`"


def local_workers(address: str) -> int | None:
    """N of "local:N", None of "tcp://HOST:PORT"; BadRequestError for anything else."""
    if address.startswith(LOCAL):
        number = address.removeprefix(LOCAL)
        if number.isascii() and number.isdigit() and int(number):
            return int(number)
        raise BadRequestError(f"--cluster {address}: expected local:N, N worker processes, such as local:2")
    scheme, found, host = address.partition("://")
    if scheme not in ("tcp", "tls") or not (found and host):
        raise BadRequestError(
            f"--scheduler {address}: expected the address of a dask scheduler, tcp://HOST:PORT"
        )
    return None


def _run_unit(work: bytes, expected: dict[str, str], folder: str) -> Any:
    """Run one unit, pickled with its function, in a worker, which may have joined since the others were looked at."""
    worker = get_worker()
    try:
        _check_worker(worker.address, software(), expected, worker.state.nthreads)
    except BadRequestError as error:
        raise SolidcloudError(str(error)) from None  # what was asked for was possible when the build began
    try:
        # Relative paths mean what they mean to the builder. A worker runs one unit at a time, so nobody else is moved.
        if os.getcwd() != folder:
            os.chdir(folder)
    except OSError as error:
        raise SolidcloudError(
            f"worker {worker.address}: no folder {folder} ({error.strerror}), expected the builder's: all workers need "
            "the same files under the same paths"
        ) from None
    function, unit = pickle.loads(work)
    return function(unit)


def _look(dask_worker: Worker) -> tuple[dict[str, str], int]:
    """What a worker runs, and how many units at a time; asked of each before any work is handed out."""
    return software(), dask_worker.state.nthreads


def _check_worker(address: str, found: dict[str, str], expected: dict[str, str], threads: int) -> None:
    """Refuse a worker whose bytes could be others, or that would run units side by side in one process."""
    for name, version in expected.items():
        if found.get(name) != version:
            raise BadRequestError(
                f"worker {address}: {name} {found.get(name, 'missing')}, expected {version} as the builder has: "
                "install the same there, and start the worker again"
            )
    if threads != 1:
        raise BadRequestError(
            f"worker {address}: {threads} threads, expected one, as HDF5 takes one call at a time: {_START_WORKERS}"
        )


class ClusterExecutor:
    """Maps a picklable function over work units on dask workers. A context manager, like `executor.Executor`.

    jobs: workers, as they were when this was made; others may come and go.  at_once: see `Executor`.
    """

    def __init__(
        self, address: str, memory_bytes: int = 2 << 30, say: Callable[[str], None] | None = None
    ) -> None:
        """Reach the scheduler at `address`, or start N workers here for "local:N".

        memory_bytes: what N workers may hold together; those of a scheduler have limits of their own.  say: told the
        dashboard's address; standard error where left out.  Raises BadRequestError for a scheduler that is not there
        and for workers that are not as the builder is, naming them.
        """
        number = local_workers(address)
        self._say = say or _say
        self._watch = _Watch(self._say)
        self._cluster = None if number is None else _start_local(number, memory_bytes, self._watch)
        self._given: set[Future] = set()
        self._address = address if self._cluster is None else self._cluster.scheduler_address
        try:
            self._client = _reach(self._address)
        except BaseException:
            if self._cluster is not None:
                self._cluster.close()
            raise
        try:
            self.jobs = self.at_once = self._check_workers(number)
            self._say_dashboard()
        except BaseException:
            self._close()
            raise

    def _check_workers(self, number: int | None) -> int:
        """Wait for the workers and look at each; returns how many there are."""
        address = self._address
        try:
            # Those started here load Python first: on a busy machine that takes a while.
            self._client.wait_for_workers(number or 1, REACH_SECONDS if number is None else 60)
        except TimeoutError:
            raise BadRequestError(
                f"{address}: the scheduler has no worker, expected at least one: {_START_WORKERS}"
            ) from None
        try:
            looks = self._client.run(_look)
        except ModuleNotFoundError as error:
            raise BadRequestError(
                f"{address}: a worker has no {error.name}: install solidcloud, the same version, where workers run"
            ) from None
        for worker, (found, threads) in looks.items():
            _check_worker(worker, found, software(), threads)
        return max(1, len(looks))  # those that were seen may be gone

    def _say_dashboard(self) -> None:
        """Where to watch the cluster; one started here has nothing to show without bokeh."""
        if self._cluster is not None and importlib.util.find_spec("bokeh") is None:
            self._say(
                f"cluster: {self.jobs} workers; no dashboard, for bokeh is not installed: pip install bokeh"
            )
        else:
            self._say(f"cluster: {self.jobs} workers; dashboard {self._client.dashboard_link}")

    def __enter__(self) -> "ClusterExecutor":
        """The executor itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Take back what waits, and stop what was started here. What others' workers run just now runs to its end."""
        self._close()

    def _close(self) -> None:
        self._watch.closing = True
        self._take_back()
        self._client.close()
        if self._cluster is not None:
            self._cluster.close()

    def _take_back(self) -> None:
        """Cancel whatever was handed out and not taken."""
        if self._given and self._client.status == "running":
            self._client.cancel(list(self._given), force=True)
        self._given.clear()

    def map(
        self,
        function: Callable[[Unit], Result],
        units: Sequence[Unit],
        progress: Progress,
        size: Callable[[Unit], int],
    ) -> Iterator[Result]:
        """See `Executor`, and `results_in_order` in executor.py; what waits is cancelled in the end, however that is.

        SolidcloudError where the cluster is lost, or a unit's worker died each time it was tried.
        """
        try:
            yield from results_in_order(self, function, units, progress, size)
        finally:
            self._take_back()

    def hand_out(self, function: Callable[[Unit], Result], unit: Unit) -> Future:
        """See `Hands`. Not `pure` in dask's sense: the same unit asked for again is to be done again."""
        work = pickle.dumps((function, unit))  # dask would look into a unit for tasks, through all its keys
        future = self._client.submit(_run_unit, work, software(), os.getcwd(), pure=False, key=_key(function))
        self._given.add(future)
        return future

    def done(self, tickets: Sequence[Future]) -> Iterable[Future]:
        """See `Hands`."""
        with self._client.as_current():
            return self._patiently(
                lambda: wait(list(tickets), timeout=ASK_SECONDS, return_when="FIRST_COMPLETED").done
            )

    def result(self, ticket: Future) -> Any:
        """See `Hands`."""
        try:
            # A worker that dies before its result is fetched has it made again.
            result = self._patiently(lambda: ticket.result(timeout=ASK_SECONDS), ticket)
        except KilledWorker as error:
            raise SolidcloudError(
                f"a unit's worker died {error.allowed_failures + 1} times, at last {error.last_worker.address}: "
                "out of memory? give a larger --memory or fewer workers, or look at its log"
            ) from None
        self._given.discard(ticket)  # the worker forgets the result with the last reference
        return result

    def _patiently(self, ask: Callable[[], Answer], future: Future | None = None) -> Answer:
        """Ask again for as long as there is anybody to give an answer. future: what is asked, where it may raise."""
        alone_since: float | None = None
        looked = time.monotonic()
        while True:
            check()
            try:
                return ask()
            except (FutureCancelledError, FuturesCancelledError):
                check()  # its processes may have had the signal too
                raise SolidcloudError(
                    f"{self._address}: the scheduler was lost, expected it to last as long as the build: start it, "
                    "then the same command again goes on where it was"
                ) from None
            except TimeoutError:
                # Of waiting; or of the function itself, which then has been heard.
                if future is not None and future.status == "error":
                    raise
            if time.monotonic() - looked < LOOK_SECONDS:
                continue
            looked = time.monotonic()
            if self._client.scheduler_info(n_workers=-1)["workers"]:
                alone_since = None
                continue
            alone_since = alone_since or time.monotonic()
            patience = LONELY_SECONDS if self._cluster is None else LONELY_LOCAL_SECONDS
            if time.monotonic() - alone_since > patience:
                raise SolidcloudError(
                    f"{self._address}: no worker left for {patience} s: start some, then the same command again goes "
                    "on where it was"
                )


def _key(function: Callable[..., object]) -> str:
    """A name nobody else has; the dashboard groups by what stands before the dash."""
    inner = function.func if isinstance(function, functools.partial) else function
    return f"{getattr(inner, '__name__', 'unit')}-{os.urandom(16).hex()}"


def _say(text: str) -> None:
    """Where nobody else listens. The stream is asked for each time: bars on a terminal put their own in its place."""
    print(text, file=sys.stderr, flush=True)


class _Watch(SchedulerPlugin):
    """Says of a worker started here that it died: dask starts another and runs the units again, and is silent then."""

    def __init__(self, say: Callable[[str], None]) -> None:
        self.say = say
        self.closing = False

    def remove_worker(self, scheduler: Scheduler, worker: str, *, stimulus_id: str, **_: object) -> None:
        """Called by the scheduler, in its thread."""
        if not self.closing:
            self.say(f"cluster: worker {worker} died; its units are run again")


def dask_setup(_: Worker) -> None:
    """Leave Ctrl-C to the builder, as in `executor.py`; dask calls this in each worker started here."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _start_local(number: int, memory_bytes: int, watch: _Watch) -> LocalCluster:
    """A scheduler in this process and `number` workers of one thread, all on the loopback interface alone."""
    settings = dask.config.set(
        {
            # Results are small. A worker that is over its limit is killed; paused, it would wait for ever.
            "distributed.worker.memory.target": False,
            "distributed.worker.memory.spill": False,
            "distributed.worker.memory.pause": False,
            "distributed.worker.memory.terminate": CLUSTER_WORKER_KILLED,
        }
    )
    with settings, children_ignore():
        return LocalCluster(
            n_workers=number,
            threads_per_worker=1,
            processes=True,
            host="127.0.0.1",
            dashboard_address="127.0.0.1:0",
            memory_limit=cluster_worker_limit(number, memory_bytes),
            preload=[__name__],
            scheduler_kwargs={"plugins": [watch]},
            # A unit that fails is reported here, by one line; dask would show its call stack besides.
            silence_logs=logging.CRITICAL,
        )


def _reach(address: str) -> Client:
    """A client of the scheduler at `address`."""

    async def knock() -> None:
        (await connect(address, timeout=REACH_SECONDS)).abort()

    try:
        # A Client that reached nobody takes 20 s more to be thrown away.
        asyncio.run(knock())
        return Client(address, timeout=REACH_SECONDS, set_as_default=False)
    except (OSError, ValueError) as error:
        raise BadRequestError(
            f"--scheduler {address}: no dask scheduler answers within {REACH_SECONDS} s ({error}): start one with "
            "`dask scheduler`, or give --cluster local:N"
        ) from None
