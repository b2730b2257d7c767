"""Cache that remembers the state of each voxel: resident, being loaded, or failed, and with which fault.

[Fig12] section 4: "neighbour voxels to a user's position loaded and uncompressed into a LRU queue".
A voxel is loaded once, however many requests wait for it, and the voxels of a request are pinned
until it is answered. `EvictionPolicy` orders the voxels to evict, arena.py assigns bytes,
voxel_store.py decodes a record into them, and prefetch.py loads voxels before a request needs them.

A voxel is in one of four states:

- absent: it has no bytes in the arena;
- loading: it has bytes, and one thread fills them;
- resident: its runs are in `where`;
- failed: it has no bytes, and a fault. That of a corrupt record is permanent. Another ends with the
  last hold on the voxel, so that it does not become resident during a kernel call that began
  without it.

A request pins all its voxels or none: it never waits for memory while holding pins. Two requests
that each hold half of what the other needs therefore cannot deadlock.
"""

import math
import threading
import time
from collections import OrderedDict, deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from enum import Enum
from typing import NamedTuple
from weakref import WeakSet

import numpy as np

from ...schemas.errors import BadRequestError, CorruptError, MisleadingIndexError
from ...schemas.wire.residency_messages import MAX_CHANGED_VOXELS, Residency
from ...schemas.wire.stats import Counters
from ..runtime.stop_flag import NO_STOP, StopFlag, seconds_to
from .arena import ArenaBuffer, VoxelAllocator
from .load_turns import LOADS_WITHOUT_TURN, LoadTurns
from .voxel_store import VoxelStore

POLICIES = ("lru", "lru+prefetch")

# Share of the budget that scans may fill while other requests need room. Scans are sweeps along a
# path, and requests right after a teleport. Without a limit, one sweep through the archive evicts
# the voxels around every user. Measured with
# `scripts/simulate_cache --sweeps 10 --kinds stroll`, ten sweeps in five minutes beside eight
# strolling users in a town of 4e7 points: these users miss 362 voxels, 440 if sweeps are not marked
# as scans, and 326 without sweeps.
SCAN_SHARE = 0.1
# Voxels examined to find room for a prefetched one.
MAX_CANDIDATES = 256
# A voxel requested again within this time after its eviction was evicted too soon
# (`Counters.too_soon`) [s].
TOO_SOON = 10.0
# Number of evictions whose times are kept.
MAX_EVICTION_TIMES = 1 << 14
# Number of loads whose durations are kept.
MAX_LOAD_TIMES = 256


def prefetches(name: str) -> bool:
    """Return whether voxels are prefetched under this policy."""
    return name == "lru+prefetch"


class EvictionPolicy:
    """Order of eviction: least recently used first, with a bounded share for scans ([Fig12] section 4).

    Rows are index rows of voxels; a row is added at most once before it is removed. A row added by
    a scan is also in a separate queue until another request uses it. While that queue holds more
    than SCAN_SHARE of the budget, its oldest rows are evicted before all others; within that share
    its rows are treated like the rest.

    The class knows no pins, prefetches, threads or clock, and scripts/simulate_cache replays traces with
    it. Another policy would be another class with these four methods. Two were measured, and the order
    hardly matters once voxels are prefetched (server/DESIGN.md, "Prefetching").
    """

    def __init__(self, budget_bytes: int, name: str = "lru") -> None:
        """Begin without rows. Raise BadRequestError for an unknown name."""
        if name not in POLICIES:
            raise BadRequestError(f"policy {name!r}: expected one of {', '.join(POLICIES)}")
        self.name = name
        # row -> bytes, of all rows; least recently used first
        self._order: OrderedDict[int, int] = OrderedDict()
        self._scans: OrderedDict[int, int] = OrderedDict()  # the same, of rows used by scans only
        self._scan_bytes = 0
        self._max_scan_bytes = int(budget_bytes * SCAN_SHARE)

    def added(self, row: int, size: int, *, scan: bool) -> None:
        """Record that `size` bytes were allocated to a row.

        scan: whether a scan requested the row; False for a prefetch.
        """
        self._order[row] = size
        if scan:
            self._scans[row] = size
            self._scan_bytes += size

    def used(self, row: int, *, scan: bool) -> None:
        """Record that a row that is resident or being loaded was requested."""
        self._order.move_to_end(row)
        if row in self._scans:
            if scan:
                self._scans.move_to_end(row)
            else:
                self._scan_bytes -= self._scans.pop(row)

    def removed(self, row: int) -> None:
        """Record that the bytes of a row were released: it was evicted, or was never loaded."""
        del self._order[row]
        self._scan_bytes -= self._scans.pop(row, 0)

    def victims(self) -> Iterator[int]:
        """Iterate over all rows with allocated bytes in order of eviction, each once.

        The order is computed during the iteration, which any other call invalidates.
        """
        over = self._scan_bytes - self._max_scan_bytes
        named: set[int] = set()
        if over > 0:
            for row, size in self._scans.items():
                named.add(row)
                yield row
                over -= size
                if over <= 0:
                    break
        for row in self._order:
            if row not in named:
                yield row


