"""Context manager that reports the state of a command's work when it is interrupted."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from ....schemas.process.interrupts import Interrupted, came, check, leave, taken


@contextmanager
def interruptible(left: Callable[[], str] | None = None) -> Iterator[None]:
    """Let SIGINT and SIGTERM end the work in this block.

    left: returns a sentence about what the work has left behind; None: it leaves nothing.
    Raises Interrupted with that sentence as its text.
    """
    with taken():
        try:
            yield
            check()
        except BaseException as error:
            if not isinstance(error, KeyboardInterrupt) and not (came() and isinstance(error, Exception)):
                raise
            leave()
            raise Interrupted(left() if left else "") from None
