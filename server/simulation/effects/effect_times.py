"""Time that each effect has taken in the frames of a scene, for statistics."""

import threading
from collections.abc import Iterable

from ....schemas.wire.stats import EffectStats


class EffectTimes:
    """Frames and seconds by effect. Thread-safe."""

    def __init__(self, names: Iterable[str]) -> None:
        """Begin at 0. names: of the effects, in the order in which they run."""
        self._counts = {name: [0, 0.0] for name in names}
        self._lock = threading.Lock()

    def add(self, ran: list[tuple[str, float]]) -> None:
        """Count a frame. ran: its effects with their times [s]."""
        with self._lock:
            for name, seconds in ran:
                count = self._counts[name]
                count[0] += 1
                count[1] += seconds

    def stats(self) -> list[EffectStats]:
        """Return the counts of each effect, in the order in which they run."""
        with self._lock:
            return [EffectStats(name, *count) for name, count in self._counts.items()]  # type: ignore[arg-type]
