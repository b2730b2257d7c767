"""What a command says of its work when it is interrupted."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from ...schemas.interrupts import Interrupted, came, check, leave, taken


@contextmanager
def interruptible(left: Callable[[], str] | None = None) -> Iterator[None]:
    """Let SIGINT and SIGTERM end this work. left: says what is there of it then; None: nothing is.

    Raises Interrupted, whose text that is.
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
