"""Timing of many settings in turn, which spreads disturbances by other work over all of them."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Query = Callable[[Floats], Any]

# A setting is marked as noisy if its median repetition took this much longer than its best: other
# work ran on the machine.
NOISY = 1.3


@dataclass
class TimedSetting:
    """One setting and its times.

    ask: queries poses (k, 4, 4).  chunk: number of consecutive poses in a run, which is timed as
    one call.
    loops: for each repetition (runs,), the time of each run [s].
    """

    ask: Query
    chunk: int = 1
    loops: list[Floats] = field(default_factory=list)

    @property
    def best(self) -> Floats:
        """Return the shortest time of each run (runs,) [s].

        A disturbance by other work rarely hits a run in every repetition.
        """
        return np.min(self.loops, axis=0)

    @property
    def mean(self) -> float:
        """Return the mean time per pose over all runs [s]."""
        return float(self.best.mean()) / self.chunk

    @property
    def noise(self) -> float:
        """Return the ratio of the median repetition to the best runs: 1 on a quiet machine."""
        return float(np.median([loop.sum() for loop in self.loops]) / self.best.sum())

    def quantile(self, share: float) -> float:
        """Return a quantile, over runs, of the time per pose [s]. share: 0 to 1."""
        return float(np.quantile(self.best, share)) / self.chunk


def take_times(
    subjects: Sequence[TimedSetting], poses: Floats, loops: int, chunk: int, tick: Callable[[], None]
) -> None:
    """Time all subjects on the same poses, `loops` times in turn.

    Before each measurement all poses are queried untimed: the previous subject has changed the
    contents of the processor's caches, and the very first call may compile.
    tick: called after each measurement.
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
