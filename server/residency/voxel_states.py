"""States of the voxels of a cache (pinned, loading, abandoned, owed, faulty) and their allocation.

A request holds voxels with a `Hold`, made by `VoxelCache.hold`; `HeldVoxels` is its result.
"""

import threading
from collections import OrderedDict
from collections.abc import Callable, Iterable, Sequence
from enum import Enum
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from ...schemas.errors import BadRequestError
from ...schemas.wire.residency_messages import Residency
from ...schemas.wire.stats import Counters
from ..runtime.stop_flag import StopFlag
from .allocator import VoxelAllocator
from .arena import ArenaBuffer
from .cache_stats import CacheStats
from .change_log import ChangeLog
from .eviction import EvictionPolicy

# Voxels examined to find room for a prefetched one.
MAX_CANDIDATES = 256


class HeldVoxels(NamedTuple):
    """Result of a hold on voxels.

    hits: voxels that were resident or being loaded.  misses: voxels that were not.
    faults: one sentence for each unreadable voxel.
    late: rows that were not resident by the deadline. They may become resident during the hold:
    ignore them when reading `where` (`as_held`).
    waited: time spent on loads, by this thread or others, and on waits for memory [s].
    """

    hits: int
    misses: int
    faults: tuple[str, ...]
    late: tuple[int, ...] = ()
    waited: float = 0.0


def voxel_sizes(sizes: NDArray[np.int64], budget_bytes: int, *, refuse_large: bool) -> list[int]:
    """Return the bytes that each voxel takes in the arena.

    Raise BadRequestError if `refuse_large` and the largest exceeds the budget.
    """
    rounded = [ArenaBuffer.rounded(int(size)) for size in sizes]
    largest = max(rounded, default=0)
    if refuse_large and budget_bytes < largest:
        raise BadRequestError(
            f"cache of {budget_bytes} bytes: the largest voxel takes {largest}: give a larger --cache, "
            "or build with a smaller --voxel"
        )
    return rounded


class BackgroundLoad(Enum):
    """Result of a load that no request waits for."""

    RESIDENT = "the voxel is resident, or was"
    NO_ROOM = "no voxel may be evicted for it"
    FAILED = "the voxel cannot be read"


class Holder(Protocol):
    """Cache whose voxels can be held: `VoxelCache`."""

    def acquire(self, rows: Sequence[int], deadline: float, *, scan: bool, stop: StopFlag) -> HeldVoxels:
        """Begin a hold."""

    def release(self, rows: Sequence[int]) -> None:
        """End a hold."""


class Hold:
    """Context manager of a hold on voxels. A generator would cost a request twice as much."""

    __slots__ = ("_cache", "_deadline", "_rows", "_scan", "_stop")

    def __init__(
        self, cache: Holder, rows: Sequence[int], deadline: float, scan: bool, stop: StopFlag
    ) -> None:
        """Make a hold; call `VoxelCache.hold` instead."""
        self._cache, self._rows, self._deadline, self._scan, self._stop = cache, rows, deadline, scan, stop

    def __enter__(self) -> HeldVoxels:
        """Wait until all readable voxels are resident, or for the deadline."""
        return self._cache.acquire(self._rows, self._deadline, scan=self._scan, stop=self._stop)

    def __exit__(self, *_: object) -> None:
        """Release the voxels."""
        self._cache.release(self._rows)


