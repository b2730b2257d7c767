"""Server process: start a server for scenes, serve until a signal, stop.

The command `solidcloud serve` runs `serve`. `serving` does the same inside a `with`.
"""

import logging
import signal
import socket
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

from ..runtime.process_heap import give_back_large_blocks
from ..runtime.threads import start_thread
from ..scene_interface import ServedScene
from .request_dispatcher import RequestDispatcher
from .server_config import ServerConfig
from .transport import Transport

log = logging.getLogger(__name__)


@contextmanager
def serving(scenes: Sequence[ServedScene], config: ServerConfig) -> Iterator[RequestDispatcher]:
    """Serve scenes inside a `with`; the caller closes them afterwards.

    All scenes are warm and reachable once entered. Raise SolidcloudError if a scene or endpoint is
    not usable.
    """
    dispatcher = RequestDispatcher(scenes, config)
    dispatcher.warm()
    transport = Transport([scene.name for scene in scenes], dispatcher, config)
    try:
        with transport:
            yield dispatcher
    finally:
        dispatcher.left_at_work = transport.left_at_work


def serve(
    scenes: Sequence[ServedScene], config: ServerConfig, ready: Callable[[], object] = lambda: None
) -> bool:
    """Serve scenes until SIGTERM or SIGINT, then answer accepted requests. Main thread only.

    Return whether all requests have ended; if not, closing their scene waits for them.
    ready: called once all is warm and reachable.  SIGHUP: reload all scenes, see `Scene.reload`.
    """
    give_back_large_blocks()
    # By default, a thread in Python code may keep the interpreter's lock for 5 ms while a reply
    # waits.
    sys.setswitchinterval(0.0005)
    if config.insecure:
        log.warning("--insecure: every client that reaches %s may send requests", config.listen)
    with (
        _signalled(signal.SIGTERM, signal.SIGINT, signal.SIGHUP) as signals,
        _metrics(scenes, config),
        serving(scenes, config) as dispatcher,
        _reloader(dispatcher) as wanted,
    ):
        ready()
        print(f"serving {', '.join(scene.name for scene in scenes)} at {config.listen}", flush=True)
        while signals.recv(1)[0] == signal.SIGHUP:
            wanted.set()
    return not dispatcher.left_at_work


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
            dispatcher.reload()

    # A reload that is running at the end is abandoned when its scene closes (`Scene.close` waits).
    start_thread("reload", run)
    try:
        yield wanted
    finally:
        ended.set()
        wanted.set()


@contextmanager
def _signalled(*numbers: signal.Signals) -> Iterator[socket.socket]:
    """Replace the signals' handlers and yield a socket that becomes readable when a signal arrives.

    An event set by a handler does not suffice: the system may deliver the signal to one of zenoh's
    threads, and a main thread that waits for a lock is then not woken to run the handler.
    """
    reader, writer = socket.socketpair()
    with reader, writer:
        writer.setblocking(False)
        before = {number: signal.signal(number, lambda *_: None) for number in numbers}
        descriptor = signal.set_wakeup_fd(writer.fileno(), warn_on_full_buffer=False)
        try:
            yield reader
        finally:
            signal.set_wakeup_fd(descriptor)
            for number, handler in before.items():
                signal.signal(number, handler)
