"""Report on a voxel cache: counts, the times of loads, and changes for those who follow it.

`VoxelCache` updates all of it under its lock.
"""

import math
import time
from collections import deque
from collections.abc import Collection, Iterable, Sequence

from ...schemas.wire.residency_messages import MAX_CHANGED_VOXELS, Residency
from ...schemas.wire.stats import Counters

# A voxel requested again within this time after its eviction was evicted too soon
# (`Counters.too_soon`) [s].
TOO_SOON = 10.0
# Number of evictions whose times are kept.
MAX_EVICTION_TIMES = 1 << 14
# Number of loads whose durations are kept.
MAX_LOAD_TIMES = 256


class ChangeLog:
    """Latest change of each voxel since a reader last took them, bounded in size.

    changes: state of each changed voxel by index row.  overflowed: whether more voxels changed.
    """

    __slots__ = ("changes", "overflowed")

    def __init__(self) -> None:
        """Begin without changes."""
        self.changes: dict[int, Residency] = {}
        self.overflowed = False

    def add(self, row: int, state: Residency) -> None:
        """Note a change; a further one of the same voxel replaces it."""
        if len(self.changes) < MAX_CHANGED_VOXELS or row in self.changes:
            self.changes[row] = state
        else:
            self.overflowed = True

    def take(self) -> tuple[dict[int, Residency], bool]:
        """Return the changes and whether some are missing, and begin anew."""
        found = self.changes, self.overflowed
        self.changes, self.overflowed = {}, False
        return found


class CacheStats:
    """Counts of a voxel cache, with the names of `Counters`, which documents them.

    fresh: rows prefetched or being prefetched that no request has used yet.
    times: durations of the last loads [s].  logs: of readers that follow the changes.
    """

    def __init__(self, sizes: Sequence[int]) -> None:
        """Begin with zero counts. sizes: bytes of each row."""
        self._sizes = sizes
        self.hits = self.waits = self.misses = self.late = self.failed = self.too_soon = self.evicted = 0
        self.prefetched = self.prefetched_bytes = self.used = self.wasted = self.wasted_bytes = 0
        self.moved_bytes = 0
        self.fresh: set[int] = set()
        self.times: deque[float] = deque(maxlen=MAX_LOAD_TIMES)
        self.logs: tuple[ChangeLog, ...] = ()
        self._evicted_at: dict[int, float] = {}  # row -> time of its last eviction, in order of time

    def count_used(self, rows: Sequence[int]) -> None:
        """Count requested voxels that were resident or loading."""
        self.hits += len(rows)
        if self.fresh:
            known = self.fresh.intersection(rows)
            self.fresh -= known
            self.used += len(known)

    def count_missed(self, rows: Sequence[int]) -> None:
        """Count requested voxels that the request itself loads."""
        self.misses += len(rows)
        since = time.perf_counter() - TOO_SOON
        self.too_soon += sum(self._evicted_at.get(row, -math.inf) > since for row in rows)

    def count_waits(self, rows: Iterable[int], loading: Collection[int]) -> None:
        """Count the requested voxels that other threads are loading."""
        self.waits += sum(row in loading for row in rows)

    def count_prefetch(self, row: int) -> None:
        """Count a prefetch that begins."""
        self.fresh.add(row)
        self.prefetched += 1
        self.prefetched_bytes += self._sizes[row]

    def count_load(self, row: int, seconds: float) -> None:
        """Count a load that took `seconds`."""
        self.times.append(seconds)
        self._note(row, Residency.PREFETCHED if row in self.fresh else Residency.LOADED)

    def count_failure(self, row: int) -> None:
        """Count a failed load."""
        self.failed += 1
        self._count_wasted(row)

    def count_eviction(self, row: int) -> None:
        """Count the eviction of a voxel."""
        self.evicted += 1
        self._note(row, Residency.WASTED if row in self.fresh else Residency.EVICTED)
        self._count_wasted(row)
        self._evicted_at.pop(row, None)
        self._evicted_at[row] = time.perf_counter()
        if len(self._evicted_at) > MAX_EVICTION_TIMES:
            del self._evicted_at[next(iter(self._evicted_at))]

    def _count_wasted(self, row: int) -> None:
        """Count a wasted prefetch if the voxel was prefetched and no request has used it."""
        if row in self.fresh:
            self.fresh.discard(row)
            self.wasted += 1
            self.wasted_bytes += self._sizes[row]

    def _note(self, row: int, state: Residency) -> None:
        """Note a change for all readers."""
        for log in self.logs:
            log.add(row, state)

    def counters(self) -> Counters:
        """Return all counts."""
        return Counters(**{name: getattr(self, name) for name in Counters.__struct_fields__})

    def check(self) -> None:
        """Assert that the counts add up."""
        assert self.used + self.wasted + len(self.fresh) == self.prefetched
        assert self.waits <= self.hits and self.too_soon <= self.misses