class VoxelStates:
    """States of all voxels by index row. Not thread-safe: `VoxelCache` calls it under its lock.

    A voxel whose bytes are allocated is resident, unless it is in `loading`.

    pins: row -> number of holds, for held rows.  loading: rows whose load has not ended.
    abandoned: rows in `loading` whose request reached its deadline before the load began. Another
    request that waits for the row does the load.
    owed: rows that a request did not get by its deadline, in order of deadlines.
    is_owed_free: whether the last hold on an abandoned voxel whose load is owed has ended.
    kept: rows at users' positions, evicted only if a request would not fit otherwise.
    where, policy: see `VoxelCache`.  sizes: bytes of each row in the arena.
    logs: of readers that follow the changes.
    """

    def __init__(
        self,
        buffer: ArenaBuffer,
        sizes: list[int],
        where: NDArray[np.int64],
        policy: EvictionPolicy,
        describe: Callable[[int], str],
    ) -> None:
        """Begin with nothing resident. describe: returns file and voxel of a row, for faults."""
        self.allocator = VoxelAllocator(buffer, sizes, where, policy)
        self.stats = CacheStats(sizes)
        self.where, self.sizes = where, sizes
        self.pins: dict[int, int] = {}
        self.loading: set[int] = set()
        self.abandoned: set[int] = set()
        self.owed: OrderedDict[int, None] = OrderedDict()
        self.is_owed_free = False
        self.kept: frozenset[int] = frozenset()
        self.logs: tuple[ChangeLog, ...] = ()
        self._describe = describe
        self._faults: dict[int, str] = {}  # of corrupt records: permanent
        # Temporary faults. The voxel is read again only after all holds on it have ended, so that
        # it never becomes resident during a kernel call that began without it.
        self._temporary_faults: dict[int, str] = {}

    def fault(self, row: int) -> str:
        """Return why a voxel cannot be read; "" if it has no fault."""
        return self._faults.get(row, "") or self._temporary_faults.get(row, "")

    def refuse_larger(self, sizes: list[int], most: int) -> None:
        """Give voxels of more than `most` bytes a permanent fault, before anything is loaded."""
        for row, size in enumerate(sizes):
            if size > most:
                self._faults[row] = (
                    f"{self._describe(row)}: takes {size} bytes of a cache of {most}: give a larger --cache"
                )

    def missing(self, rows: Iterable[int]) -> list[int]:
        """Return the rows that are neither resident nor being loaded, and have no fault."""
        offsets = self.allocator.offsets
        return [row for row in rows if row not in offsets and not self.fault(row)]

    def is_resident(self, row: int) -> bool:
        """Return whether a voxel is resident and completely loaded."""
        return row in self.allocator.offsets and row not in self.loading

    def all_resident(self, rows: Sequence[int]) -> bool:
        """Return whether all rows are resident. Each must have allocated bytes or a fault."""
        if self.loading and not self.loading.isdisjoint(rows):
            return False
        return not (self._faults or self._temporary_faults) or not any(map(self.fault, rows))

    def settled(self, rows: Sequence[int]) -> bool:
        """Return whether a waiting request can continue.

        True if none of these rows is being loaded, or one of them is abandoned and this caller
        may load it.
        """
        loading = [row for row in rows if row in self.loading]
        return not loading or any(row in self.abandoned for row in loading)

    def sort_out(self, rows: Sequence[int]) -> tuple[list[int], tuple[str, ...], tuple[int, ...]]:
        """Return the resident rows, the faults of unreadable ones, and the rows that are late."""
        there: list[int] = []
        late: list[int] = []
        faults: list[str] = []
        for row in rows:
            fault = self.fault(row)
            if fault:
                faults.append(fault)
            else:
                (there if self.is_resident(row) else late).append(row)
        return there, tuple(faults), tuple(late)

    # --- pins ---

    def pin(self, rows: Sequence[int]) -> None:
        """Begin a hold on rows."""
        for row in rows:
            self.pins[row] = self.pins.get(row, 0) + 1

    def unpin(self, rows: Sequence[int]) -> None:
        """End a hold on rows."""
        for row in rows:
            self.pins[row] -= 1
            if not self.pins[row]:
                del self.pins[row]
                self._temporary_faults.pop(row, None)
                if row in self.abandoned:
                    self._drop_abandoned(row)

    def abandon(self, rows: Sequence[int]) -> None:
        """Leave loads that have not begun to the other requests that hold these rows."""
        for row in rows:
            self.abandoned.add(row)
            if self.pins[row] == 1:  # only the caller holds it
                self._drop_abandoned(row)

    def _drop_abandoned(self, row: int) -> None:
        """Release the bytes of a voxel whose load never began."""
        self.abandoned.discard(row)
        self.loading.discard(row)
        self.allocator.forget(row)
        self.is_owed_free |= row in self.owed

    def take_owed(self) -> int | None:
        """Return the voxel whose load has been owed longest; None if no load is owed."""
        for row in list(self.owed):
            if row in self.abandoned:  # a waiting request may still load it
                continue
            del self.owed[row]
            if row not in self.allocator.offsets and not self.fault(row):
                return row
        return None

    # --- bytes ---

    def allocate_all(self, rows: Sequence[int], scan: bool) -> bool:
        """Make room for every row, or for none. Voxels at users' positions are evicted last."""
        done = 0
        try:
            for row in rows:
                if not self._allocate(row, scan):
                    break
                done += 1
        finally:
            if done < len(rows):
                for row in rows[:done]:
                    self.allocator.forget(row)
        return done == len(rows)

    def _allocate(self, row: int, scan: bool) -> bool:
        return any(
            self.allocator.allocate(row, may_evict, self._is_free, self._evicted, scan=scan)
            for may_evict in (self._is_unneeded, self._is_free)
        )

    def allocate_for_prefetch(self, row: int, may_evict: Callable[[int], bool]) -> bool:
        """Make room for one row; see `VoxelCache.load_in_background`."""
        return self.allocator.allocate(
            row, lambda other: self._is_unneeded(other) and may_evict(other), self._is_free, self._evicted,
            scan=False, most=MAX_CANDIDATES,
        )  # fmt: skip

    def evict_all_but(self, rows: Sequence[int]) -> None:
        """Evict all voxels but these and move these together; none may be in use or loading."""
        self.allocator.evict_all_but(set(rows), self._evicted)

    def _evicted(self, row: int) -> None:
        """Count the eviction of a voxel, and note it for readers."""
        if self.logs:
            state = Residency.WASTED if row in self.stats.fresh else Residency.EVICTED
            for log in self.logs:
                log.add(row, state)
        self.stats.evicted(row)

    def _is_free(self, row: int) -> bool:
        """Return whether no thread uses or loads a voxel."""
        return row not in self.pins and row not in self.loading

    def _is_unneeded(self, row: int) -> bool:
        """Return whether a voxel is free and not at a user's position."""
        return row not in self.pins and row not in self.loading and row not in self.kept

    # --- ends of loads ---

    def end_load(self, row: int, where: NDArray[np.int64], seconds: float) -> None:
        """Make a loaded voxel visible to others. seconds: the duration of the load [s]."""
        self.where[row] = where
        self.loading.discard(row)
        self.stats.times.append(seconds)
        if self.logs:
            state = Residency.PREFETCHED if row in self.stats.fresh else Residency.LOADED
            for log in self.logs:
                log.add(row, state)

    def fail(self, row: int, fault: str, *, corrupt: bool = False) -> None:
        """Record a failed load: permanently if `corrupt`, else for requests that hold the row."""
        self.stats.lost(row)
        self.allocator.forget(row)
        self.loading.discard(row)
        if corrupt:
            self._faults[row] = fault
        elif row in self.pins:
            self._temporary_faults[row] = f"{self._describe(row)}: {fault}"

    def check(self) -> None:
        """Assert the invariants: bytes add up, and runs neither overlap nor leave the buffer."""
        self.allocator.check()
        offsets = set(self.allocator.offsets)
        resident = {int(row) for row in np.flatnonzero(self.where[:, 0] >= 0)}
        assert resident == offsets - self.loading
        assert self.abandoned <= self.loading <= offsets and self.abandoned <= set(self.pins)
        assert all(count > 0 for count in self.pins.values())
        assert self.stats.fresh <= offsets
        self.stats.check()


