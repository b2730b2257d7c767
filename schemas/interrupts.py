"""Interrupts: SIGINT (Ctrl-C) and SIGTERM are noted when they come, and raised where the work can stop.

Python raises KeyboardInterrupt at any instruction. Inside a library's callback it comes out as that library's error
(lazrs: 11 of 16 times), inside an error handler it hides the error, inside a `finally` it leaves something undone. In
a block of `taken` a signal sets a flag instead. Long work calls `check` between blocks, voxels, files and units, and
`check` raises Interrupted. Whatever else ends the block once the flag is set is an interrupt too, never a fault of a
file.
"""

import contextlib
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator

# Code that reaches no `check` for so long [s] is interrupted where it is: compilation, or a library that reads a whole
# file in one call. Then it is tried again, in case a library swallowed the exception, and soon where Python did.
GRACE_SECONDS, AGAIN_SECONDS, SOON_SECONDS = 1.0, 5.0, 0.02

_SIGNALS = (signal.SIGINT, signal.SIGTERM)


class Interrupted(KeyboardInterrupt):
    """The work was interrupted. The text says what is left of it, where that is known."""


class _State:
    """What this process knows of its interrupt.

    taken: in a block of `taken`.  held: blocks of `kept_back` in it.  since: when the first signal came
    (time.monotonic); None before.
    """

    taken = False
    held = 0
    since: float | None = None


def came() -> bool:
    """Return whether a signal has come in the block of `taken`."""
    return _State.since is not None


def check() -> None:
    """Raise Interrupted once a signal has come; cheap, for any thread, and harmless outside `taken`."""
    if _State.since is not None:
        leave()
        raise Interrupted


def leave() -> None:
    """Stop the timer that insists: the stack is being left, and what tidies up is not to be interrupted."""
    signal.setitimer(signal.ITIMER_REAL, 0)


@contextlib.contextmanager
def taken() -> Iterator[None]:
    """Note SIGINT and SIGTERM in this block, for `check`; end it by Interrupted if one came, whatever else ends it.

    A signal that is ignored stays ignored, as under nohup. A further signal after GRACE_SECONDS raises at once. A block
    within a block, and one outside the main thread, where Python runs no handlers, changes nothing.
    """
    if _State.taken or threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.getsignal(number) for number in _SIGNALS}
    alarm, unraisable = signal.getsignal(signal.SIGALRM), sys.unraisablehook
    _State.taken = True
    try:
        for number, handler in before.items():
            if handler not in (signal.SIG_IGN, None):
                signal.signal(number, _note)
        try:
            yield
        except Exception as error:
            if came():
                raise Interrupted from error
            raise
        check()
    finally:
        if came():
            leave()
            signal.signal(signal.SIGALRM, alarm)
            sys.unraisablehook = unraisable
        for number, handler in before.items():
            if handler is not None:
                signal.signal(number, handler)
        _State.taken, _State.since = False, None


def _note(number: int, frame: object) -> None:
    """Handle SIGINT and SIGTERM: set the flag; raise where it has been set for long."""
    now = time.monotonic()
    if _State.since is None:
        _State.since = now
        signal.signal(signal.SIGALRM, _insist)
        sys.unraisablehook = _swallowed
        signal.setitimer(signal.ITIMER_REAL, GRACE_SECONDS, AGAIN_SECONDS)
    elif now - _State.since >= GRACE_SECONDS and not _State.held:
        raise Interrupted


def _insist(number: int, frame: object) -> None:
    """Handle the timer that a signal starts: nobody has checked for long."""
    if not _State.held:
        raise Interrupted


def _swallowed(what: "sys.UnraisableHookArgs") -> None:
    """Insist again soon where Python has to drop an exception, as in a callback of an import; tell of others."""
    if what.exc_type is Interrupted:
        signal.setitimer(signal.ITIMER_REAL, SOON_SECONDS, AGAIN_SECONDS)
    else:
        sys.__unraisablehook__(what)


@contextlib.contextmanager
def kept_back() -> Iterator[Callable[[], None]]:
    """Let SIGINT and SIGTERM raise when the block ends, or when what is yielded is called, and not between.

    For calls of libraries that call Python back: raised in a callback of HDF5, a KeyboardInterrupt came out as a
    SystemError, or not at all. In a block of `taken`, `check` raises here too, where Python code of ours calls it.
    Outside `taken` the handlers run then, whatever they do. Outside the main thread, where Python runs no handlers,
    nothing is done.
    """
    if threading.current_thread() is not threading.main_thread():
        yield lambda: None
        return
    if _State.taken:
        _State.held += 1
        try:
            yield check
        finally:
            _State.held -= 1
            check()
        return
    waiting: list[int] = []
    before = {number: signal.getsignal(number) for number in _SIGNALS}
    for number, handler in before.items():
        if callable(handler):
            signal.signal(number, lambda number, _: waiting.append(number))

    def deliver() -> None:
        """Run the handlers of what came."""
        while waiting:
            number = signal.Signals(waiting.pop(0))
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


@contextlib.contextmanager
def children_ignore() -> Iterator[None]:
    """Let processes started in this block begin with SIGINT blocked: Ctrl-C reaches a terminal's whole group.

    A worker that is still loading Python would print a traceback. One that comes in the block waits for its end.
    """
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