@dataclass(slots=True, weakref_slot=True, eq=False)
class ChangeLog:
    """Latest change of each voxel since a reader last took them, bounded in size.

    changes: state of each changed voxel by index row.  overflowed: whether more voxels changed.
    """

    changes: dict[int, Residency] = field(default_factory=dict)
    overflowed: bool = False

    def add(self, row: int, state: Residency) -> None:
        """Note a change; a further one of the same voxel replaces it."""
        if len(self.changes) < MAX_CHANGED_VOXELS or row in self.changes:
            self.changes[row] = state
        else:
            self.overflowed = True


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
        self.fresh: set[int] = set()
        self.times: deque[float] = deque(maxlen=MAX_LOAD_TIMES)
        self.logs: WeakSet[ChangeLog] = WeakSet()
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
        for log in self.logs:
            log.add(row, state)

    def check(self) -> None:
        """Assert that the counts add up."""
        assert self.used + self.wasted + len(self.fresh) == self.prefetched
        assert self.waits <= self.hits and self.too_soon <= self.misses


class HeldVoxels(NamedTuple):
    """Result of a hold on voxels.

    hits: voxels that were resident or being loaded.  misses: voxels that were not.
    faults: one sentence for each unreadable voxel.
    late: rows that were not resident by the deadline. They may become resident during the hold:
    ignore them when reading `where`.
    waited: time spent on loads, by this thread or others, and on waits for memory [s].
    """

    hits: int
    misses: int
    faults: tuple[str, ...]
    late: tuple[int, ...] = ()
    waited: float = 0.0


class BackgroundLoad(Enum):
    """Result of a load that no request waits for."""

    RESIDENT = "the voxel is resident, or was"
    NO_ROOM = "no voxel may be evicted for it"
    FAILED = "the voxel cannot be read"


class Hold:
    """Context manager of a hold on voxels. A generator would cost a request twice as much."""

    __slots__ = ("_cache", "_deadline", "_rows", "_scan", "_stop")

    def __init__(
        self, cache: "VoxelCache", rows: Sequence[int], deadline: float, scan: bool, stop: StopFlag
    ) -> None:
        """Make a hold; call `VoxelCache.hold` instead."""
        self._cache, self._rows, self._deadline, self._scan, self._stop = cache, rows, deadline, scan, stop

    def __enter__(self) -> HeldVoxels:
        """Wait until all readable voxels are resident, or for the deadline."""
        return self._cache.acquire(self._rows, self._deadline, scan=self._scan, stop=self._stop)

    def __exit__(self, *_: object) -> None:
        """Release the voxels."""
        self._cache.release(self._rows)


