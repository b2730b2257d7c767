"""Interrupts: SIGINT (Ctrl-C) and SIGTERM set a flag; work raises Interrupted where it can stop.

Python raises KeyboardInterrupt at any instruction. Inside a library's callback it becomes an error
of that library (lazrs: 11 of 16 times), inside an error handler it hides the error, inside a
`finally` it leaves cleanup incomplete. In a block of `deferring_interrupts` a signal sets a flag
instead. Long work calls `check_interrupt` between blocks, voxels, files and units, which raises
Interrupted. Once the flag is set, any other exception that ends the block is also treated as an
interrupt, never as a fault of a file.
"""

import contextlib
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator

# Code that does not call `check_interrupt` for GRACE_SECONDS is interrupted at its current
# instruction, for example compilation, or a library that reads a whole file in one call. The
# interrupt is repeated every AGAIN_SECONDS, in case a library swallowed the exception, and after
# SOON_SECONDS if Python dropped it.
GRACE_SECONDS, AGAIN_SECONDS, SOON_SECONDS = 1.0, 5.0, 0.02

_SIGNALS = (signal.SIGINT, signal.SIGTERM)


class Interrupted(KeyboardInterrupt):
    """Interruption of the work by a signal.

    The message states what remains of the work, if that is known.
    """


class _State:
    """State of the interrupt in this process.

    deferring: in a block of `deferring_interrupts`.
    blocked: number of active `blocking_interrupts` blocks in it.
    since: time of the first signal (time.monotonic); None before.
    """

    deferring = False
    blocked = 0
    since: float | None = None


def interrupt_pending() -> bool:
    """Return True if a signal has arrived in the block of `deferring_interrupts`."""
    return _State.since is not None


def check_interrupt() -> None:
    """Raise Interrupted once a signal has arrived.

    The call is cheap, allowed in any thread, and harmless outside `deferring_interrupts`.
    """
    if _State.since is not None:
        stop_insisting()
        raise Interrupted


def stop_insisting() -> None:
    """Stop the timer of `_insist`, so that cleanup is not interrupted while the stack unwinds."""
    signal.setitimer(signal.ITIMER_REAL, 0)


@contextlib.contextmanager
def deferring_interrupts() -> Iterator[None]:
    """Record SIGINT and SIGTERM during this block, for `check_interrupt`.

    If a signal arrived, the block ends with Interrupted, whatever else ends it. A signal that is
    ignored stays ignored, as under nohup. A further signal after GRACE_SECONDS raises at once. A
    nested block has no effect, and neither has a block outside the main thread, where Python runs
    no handlers.
    """
    if _State.deferring or threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.getsignal(number) for number in _SIGNALS}
    alarm, unraisable = signal.getsignal(signal.SIGALRM), sys.unraisablehook
    _State.deferring = True
    try:
        for number, handler in before.items():
            if handler not in (signal.SIG_IGN, None):
                signal.signal(number, _note)
        try:
            yield
        except Exception as error:
            if interrupt_pending():
                raise Interrupted from error
            raise
        check_interrupt()
    finally:
        if interrupt_pending():
            stop_insisting()
            signal.signal(signal.SIGALRM, alarm)
            sys.unraisablehook = unraisable
        for number, handler in before.items():
            if handler is not None:
                signal.signal(number, handler)
        _State.deferring, _State.since = False, None


def _note(number: int, frame: object) -> None:
    """Handle SIGINT and SIGTERM: set the flag; raise if it has been set for GRACE_SECONDS."""
    now = time.monotonic()
    if _State.since is None:
        _State.since = now
        signal.signal(signal.SIGALRM, _insist)
        sys.unraisablehook = _swallowed
        signal.setitimer(signal.ITIMER_REAL, GRACE_SECONDS, AGAIN_SECONDS)
    elif now - _State.since >= GRACE_SECONDS and not _State.blocked:
        raise Interrupted


def _insist(number: int, frame: object) -> None:
    """Handle the timer that a signal starts: raise, as `check_interrupt` was not called in time."""
    if not _State.blocked:
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
def blocking_interrupts() -> Iterator[Callable[[], None]]:
    """Hold back SIGINT and SIGTERM until the block ends or the yielded function is called.

    It is for libraries that call Python back: a KeyboardInterrupt raised in a callback of HDF5
    became a SystemError, or was lost. In a block of `deferring_interrupts`, `check_interrupt` still
    raises where Python code of this package calls it. Outside `deferring_interrupts`, the original
    handlers run when the block ends. Outside the main thread, where Python runs no handlers, this
    has no effect.
    """
    if threading.current_thread() is not threading.main_thread():
        yield lambda: None
        return
    if _State.deferring:
        _State.blocked += 1
        try:
            yield check_interrupt
        finally:
            _State.blocked -= 1
            check_interrupt()
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
def blocking_sigint() -> Iterator[None]:
    """Start the processes of this block with SIGINT blocked.

    Ctrl-C reaches a terminal's whole process group, and a worker that is still loading Python would
    print a traceback. A SIGINT that arrives in the block waits until its end.
    """
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
