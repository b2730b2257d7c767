"""What a residency has done so far: voxels asked for, loaded, loaded in vain, gone too soon. Kept under its lock."""

import math
import time
from collections import deque
from collections.abc import Collection, Sequence

from ...schemas.wire.stats import Counters

# `Counters.too_soon`: a voxel that is asked for again so soon after it went for another had better stayed [s].
TOO_SOON = 10.0
# Voxels of which it is remembered for longer when they went.
MOST_WENT = 4096
# Loads whose times are remembered.
TIMES = 256


class Accounts:
    """Counts as `Counters` has them. Not thread-safe.

    fresh: rows prefetched, or just being so, that nobody has asked for yet.  times: seconds of the last loads.
    """

    def __init__(self, sizes: Sequence[int]) -> None:
        """Nothing done yet. sizes: bytes of each row."""
        self._sizes = sizes
        self.hits = self.waits = self.misses = self.late = self.failed = self.too_soon = 0
        self.prefetched = self.prefetched_bytes = self.used = self.wasted = self.wasted_bytes = 0
        self.fresh: set[int] = set()
        self.times: deque[float] = deque(maxlen=TIMES)
        self._went: dict[int, float] = {}  # when each voxel that was evicted went last

    def found(self, rows: Sequence[int]) -> None:
        """These were asked for and are there, or being loaded."""
        self.hits += len(rows)
        if self.fresh:
            known = self.fresh.intersection(rows)
            self.fresh -= known
            self.used += len(known)

    def missed(self, rows: Sequence[int]) -> None:
        """These were asked for, and who asked loads them."""
        self.misses += len(rows)
        now = time.perf_counter()
        self.too_soon += sum(now - self._went.get(row, -math.inf) < TOO_SOON for row in rows)

    def waited(self, rows: Sequence[int], loading: Collection[int]) -> None:
        """Of these, which were asked for, others load some."""
        self.waits += sum(row in loading for row in rows)

    def evicted(self, row: int) -> None:
        """A voxel went for another."""
        now = time.perf_counter()
        self._went.pop(row, None)
        self._went[row] = now  # in order of time
        while len(self._went) > MOST_WENT and now - next(iter(self._went.values())) > TOO_SOON:
            del self._went[next(iter(self._went))]
        self._in_vain(row)

    def begun_ahead(self, row: int) -> None:
        """A voxel is being loaded that nobody asked for."""
        self.fresh.add(row)
        self.prefetched += 1
        self.prefetched_bytes += self._sizes[row]

    def lost(self, row: int) -> None:
        """A load failed."""
        self.failed += 1
        self._in_vain(row)

    def _in_vain(self, row: int) -> None:
        """A voxel is gone; if it was prefetched and nobody asked for it, that was for nothing."""
        if row in self.fresh:
            self.fresh.discard(row)
            self.wasted += 1
            self.wasted_bytes += self._sizes[row]

    def counters(self, evicted: int, moved_bytes: int) -> Counters:
        """All of them."""
        return Counters(
            hits=self.hits, waits=self.waits, misses=self.misses, late=self.late, prefetched=self.prefetched,
            prefetched_bytes=self.prefetched_bytes, used=self.used, wasted=self.wasted, wasted_bytes=self.wasted_bytes,
            evicted=evicted, too_soon=self.too_soon, moved_bytes=moved_bytes, failed=self.failed,
        )  # fmt: skip

    def check(self) -> None:
        """Assert that they add up."""
        assert self.used + self.wasted + len(self.fresh) == self.prefetched
        assert self.waits <= self.hits and self.too_soon <= self.misses
