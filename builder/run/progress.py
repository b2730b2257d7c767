"""Progress of long work: the interface of a listener, a silent one, and the timing of stages.

The command line draws it.
"""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Protocol


class Progress(Protocol):
    """Listener to the stages of long work.

    The stages follow one another; the amounts of `advance` add up to about the total of the stage.
    """

    def start(self, stage: str, total: int, unit: str) -> None:
        """Begin a stage; total is in `unit`, such as "points"."""
        ...

    def advance(self, amount: int) -> None:
        """Report that `amount` more of the stage is done."""
        ...

    def finish(self) -> None:
        """End the stage."""
        ...


class Silent:
    """Progress listener that ignores every report."""

    def start(self, stage: str, total: int, unit: str) -> None:
        """Ignore the beginning of a stage."""

    def advance(self, amount: int) -> None:
        """Ignore the amount."""

    def finish(self) -> None:
        """Ignore the end of a stage."""


class Stages:
    """Timer of stages that passes them on to a progress listener."""

    def __init__(self, progress: Progress) -> None:
        """Report to `progress`. seconds: of each stage so far."""
        self.progress = progress
        self.seconds: dict[str, float] = {}

    @contextmanager
    def timed(self, name: str) -> Iterator[None]:
        """Time a stage that reports its own progress."""
        begin = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - begin

    @contextmanager
    def stage(self, name: str, total: int, unit: str) -> Iterator[None]:
        """Time a stage and report it, with its total amount of work."""
        with self.timed(name):
            self.progress.start(name, total, unit)
            try:
                yield
            finally:
                self.progress.finish()
