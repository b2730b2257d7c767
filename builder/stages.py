"""The stages of long work: each is timed, and told to a listener."""

import time
from collections.abc import Iterator
from contextlib import contextmanager

from .progress import Progress


class Stages:
    """Times the stages and passes them on to the listener."""

    def __init__(self, progress: Progress) -> None:
        """Tell `progress`. seconds: of each stage so far."""
        self.progress = progress
        self.seconds: dict[str, float] = {}

    @contextmanager
    def timed(self, name: str) -> Iterator[None]:
        """A stage that says itself what it does."""
        begin = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - begin

    @contextmanager
    def stage(self, name: str, total: int, unit: str) -> Iterator[None]:
        """A stage of so much work."""
        with self.timed(name):
            self.progress.start(name, total, unit)
            try:
                yield
            finally:
                self.progress.finish()
