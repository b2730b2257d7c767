"""Commands that write: SIGTERM ends them as Ctrl-C does, tidied up, and what is left is said."""

import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import typer


@contextmanager
def interruptible(left: Callable[[], str]) -> Iterator[None]:
    """Take SIGTERM for Ctrl-C, and say what is left."""
    main = threading.current_thread() is threading.main_thread()  # no other thread may say what a signal does
    before = signal.signal(signal.SIGTERM, _interrupt) if main else None
    try:
        yield
    except KeyboardInterrupt:
        print(f"interrupted: {left()}", file=sys.stderr)
        raise typer.Exit(130) from None  # all is said
    finally:
        if main:
            signal.signal(signal.SIGTERM, before)


def _interrupt(*_: object) -> None:
    """What SIGTERM does."""
    raise KeyboardInterrupt
