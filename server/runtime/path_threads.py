"""Threads of a scene that compute parts of paths, round-robin over clients."""

import threading
from collections import OrderedDict, deque
from collections.abc import Callable
from concurrent.futures import Executor, Future
from typing import Any

from ...schemas.errors import BadRequestError
from .threads import start_thread

_Work = tuple[Future[Any], Callable[..., Any], tuple[Any, ...]]


class PathThreads:
    """Queues of clients' path parts, computed in order, one a client at a time. Thread-safe."""

    def __init__(self, scene: str, count: int) -> None:
        """Make the queues without threads; `start` or the first part starts the threads.

        scene: name of the scene, for messages.  count: number of threads.
        """
        self._scene, self._count = scene, count
        self._queues: OrderedDict[str, deque[_Work]] = OrderedDict()  # the client whose turn is next first
        self._changed = threading.Condition()
        self._threads: list[threading.Thread] = []
        self._closed = False

    def start(self) -> None:
        """Start the threads that do not run yet; they inherit the calling thread's priority."""
        with self._changed:
            while len(self._threads) < self._count and not self._closed:
                self._threads.append(start_thread(f"{self._scene}-path", self._run))

    def of(self, client: str) -> Executor:
        """Return the executor for the parts of this client's paths."""
        return _OfClient(self, client)

    def submit(self, client: str, run: Callable[..., Any], arguments: tuple[Any, ...]) -> Future[Any]:
        """Queue a part until its client's turn comes. Raise BadRequestError once closed."""
        self.start()
        future: Future[Any] = Future()
        with self._changed:
            if self._closed:
                raise BadRequestError(f"{self._scene}: closed during a path request: open it again")
            self._queues.setdefault(client, deque()).append((future, run, arguments))
            self._changed.notify()
        return future

    def close(self) -> None:
        """Cancel the waiting parts, and wait for those that are being computed."""
        with self._changed:
            self._closed = True
            waiting = [work for queue in self._queues.values() for work in queue]
            self._queues.clear()
            self._changed.notify_all()
        for future, _, _ in waiting:
            future.cancel()
        for thread in self._threads:
            thread.join()

    def _next(self) -> _Work | None:
        """Wait for the next part; return None once closed."""
        with self._changed:
            while not (self._queues or self._closed):
                self._changed.wait()
            if self._closed:
                return None
            client, queue = self._queues.popitem(last=False)
            work = queue.popleft()
            if queue:
                self._queues[client] = queue
            return work

    def _run(self) -> None:
        """Compute parts until closed. Runs in a thread."""
        while self._compute_next():
            pass

    def _compute_next(self) -> bool:
        """Compute one part; return False once closed.

        A separate function, so that no reference to the part remains while waiting for the next.
        """
        work = self._next()
        if work is None:
            return False
        _compute(*work)
        return True


def _compute(future: Future[Any], run: Callable[..., Any], arguments: tuple[Any, ...]) -> None:
    """Compute one part, unless it was cancelled."""
    if not future.set_running_or_notify_cancel():
        return
    try:
        found = run(*arguments)
    except BaseException as error:  # raised where the part's result is read
        future.set_exception(error)
    else:
        future.set_result(found)


class _OfClient(Executor):
    """Executor of the parts of one client's path."""

    def __init__(self, threads: PathThreads, client: str) -> None:
        self._threads, self._client = threads, client

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Queue a part for computation."""
        assert not kwargs, "a part has no named arguments"
        return self._threads.submit(self._client, fn, args)
