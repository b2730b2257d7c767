"""Execution of pure work units on a dask cluster, existing or started here.

This module is the only user of distributed.

dask decides which worker runs a unit, what happens when a worker dies, and how often a unit is
retried. A unit is pure and writes under a unique temporary name, so a unit that is killed or runs
twice does not change the result. Results are in the order of the units, as in `executor.py`.
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

from ...schemas.errors import BadRequestError, SolidcloudError
from ...schemas.runtime.interrupts import blocking_sigint, check_interrupt
from ..build_limits import CLUSTER_WORKER_KILLED, cluster_worker_limit
from .executor import ASK_SECONDS, Progress, Result, Unit, results_in_order
from .software_versions import software_versions

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

# Time limit for a scheduler to answer and to show its first worker.
REACH_SECONDS = 10
# A build fails if its cluster has no worker for this long [s]. A batch system may take a while to
# replace workers; dask takes a second. A worker that is killed while it starts dask is not always
# restarted.
LONELY_SECONDS, LONELY_LOCAL_SECONDS = 300, 60
# How often a wait for a unit checks whether any worker exists and whether the builder is
# interrupted.
LOOK_SECONDS = 5.0

LOCAL = "local:"
_START_WORKERS = "start its workers as `dask worker tcp://HOST:PORT --nthreads 1 --nworkers N`"


def local_workers(address: str) -> int | None:
    """Return N of "local:N" and None of "tcp://HOST:PORT".

    Raise BadRequestError for anything else.
    """
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
    """Run one unit, pickled with its function, in a worker.

    The worker may have joined after the initial check of the workers. It is therefore checked here
    too.
    """
    worker = get_worker()
    try:
        _check_worker(worker.address, software_versions(), expected, worker.state.nthreads)
    except BadRequestError as error:
        raise SolidcloudError(str(error)) from None  # no BadRequestError: the request is valid
    try:
        # Relative paths must mean the same as in the builder. A worker runs one unit at a time, so
        # no other unit is affected.
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
    """Return the software and the number of threads of a worker.

    The builder calls this before it hands out work.
    """
    return software_versions(), dask_worker.state.nthreads


def _check_worker(address: str, found: dict[str, str], expected: dict[str, str], threads: int) -> None:
    """Refuse a worker that has several threads, or other software, which may write other bytes."""
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
    """Map a picklable function over work units on dask workers.

    It is a context manager, like `executor.Executor`.

    jobs: number of workers at construction; workers may come and go later.  at_once: see
    `Executor`.
    """

    def __init__(
        self, address: str, memory_bytes: int = 2 << 30, say: Callable[[str], None] | None = None
    ) -> None:
        """Reach the scheduler at `address`, or start N workers here for "local:N".

        memory_bytes: memory of the N workers together; the workers of a scheduler have their own
        limits.
        say: receives the dashboard's address; standard error by default.
        Raise BadRequestError if the scheduler cannot be reached, or if a worker's software or
        number of threads differs from what the builder requires; the error names the worker.
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
        """Wait for the workers and check each; return their number."""
        address = self._address
        try:
            # Workers started here first load Python, which takes a while on a busy machine.
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
            _check_worker(worker, found, software_versions(), threads)
        return max(1, len(looks))  # workers seen before may be gone

    def _say_dashboard(self) -> None:
        """Report the dashboard's address.

        Without bokeh, a cluster started here has no dashboard.
        """
        if self._cluster is not None and importlib.util.find_spec("bokeh") is None:
            self._say(
                f"cluster: {self.jobs} workers; no dashboard, because bokeh is not installed: pip install bokeh"
            )
        else:
            self._say(f"cluster: {self.jobs} workers; dashboard {self._client.dashboard_link}")

    def __enter__(self) -> "ClusterExecutor":
        """Return the executor itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Cancel the waiting units and stop what was started here.

        Units that workers of an external scheduler are running continue to their end.
        """
        self._close()

    def _close(self) -> None:
        self._watch.closing = True
        self._take_back()
        self._client.close()
        if self._cluster is not None:
            self._cluster.close()

    def _take_back(self) -> None:
        """Cancel all units whose results have not been fetched."""
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
        """Yield the results as `Executor.map` does; cancel waiting units at the end.

        Raise SolidcloudError if the cluster is lost, or if a unit's worker died at every attempt.
        """
        try:
            yield from results_in_order(self, function, units, progress, size)
        finally:
            self._take_back()

    def submit(self, function: Callable[[Unit], Result], unit: Unit) -> Future:
        """Submit a unit, as `RemoteBackend` describes.

        The unit is not `pure` in dask's sense: an equal unit must run again.
        """
        # dask would search an unpickled unit for tasks, through all its keys.
        work = pickle.dumps((function, unit))
        future = self._client.submit(
            _run_unit, work, software_versions(), os.getcwd(), pure=False, key=_key(function)
        )
        self._given.add(future)
        return future

    def done(self, handles: Sequence[Future]) -> Iterable[Future]:
        """Wait until units are done, as `RemoteBackend` describes."""
        with self._client.as_current():
            return self._patiently(
                lambda: wait(list(handles), timeout=ASK_SECONDS, return_when="FIRST_COMPLETED").done
            )

    def result(self, handle: Future) -> Any:
        """Return the result of a unit, as `RemoteBackend` describes."""
        try:
            # If a worker dies before its result is fetched, dask runs the unit again.
            result = self._patiently(lambda: handle.result(timeout=ASK_SECONDS), handle)
        except KilledWorker as error:
            raise SolidcloudError(
                f"a unit's worker died {error.allowed_failures + 1} times, last {error.last_worker.address}: "
                "out of memory? give a larger --memory or fewer workers, or look at its log"
            ) from None
        self._given.discard(handle)  # the worker forgets the result with the last reference
        return result

    def _patiently(self, ask: Callable[[], Answer], future: Future | None = None) -> Answer:
        """Retry `ask` after each timeout for as long as the cluster has workers.

        future: the awaited future, if its function may itself raise TimeoutError.
        """
        alone_since: float | None = None
        looked = time.monotonic()
        while True:
            check_interrupt()
            try:
                return ask()
            except (FutureCancelledError, FuturesCancelledError):
                check_interrupt()  # the cluster's processes may have received the signal too
                raise SolidcloudError(
                    f"{self._address}: the scheduler was lost, expected it to last as long as the build: start it, "
                    "then give the same command again to resume"
                ) from None
            except TimeoutError:
                # Either the wait timed out, or the function itself raised TimeoutError and the
                # future is done.
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
                    f"{self._address}: no worker left for {patience} s: start some, then give the same command again "
                    "to resume"
                )


