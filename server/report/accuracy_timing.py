"""Times of many settings, taken in turn, so that a busy moment of the machine meets all of them alike."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ask = Callable[[Floats], Any]

# A setting whose middle repetition took so much longer than its best is marked: something else ran meanwhile.
NOISY = 1.3


@dataclass
class Timed:
    """One setting and its times.

    ask: answers poses (k, 4, 4).  chunk: poses of each run of neighbours that is timed as one.
    loops: (runs,) [s] of each repetition.
    """

    ask: Ask
    chunk: int = 1
    loops: list[Floats] = field(default_factory=list)

    @property
    def best(self) -> Floats:
        """Of each run, its best repetition (runs,) [s]: a busy moment of the machine rarely meets a run twice."""
        return np.min(self.loops, axis=0)

    @property
    def mean(self) -> float:
        """Of a pose, over all runs [s]."""
        return float(self.best.mean()) / self.chunk

    @property
    def noise(self) -> float:
        """How much longer the middle repetition took than the best of each run: 1 on a quiet machine."""
        return float(np.median([loop.sum() for loop in self.loops]) / self.best.sum())

    def percentile(self, share: float) -> float:
        """Of a pose, over runs [s]."""
        return float(np.percentile(self.best, share)) / self.chunk


def take_times(
    subjects: Sequence[Timed], poses: Floats, loops: int, chunk: int, tick: Callable[[], None]
) -> None:
    """Time all subjects on the same poses, `loops` times in turn; tick() after each.

    Before each measurement all poses are asked untimed: the subject before has left the processor's caches in no fair
    state, and the first call of all may compile.
    """
    chunk = min(chunk, len(poses))
    parts = [np.ascontiguousarray(poses[i : i + chunk]) for i in range(0, len(poses) - chunk + 1, chunk)]
    for _ in range(loops):
        for subject in subjects:
            subject.chunk = chunk
            subject.ask(poses)
            spent = np.empty(len(parts))
            for i, part in enumerate(parts):
                begin = time.perf_counter()
                subject.ask(part)
                spent[i] = time.perf_counter() - begin
            subject.loops.append(spent)
            tick()
