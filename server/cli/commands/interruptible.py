"""Context manager that reports the state of a command's work when it is interrupted."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from ....schemas.process.interrupts import (
    Interrupted,
    check_interrupt,
    deferring_interrupts,
    interrupt_pending,
    stop_insisting,
)


@contextmanager
def interruptible(left: Callable[[], str] | None = None) -> Iterator[None]:
    """Let SIGINT and SIGTERM end the work in this block.

    left: returns a sentence about what the work has left behind; None: it leaves nothing.
    Raises Interrupted with that sentence as its text.
    """
    with deferring_interrupts():
        try:
            yield
            check_interrupt()
        except BaseException as error:
            if not isinstance(error, KeyboardInterrupt) and not (
                interrupt_pending() and isinstance(error, Exception)
            ):
                raise
            stop_insisting()
            raise Interrupted(left() if left else "") from None
