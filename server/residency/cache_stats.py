"""Statistics of a voxel cache: hits, misses, prefetches, wasted prefetches and early evictions.

`VoxelCache` updates them under its lock.
"""

import math
import time
from collections import deque
from collections.abc import Collection, Sequence

from ...schemas.wire.stats import Counters

# A voxel requested again within this time after its eviction was evicted too soon
# (`Counters.too_soon`) [s].
TOO_SOON = 10.0
# Number of evictions whose times are kept for longer than TOO_SOON.
MAX_EVICTION_TIMES = 4096
# Number of loads whose durations are kept.
MAX_LOAD_TIMES = 256


class CacheStats:
    """Counts of a voxel cache; `Counters` documents them. Not thread-safe.

    fresh: rows prefetched or being prefetched that no request has used yet.
    times: durations of the last loads [s].
    """

    def __init__(self, sizes: Sequence[int]) -> None:
        """Begin with zero counts. sizes: bytes of each row."""
        self._sizes = sizes
        self.hits = self.waits = self.misses = self.late = self.failed = self.too_soon = 0
        self.prefetched = self.prefetched_bytes = self.used = self.wasted = self.wasted_bytes = 0
        self.fresh: set[int] = set()
        self.times: deque[float] = deque(maxlen=MAX_LOAD_TIMES)
        self._evicted_at: dict[int, float] = {}  # row -> time of its last eviction

    def count_used(self, rows: Sequence[int]) -> None:
        """Count the prefetched voxels among requested ones that no request has used before."""
        known = self.fresh.intersection(rows)
        self.fresh -= known
        self.used += len(known)

    def missed(self, rows: Sequence[int]) -> None:
        """Count requested voxels that the request itself loads."""
        self.misses += len(rows)
        now = time.perf_counter()
        self.too_soon += sum(now - self._evicted_at.get(row, -math.inf) < TOO_SOON for row in rows)

    def waited(self, rows: Sequence[int], loading: Collection[int]) -> None:
        """Count the requested voxels that other threads are loading."""
        self.waits += sum(row in loading for row in rows)

    def evicted(self, row: int) -> None:
        """Count the eviction of a voxel."""
        now = time.perf_counter()
        self._evicted_at.pop(row, None)
        self._evicted_at[row] = now  # in order of time
        while (
            len(self._evicted_at) > MAX_EVICTION_TIMES
            and now - next(iter(self._evicted_at.values())) > TOO_SOON
        ):
            del self._evicted_at[next(iter(self._evicted_at))]
        self._count_wasted(row)

    def begun_ahead(self, row: int) -> None:
        """Count a prefetch that begins."""
        self.fresh.add(row)
        self.prefetched += 1
        self.prefetched_bytes += self._sizes[row]

    def lost(self, row: int) -> None:
        """Count a failed load."""
        self.failed += 1
        self._count_wasted(row)

    def _count_wasted(self, row: int) -> None:
        """Count a wasted prefetch if the voxel was prefetched and no request has used it."""
        if row in self.fresh:
            self.fresh.discard(row)
            self.wasted += 1
            self.wasted_bytes += self._sizes[row]

    def counters(self, evicted: int, moved_bytes: int) -> Counters:
        """Return all counts."""
        return Counters(
            hits=self.hits, waits=self.waits, misses=self.misses, late=self.late, prefetched=self.prefetched,
            prefetched_bytes=self.prefetched_bytes, used=self.used, wasted=self.wasted, wasted_bytes=self.wasted_bytes,
            evicted=evicted, too_soon=self.too_soon, moved_bytes=moved_bytes, failed=self.failed,
        )  # fmt: skip

    def check(self) -> None:
        """Assert that the counts add up."""
        assert self.used + self.wasted + len(self.fresh) == self.prefetched
        assert self.waits <= self.hits and self.too_soon <= self.misses
