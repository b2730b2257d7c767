"""Timing of the stages of long work, and their report to a progress listener."""

import time
from collections.abc import Iterator
from contextlib import contextmanager

from .progress import Progress


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
