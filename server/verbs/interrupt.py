"""Commands that write: SIGTERM ends them as Ctrl-C does: temporary files are removed, and what is left is said."""

import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import typer


@contextmanager
def interruptible(left: Callable[[], str] | None = None) -> Iterator[None]:
    """Take SIGTERM for Ctrl-C. left: says what is left when it comes; None: nothing is."""
    main = threading.current_thread() is threading.main_thread()  # no other thread may say what a signal does
    before = signal.signal(signal.SIGTERM, _interrupt) if main else None
    try:
        yield
    except KeyboardInterrupt:
        print(f"interrupted: {left()}" if left else "interrupted", file=sys.stderr)
        raise typer.Exit(130) from None  # all is said
    finally:
        if main:
            signal.signal(signal.SIGTERM, before)


def _interrupt(*_: object) -> None:
    """What SIGTERM does."""
    raise KeyboardInterrupt
