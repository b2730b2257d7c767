"""Server process: start a server for scenes, serve until a signal, stop.

The command `solidcloud serve` runs `serve`. `serving` does the same inside a `with`.
"""

import logging
import signal
import socket
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress

from ...schemas.wire.warming_parts import READY_LINE, SERVING_WORDS
from ..runtime.process_heap import exempt_present_objects, give_back_large_blocks
from ..runtime.threads import start_loop, start_thread
from ..scene_interface import ServedScene
from .request_dispatcher import RequestDispatcher
from .server_config import ServerConfig
from .transport import Transport

log = logging.getLogger(__name__)

# How long a stop waits for the part of warming that is in work [s]. Parts that are not compiled take
# less.
_END_SECONDS = 0.5
# Interval at which a reload checks whether warming is complete [s].
_LOOK_SECONDS = 0.1


@contextmanager
def serving(scenes: Sequence[ServedScene], config: ServerConfig) -> Iterator[RequestDispatcher]:
    """Serve scenes inside a `with`; the caller closes them afterwards.

    All scenes are warm and reachable once entered. Raise SolidcloudError if a scene or endpoint is
    not usable.
    """
    dispatcher = RequestDispatcher(scenes, config)
    dispatcher.warming.run()
    with _listening(scenes, dispatcher, config):
        yield dispatcher


@contextmanager
def _listening(
    scenes: Sequence[ServedScene], dispatcher: RequestDispatcher, config: ServerConfig
) -> Iterator[None]:
    """Answer requests in a block, and those accepted at its end."""
    transport = Transport([scene.name for scene in scenes], dispatcher, config)
    try:
        with transport:
            yield
    finally:
        dispatcher.left_at_work = transport.left_at_work


def serve(
    scenes: Sequence[ServedScene], config: ServerConfig, ready: Callable[[], object] = lambda: None
) -> bool:
    """Serve scenes until SIGTERM or SIGINT, then answer accepted requests. Main thread only.

    Return whether all work has ended; if not, closing the scenes waits for it.
    ready: called once everything is warm, in any thread, unless a signal comes first.
    SIGHUP: reload all scenes, see `Scene.reload`.
    """
    give_back_large_blocks()
    # By default, a thread in Python code may keep the interpreter's lock for 5 ms while a reply
    # waits.
    sys.setswitchinterval(0.0005)
    if config.insecure:
        log.warning("--insecure: every client that reaches %s may send requests", config.listen)
    dispatcher = RequestDispatcher(scenes, config)
    warming = dispatcher.warming
    with _signalled(signal.SIGTERM, signal.SIGINT, signal.SIGHUP) as signals, _metrics(scenes, config):
        # In a thread, because a signal must be answered while kernels are compiled for many seconds.
        if not signals.come_after(warming.run_first):
            return False
        exempt_present_objects(collect=False)

        def warm_rest() -> None:
            if warming.run_rest():
                exempt_present_objects(collect=True)
                ready()
                print(READY_LINE, flush=True)

        with _listening(scenes, dispatcher, config), _reloader(dispatcher) as wanted:
            names = ", ".join(scene.name for scene in scenes)
            print(f"{SERVING_WORDS}{names} at {config.listen}", flush=True)
            rest = start_thread("warm", warm_rest)
            while signals.next() == signal.SIGHUP:
                wanted.set()
            warming.end()
        rest.join(_END_SECONDS)
        return not (dispatcher.left_at_work or rest.is_alive())


@contextmanager
def _metrics(scenes: Sequence[ServedScene], config: ServerConfig) -> Iterator[None]:
    """Serve the metrics of scenes if configured, before warming, so that errors appear early."""
    if not config.metrics_port:
        yield
        return
    from ..observability.prometheus_export import metrics_served  # its library is an extra

    with metrics_served(scenes, config.metrics_host, config.metrics_port) as where:
        log.info("metrics at %s", where)
        yield


@contextmanager
def _reloader(dispatcher: RequestDispatcher) -> Iterator[threading.Event]:
    """Run a thread that reloads all scenes when the event is set; a stop does not wait for it."""
    wanted, ended = threading.Event(), threading.Event()

    def run() -> None:
        while wanted.wait() and not ended.is_set():
            wanted.clear()
            # A reload warms too; closing its scene would wait until it has compiled everything.
            while dispatcher.warming.left and not ended.wait(_LOOK_SECONDS):
                pass
            if not ended.is_set():
                dispatcher.reload()

    # A reload that is running at the end is abandoned when its scene closes (`Scene.close` waits).
    start_loop("reload", run)
    try:
        yield wanted
    finally:
        ended.set()
        wanted.set()


class _Signals:
    """Signals that this process receives.

    An event set by a handler does not suffice: the system may deliver the signal to one of zenoh's
    threads, and a main thread that waits for a lock is then not woken to run the handler. Python
    writes the number of each signal to a socket instead.
    """

    def __init__(self, reader: socket.socket, writer: socket.socket) -> None:
        self._reader, self._writer = reader, writer

    def next(self) -> int:
        """Wait for a signal and return its number."""
        return self._reader.recv(1)[0]

    def come_after(self, work: Callable[[], object]) -> bool:
        """Do some work in a thread; return False if a signal to stop comes first.

        The work then goes on. Raise its error. `next` returns a SIGHUP that came meanwhile.
        """
        errors: list[BaseException] = []
        over = 0

        def run() -> None:
            try:
                work()
            except BaseException as error:
                errors.append(error)
            with suppress(OSError):  # nobody waits any more
                self._writer.send(bytes([over]))

        start_thread("warm", run)
        reload = False
        while (number := self.next()) != over:
            if number != signal.SIGHUP:
                return False
            reload = True
        if errors:
            raise errors[0]
        if reload:
            self._writer.send(bytes([signal.SIGHUP]))
        return True


@contextmanager
def _signalled(*numbers: signal.Signals) -> Iterator[_Signals]:
    """Replace the signals' handlers in a block, and yield the signals that come."""
    reader, writer = socket.socketpair()
    with reader, writer:
        writer.setblocking(False)
        before = {number: signal.signal(number, lambda *_: None) for number in numbers}
        descriptor = signal.set_wakeup_fd(writer.fileno(), warn_on_full_buffer=False)
        try:
            yield _Signals(reader, writer)
        finally:
            signal.set_wakeup_fd(descriptor)
            for number, handler in before.items():
                signal.signal(number, handler)
