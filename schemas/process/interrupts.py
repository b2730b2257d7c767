"""Interrupts: SIGINT (Ctrl-C) and SIGTERM set a flag; work raises Interrupted where it can stop.

Python raises KeyboardInterrupt at any instruction. Inside a library's callback it comes out as that
library's error (lazrs: 11 of 16 times), inside an error handler it hides the error, inside a
`finally` it leaves cleanup incomplete. In a block of `taken` a signal sets a flag instead. Long
work calls `check` between blocks, voxels, files and units, and `check` raises Interrupted. Once the
flag is set, any other exception that ends the block counts as an interrupt too, never as a fault of
a file.
"""

import contextlib
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator

# Code that calls no `check` for GRACE_SECONDS is interrupted at its current instruction:
# compilation, or a library that reads a whole file in one call. The interrupt is repeated every
# AGAIN_SECONDS, in case a library swallowed the exception, and after SOON_SECONDS if Python dropped
# it.
GRACE_SECONDS, AGAIN_SECONDS, SOON_SECONDS = 1.0, 5.0, 0.02

_SIGNALS = (signal.SIGINT, signal.SIGTERM)


class Interrupted(KeyboardInterrupt):
    """Interruption of the work by a signal.

    The text says what is left of the work, where that is known.
    """


class _State:
    """State of the interrupt in this process.

    taken: in a block of `taken`.  held: number of active `kept_back` blocks in it.
    since: time of the first signal (time.monotonic); None before.
    """

    taken = False
    held = 0
    since: float | None = None


def came() -> bool:
    """Return True if a signal has arrived in the block of `taken`."""
    return _State.since is not None


def check() -> None:
    """Raise Interrupted once a signal has arrived.

    The call is cheap, allowed in any thread, and harmless outside `taken`.
    """
    if _State.since is not None:
        leave()
        raise Interrupted


def leave() -> None:
    """Stop the timer of `_insist`, so that cleanup is not interrupted while the stack unwinds."""
    signal.setitimer(signal.ITIMER_REAL, 0)


@contextlib.contextmanager
def taken() -> Iterator[None]:
    """Note SIGINT and SIGTERM in this block, for `check`.

    If a signal arrived, the block ends with Interrupted, whatever else ends it. A signal that is
    ignored stays ignored, as under nohup. A further signal after GRACE_SECONDS raises at once. A
    nested block has no effect, and neither has a block outside the main thread, where Python runs
    no handlers.
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
    """Handle SIGINT and SIGTERM: set the flag; raise if it has been set for GRACE_SECONDS."""
    now = time.monotonic()
    if _State.since is None:
        _State.since = now
        signal.signal(signal.SIGALRM, _insist)
        sys.unraisablehook = _swallowed
        signal.setitimer(signal.ITIMER_REAL, GRACE_SECONDS, AGAIN_SECONDS)
    elif now - _State.since >= GRACE_SECONDS and not _State.held:
        raise Interrupted


def _insist(number: int, frame: object) -> None:
    """Handle the timer that a signal starts: raise, because nothing has called `check` for long."""
    if not _State.held:
        raise Interrupted


def _swallowed(what: "sys.UnraisableHookArgs") -> None:
    """Restart the timer if Python dropped an Interrupted, as in a callback of an import.

    Report any other unraisable exception.
    """
    if what.exc_type is Interrupted:
        signal.setitimer(signal.ITIMER_REAL, SOON_SECONDS, AGAIN_SECONDS)
    else:
        sys.__unraisablehook__(what)


@contextlib.contextmanager
def kept_back() -> Iterator[Callable[[], None]]:
    """Hold back SIGINT and SIGTERM until the block ends or the yielded function is called.

    For calls of libraries that call Python back: raised in a callback of HDF5, a KeyboardInterrupt
    came out as a SystemError, or not at all. In a block of `taken`, `check` still raises here where
    our own Python code calls it. Outside `taken`, the original handlers run at that time. Outside
    the main thread, where Python runs no handlers, this has no effect.
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
        """Run the handlers of the signals that arrived."""
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
    """Start the processes of this block with SIGINT blocked.

    Ctrl-C reaches a terminal's whole process group, and a worker that is still loading Python would
    print a traceback. A SIGINT that arrives in the block waits until its end.
    """
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