class CacheFacts:
    """Read-only part of `VoxelCache`: the states of its voxels, and counts of them.

    policy, stats: see `VoxelCache`. The rest is set by it.
    """

    stats: CacheStats
    policy: EvictionPolicy
    _states: VoxelStates
    _sizes: list[int]
    _lock: threading.RLock

    @property
    def kept(self) -> frozenset[int]:
        """Return the rows at users' positions; others are evicted before them."""
        return self._states.kept

    @kept.setter
    def kept(self, rows: frozenset[int]) -> None:
        self._states.kept = rows

    @property
    def resident(self) -> int:
        """Return the number of voxels resident or being loaded."""
        return len(self._states.allocator.offsets)

    @property
    def resident_bytes(self) -> int:
        """Return the bytes of the voxels resident or being loaded."""
        return self._states.allocator.used_bytes

    @property
    def evictions(self) -> int:
        """Return the number of voxels evicted to make room for others."""
        return self._states.allocator.evictions

    def follow(self) -> ChangeLog:
        """Return a log of all changes from now on, until `unfollow`."""
        log = ChangeLog()
        with self._lock:
            self._states.logs += (log,)
        return log

    def unfollow(self, log: ChangeLog) -> None:
        """End a log."""
        with self._lock:
            self._states.logs = tuple(other for other in self._states.logs if other is not log)

    def take_changes(self, log: ChangeLog) -> tuple[dict[int, Residency], bool]:
        """Return the changes in a log, by index row, and whether some are missing; begin it anew."""
        with self._lock:
            return log.take()

    def counters(self) -> Counters:
        """Return the statistics of the cache."""
        with self._lock:
            allocator = self._states.allocator
            return self.stats.counters(allocator.evictions, allocator.moved_bytes)

    def load_times(self) -> list[float]:
        """Return the durations of the last loads [s], unordered."""
        with self._lock:
            return list(self.stats.times)

    def recent(self) -> list[int]:
        """Return the index rows of the resident voxels, in order of eviction."""
        with self._lock:
            return [row for row in self.policy.victims() if row not in self._states.loading]

    def is_resident(self, row: int) -> bool:
        """Return whether a voxel is resident or being loaded."""
        return row in self._states.allocator.offsets

    def bytes_of(self, rows: Sequence[int]) -> int:
        """Return the bytes that these voxels take when resident."""
        return sum(self._sizes[row] for row in rows)