def _key(function: Callable[..., object]) -> str:
    """Return a unique key for a unit; the dashboard groups units by the part before the dash."""
    inner = function.func if isinstance(function, functools.partial) else function
    return f"{getattr(inner, '__name__', 'unit')}-{os.urandom(16).hex()}"


def _say(text: str) -> None:
    """Print to standard error.

    The stream is looked up each time, because progress bars on a terminal replace it by their own.
    """
    print(text, file=sys.stderr, flush=True)


class _Watch(SchedulerPlugin):
    """Plugin that reports the death of a worker started here.

    dask itself starts another worker and runs the units again without a message.
    """

    def __init__(self, say: Callable[[str], None]) -> None:
        self.say = say
        self.closing = False

    def remove_worker(self, scheduler: Scheduler, worker: str, *, stimulus_id: str, **_: object) -> None:
        """Report a removed worker; the scheduler calls this in its own thread."""
        if not self.closing:
            self.say(f"cluster: worker {worker} died; its units are run again")


def dask_setup(_: Worker) -> None:
    """Ignore SIGINT in a worker; dask calls this in each worker started here."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _start_local(number: int, memory_bytes: int, watch: _Watch) -> LocalCluster:
    """Start a scheduler in this process and `number` single-threaded workers on the loopback."""
    settings = dask.config.set(
        {
            # Results are small. A worker over its limit is killed; a paused worker would wait
            # forever.
            "distributed.worker.memory.target": False,
            "distributed.worker.memory.spill": False,
            "distributed.worker.memory.pause": False,
            "distributed.worker.memory.terminate": CLUSTER_WORKER_KILLED,
        }
    )
    with settings, blocking_sigint():
        return LocalCluster(
            n_workers=number,
            threads_per_worker=1,
            processes=True,
            host="127.0.0.1",
            dashboard_address="127.0.0.1:0",
            memory_limit=cluster_worker_limit(number, memory_bytes),
            preload=[__name__],
            scheduler_kwargs={"plugins": [watch]},
            # The builder reports a failed unit in one line; dask would also print its call stack.
            silence_logs=logging.CRITICAL,
        )


def _reach(address: str) -> Client:
    """Connect a client to the scheduler at `address`."""

    async def knock() -> None:
        (await connect(address, timeout=REACH_SECONDS)).abort()

    try:
        # A Client that cannot reach a scheduler takes 20 s more to be discarded. Try a bare
        # connection first.
        asyncio.run(knock())
        return Client(address, timeout=REACH_SECONDS, set_as_default=False)
    except (OSError, ValueError) as error:
        raise BadRequestError(
            f"--scheduler {address}: no dask scheduler answers within {REACH_SECONDS} s ({error}): start one with "
            "`dask scheduler`, or give --cluster local:N"
        ) from None
