"""Ctrl-C kept back while a library that is not ours calls Python: raised there it is lost, or another error."""

import contextlib
import signal
import threading
from collections.abc import Callable, Iterator

_SIGNALS = (signal.SIGINT, signal.SIGTERM)


@contextlib.contextmanager
def kept_back() -> Iterator[Callable[[], None]]:
    """Handlers of SIGINT and SIGTERM run when the block ends, or when what is yielded is called, and not between.

    Raised inside a callback of HDF5's, a KeyboardInterrupt came out as a SystemError, or not at all. Elsewhere than in
    the main thread, where Python runs no handlers, nothing is done.
    """
    if threading.current_thread() is not threading.main_thread():
        yield lambda: None
        return
    came: list[int] = []
    before = {number: signal.getsignal(number) for number in _SIGNALS}
    for number, handler in before.items():
        if callable(handler):
            signal.signal(number, lambda number, _: came.append(number))

    def deliver() -> None:
        """Run the handlers of what came."""
        while came:
            number = signal.Signals(came.pop())
            handler = before[number]
            if callable(handler):
                handler(number, None)

    try:
        yield deliver
    finally:
        for number, handler in before.items():
            if callable(handler):
                signal.signal(number, handler)
        deliver()