class VoxelCache:
    """Resident voxels of one scene. Thread-safe.

    where: (v, 3) int64, a voxel's runs in the arena, -1 if not resident; kernels read it directly.
    kept: rows at users' positions, evicted only if a request would not fit otherwise.
    on_owed: called when a load is owed to a request whose deadline came first, see `take_owed`.
    on_load_time: called after each load with its duration [s].
    stats: counts of the cache, written under its lock.
    misled: whether a loaded record contradicts the index. The index selects the voxels of a query;
    once it is wrong, it may have failed to select any voxel.
    """

    def __init__(
        self,
        store: VoxelStore,
        budget_bytes: int,
        policy: EvictionPolicy | None = None,
        *,
        refuse_large: bool = True,
    ) -> None:
        """Reserve `budget_bytes` for the voxels of `store`. policy: None for `lru`.

        Raise BadRequestError for a larger voxel, or without `refuse_large`, give it a permanent fault.
        """
        sizes = [ArenaBuffer.rounded(int(size)) for size in store.sizes]
        largest = max(sizes, default=0)
        if refuse_large and budget_bytes < largest:
            raise BadRequestError(
                f"cache of {budget_bytes} bytes: the largest voxel takes {largest}: give a larger --cache, "
                "or build with a smaller --voxel"
            )
        self.budget_bytes = budget_bytes
        self.kept: frozenset[int] = frozenset()
        self.on_owed: Callable[[], None] | None = None
        self.on_load_time: Callable[[float], None] | None = None
        self.misled = False
        self._store = store
        self._sizes = [size if size <= budget_bytes else 0 for size in sizes]
        self._pins: dict[int, int] = {}  # row -> number of holds
        self._loading: set[int] = set()
        self._faults = {
            row: f"{store.archive.where(row)}: takes {size} bytes of a cache of {budget_bytes}: give a larger --cache"
            for row, size in enumerate(sizes)
            if size > budget_bytes
        }
        self._passing: set[int] = set()  # rows whose fault ends with the last hold
        self._owed: dict[int, None] = {}  # rows that requests did not get in time, in that order
        self.policy = order = policy or EvictionPolicy(budget_bytes)
        self.stats = counts = CacheStats(self._sizes)

        def on_evict(row: int) -> None:  # no method: a reference to itself would keep the memory
            counts.count_eviction(row)
            order.removed(row)

        self._allocator = VoxelAllocator(
            budget_bytes, self._sizes, order.victims, on_evict, self._pins, self._loading
        )
        self.buffer, self.where = self._allocator.buffer, self._allocator.where
        self._lock = threading.RLock()
        self._changed = threading.Condition(self._lock)
        self._turns = LoadTurns()
        self._waiting_requests = 0  # number of requests that load voxels or wait for them

    # --- holds ---

    def hold(
        self, rows: Sequence[int], deadline: float = math.inf, *, scan: bool = False, stop: StopFlag = NO_STOP
    ) -> Hold:
        """Load the voxels of distinct rows; pin them inside a `with` that yields `HeldVoxels`.

        Together they must fit in the budget. Unreadable voxels stay at -1 in `where` and are named
        in the result's faults; all others are resident.
        deadline: on time.perf_counter()'s clock [s]. Voxels that are not resident by then are
        `late`. No load begins after it; a load that has begun is finished. -inf: no load is begun
        or waited for, and nothing is evicted.
        scan: the voxels are used in passing and should not displace those that others use
        repeatedly (`EvictionPolicy`).
        stop: setting it has the effect of the deadline.
        """
        return Hold(self, rows, deadline, scan, stop)

    def frozen(self) -> AbstractContextManager[bool]:
        """Return the lock that freezes the resident set; hold it for some tens of microseconds."""
        return self._lock

    def use(self, rows: Sequence[int], *, scan: bool = False) -> None:
        """Record a use of resident voxels; call it inside `frozen`."""
        for row in rows:
            self.policy.used(row, scan=scan)
        self.stats.count_used(rows)

    def acquire(
        self, rows: Sequence[int], deadline: float = math.inf, *, scan: bool = False, stop: StopFlag = NO_STOP
    ) -> HeldVoxels:
        """Begin a hold; the caller must call `release` unless this raises."""
        with self._lock:
            if deadline == -math.inf:
                held = self._pin_resident(rows, scan)
            elif self._loading.isdisjoint(rows) and all(map(self._allocator.offsets.__contains__, rows)):
                self._pin(rows)
                self.use(rows, scan=scan)
                return HeldVoxels(len(rows), 0, ())
            else:
                held = None
                absent = len(self._absent(rows))
                self._waiting_requests += 1
        if held is None:
            turn = None
            try:
                if absent > LOADS_WITHOUT_TURN:
                    turn = self._turns.take(deadline, stop)
                held = self._load_and_pin(rows, deadline, scan, stop)
            finally:
                self._turns.give_back(turn)
                with self._lock:
                    self._waiting_requests -= 1
                    self._changed.notify_all()
        on_owed = self.on_owed
        if held.late and on_owed is not None:
            on_owed()  # without the lock: it may start a thread
        return held

    def release(self, rows: Sequence[int]) -> None:
        """End a hold."""
        with self._lock:
            self._unpin(rows)
            self._changed.notify_all()

    def _pin_resident(self, rows: Sequence[int], scan: bool) -> HeldVoxels:
        """Begin a hold on the voxels that are resident; the loads of the others are owed."""
        self._pin(rows)
        there, faults, late = self._sort_out(rows)
        self.use(there, scan=scan)
        self._owe(late)
        return HeldVoxels(len(there), 0, faults, late)

    def _load_and_pin(self, rows: Sequence[int], deadline: float, scan: bool, stop: StopFlag) -> HeldVoxels:
        """Begin a hold, loading what is absent and waiting for the loads of others."""
        taken = self.bytes_of(rows)
        if taken > self.buffer.total_bytes:
            raise ValueError(f"{len(rows)} voxels take {taken} bytes, over the budget: ask in pieces")
        begin, counts = time.perf_counter(), None
        while True:
            with self._lock:
                mine = self._reserve(rows, deadline, scan, stop)
                if counts is None:
                    counts = self._count(rows, mine, scan)
            try:
                self._load(mine, deadline, stop)
                with self._lock:
                    while not self._loading.isdisjoint(rows) and self._wait(deadline, stop):
                        pass
                    _, faults, late = self._sort_out(rows)
                    if not late or seconds_to(deadline, stop) == 0:
                        # A request that is stopped before its deadline needs nothing more.
                        self._owe(late, needed=time.perf_counter() >= deadline)
                        break
                    self._unpin(rows)  # another request left one of them at its deadline: begin anew
            except BaseException:
                self.release(rows)
                raise
        hits, misses, waits = counts
        # If the only missing voxels have faults known before this call, the request did not wait.
        waited = time.perf_counter() - begin if misses or waits or late else 0.0
        return HeldVoxels(hits, misses, faults, late, waited)

    def _reserve(self, rows: Sequence[int], deadline: float, scan: bool, stop: StopFlag) -> list[int]:
        """Pin the rows and allocate bytes for those that are absent, which the caller is to load.

        Return them; none if there is no room before the deadline. If this raises, nothing is pinned.
        """
        while True:
            self._pin(rows)
            absent = self._absent(rows)
            try:
                if self._allocate_all(absent, scan):
                    self._loading.update(absent)
                    return absent
            except BaseException:
                self._unpin(rows)
                raise
            self._unpin(rows)
            if not self._pins and not self._loading:
                # No other request holds anything: this caller's voxels lie between the free runs.
                self._allocator.evict_all_but(set(rows))
            elif not self._wait(deadline, stop):
                self._pin(rows)
                return []

    def _count(self, rows: Sequence[int], mine: list[int], scan: bool) -> tuple[int, int, bool]:
        """Count a request that is to load the rows `mine`; return hits, misses, and whether it waits."""
        new = set(mine)
        there = [row for row in rows if self.is_resident(row) and row not in new]
        self.use(there, scan=scan)
        self.stats.count_missed(mine)
        waits = sum(row in self._loading for row in there)
        self.stats.waits += waits
        return len(there), len(mine), waits > 0

    def _wait(self, deadline: float, stop: StopFlag) -> bool:
        """Wait until another thread changes the state; return False at the deadline or on stop."""
        while (left := seconds_to(deadline, stop)) != 0:
            if self._changed.wait(left):
                break
        return seconds_to(deadline, stop) != 0

    def _pin(self, rows: Sequence[int]) -> None:
        for row in rows:
            self._pins[row] = self._pins.get(row, 0) + 1

    def _unpin(self, rows: Sequence[int]) -> None:
        for row in rows:
            self._pins[row] -= 1
            if not self._pins[row]:
                del self._pins[row]
                if row in self._passing:
                    self._passing.discard(row)
                    del self._faults[row]

    # --- states ---

    def is_resident(self, row: int) -> bool:
        """Return whether a voxel is resident or being loaded."""
        return row in self._allocator.offsets

    def _absent(self, rows: Iterable[int]) -> list[int]:
        return [row for row in rows if not self.is_resident(row) and row not in self._faults]

    def _sort_out(self, rows: Sequence[int]) -> tuple[list[int], tuple[str, ...], tuple[int, ...]]:
        """Return the resident rows, the faults of the failed ones, and the other rows, which are late."""
        there = [row for row in rows if row in self._allocator.offsets and row not in self._loading]
        faults = tuple(self._faults[row] for row in rows if row in self._faults)
        settled = {*there, *self._faults}
        return there, faults, tuple(row for row in rows if row not in settled)

    def _owe(self, late: Sequence[int], *, needed: bool = True) -> None:
        """Count late voxels; their loads are owed if the request still needed them."""
        self.stats.late += len(late)
        if needed and self.on_owed is not None:
            self._owed.update(dict.fromkeys(late))

    def take_owed(self) -> int | None:
        """Return the voxel whose load has been owed longest; None if no load is owed."""
        with self._lock:
            while self._owed:
                row = next(iter(self._owed))
                del self._owed[row]
                if self._absent([row]):
                    return row
        return None

    def _allocate_all(self, rows: Sequence[int], scan: bool) -> bool:
        """Make room for every row, or for none. Voxels at users' positions are evicted last."""
        done = 0
        try:
            for row in rows:
                if not (
                    self._allocator.allocate(row, self.kept.__contains__)
                    or self._allocator.allocate(row, lambda _: False)
                ):
                    break
                self.policy.added(row, self._sizes[row], scan=scan)
                done += 1
        finally:
            if done < len(rows):
                for row in rows[:done]:
                    self._forget(row)
        return done == len(rows)

    def _forget(self, row: int) -> None:
        """Release the bytes of a voxel that was not loaded."""
        self._allocator.forget(row)
        self.policy.removed(row)

    # --- loads ---

    def _load(self, rows: list[int], deadline: float, stop: StopFlag) -> None:
        """Load reserved rows: each is resident or failed afterwards.

        Those whose load has not begun by the deadline, or before another one raises, are absent.
        """
        done = 0
        try:
            while done < len(rows) and seconds_to(deadline, stop) != 0:
                done += 1
                self._load_one(rows[done - 1])
        finally:
            if done < len(rows):
                with self._lock:
                    for row in rows[done:]:
                        self._loading.discard(row)
                        self._forget(row)
                    self._changed.notify_all()

    def _load_one(self, row: int) -> bool:
        """Load a voxel whose bytes are allocated; return whether it is resident then."""
        begin, where, fault, corrupt = time.perf_counter(), None, "", False
        try:
            where = self._store.load(row, self.buffer.arena, self._allocator.offsets[row])
        except CorruptError as error:
            fault, corrupt = str(error), True
            self.misled |= isinstance(error, MisleadingIndexError)
        except OSError as error:
            fault = f"{self._store.archive.where(row)}: cannot be read ({error}): check the disk"
        except BaseException as error:
            fault = f"{self._store.archive.where(row)}: not loaded ({error!r}): ask again"
            raise
        finally:
            seconds = time.perf_counter() - begin
            with self._lock:
                self._loading.discard(row)
                if where is None or fault:
                    self._fail(row, fault, corrupt)
                else:
                    self.where[row] = where
                    self.stats.count_load(row, seconds)
                self._changed.notify_all()
        if not fault and self.on_load_time is not None:
            self.on_load_time(seconds)
        return not fault

    def _fail(self, row: int, fault: str, corrupt: bool) -> None:
        """Record a failed load: permanently if `corrupt`, else for requests that hold the row."""
        self.stats.count_failure(row)
        self._forget(row)
        if corrupt or row in self._pins:
            self._faults[row] = fault
            if not corrupt:
                self._passing.add(row)

    def wait_until_idle(self) -> None:
        """Wait until no request waits for voxels."""
        with self._lock:
            while self._waiting_requests:
                self._changed.wait()

    def load_in_background(
        self, row: int, may_evict: Callable[[int], bool], *, owed: bool = False
    ) -> BackgroundLoad:
        """Load a voxel that no request waits for.

        Unless it is owed, wait first until no request waits for any voxel.
        may_evict: whether a voxel that is neither in use nor at a user's position may be evicted.
        owed: whether an earlier request needed the voxel. Raise errors of the load that are not
        faults of the record, such as MemoryError.
        """
        with self._lock:
            if not owed:
                self.wait_until_idle()
            if self.is_resident(row):
                return BackgroundLoad.RESIDENT
            if row in self._faults:
                return BackgroundLoad.FAILED
            kept = self.kept
            if not self._allocator.allocate(
                row, lambda other: other in kept or not may_evict(other), MAX_CANDIDATES
            ):
                return BackgroundLoad.NO_ROOM
            self.policy.added(row, self._sizes[row], scan=False)
            self._loading.add(row)
            if not owed:
                self.stats.count_prefetch(row)
        return BackgroundLoad.RESIDENT if self._load_one(row) else BackgroundLoad.FAILED

    # --- facts ---

    @property
    def resident(self) -> int:
        """Return the number of voxels resident or being loaded."""
        return len(self._allocator.offsets)

    @property
    def resident_bytes(self) -> int:
        """Return the bytes of the voxels resident or being loaded."""
        return self._allocator.used_bytes

    def bytes_of(self, rows: Sequence[int]) -> int:
        """Return the bytes that these voxels take when resident."""
        return sum(self._sizes[row] for row in rows)

    def recent(self) -> list[int]:
        """Return the index rows of the resident voxels, in order of eviction."""
        with self._lock:
            return [row for row in self.policy.victims() if row not in self._loading]

    def counters(self) -> Counters:
        """Return the statistics of the cache."""
        with self._lock:
            names = [name for name in Counters.__struct_fields__ if name != "moved_bytes"]
            counts = {name: getattr(self.stats, name) for name in names}
            return Counters(**counts, moved_bytes=self._allocator.moved_bytes)

    def load_times(self) -> list[float]:
        """Return the durations of the last loads [s], unordered."""
        with self._lock:
            return list(self.stats.times)

    def follow(self) -> ChangeLog:
        """Return a log of all changes from now on, as long as a reader refers to it."""
        log = ChangeLog()
        with self._lock:
            self.stats.logs.add(log)
        return log

    def take_changes(self, log: ChangeLog) -> tuple[dict[int, Residency], bool]:
        """Return the changes in a log, by index row, and whether some are missing; begin it anew."""
        with self._lock:
            found = log.changes, log.overflowed
            log.changes, log.overflowed = {}, False
        return found

    def check(self) -> None:
        """Assert the invariants between two operations: bytes add up, and runs do not overlap."""
        with self._lock:
            self._allocator.check()
            assert sorted(self.policy.victims()) == sorted(self._allocator.offsets)
            offsets = set(self._allocator.offsets)
            resident = {int(row) for row in np.flatnonzero(self.where[:, 0] >= 0)}
            assert resident == offsets - self._loading and self._loading <= offsets
            assert offsets.isdisjoint(self._faults) and self._passing <= self._faults.keys()
            assert all(count > 0 for count in self._pins.values())
            assert self.stats.fresh <= offsets and self._waiting_requests >= 0
            self.stats.check()
