"""Cache of resident voxels, decoded, within `budget_bytes`: pins, loads and waits of requests.

[Fig12] section 4: "neighbour voxels to a user's position loaded and uncompressed into a LRU queue".
A voxel is loaded once, however many requests wait for it, and the voxels of a request are pinned
until it is answered. eviction.py selects the voxels to evict, allocator.py assigns bytes, and
prefetch.py loads voxels before a request needs them.

A request pins all its voxels or none: it never waits for memory while holding pins. Two requests
that each hold half of what the other needs therefore cannot deadlock.
"""

import math
import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager

import numpy as np
from numpy.typing import NDArray

from ...schemas.errors import BadRequestError, CorruptError, MisleadingIndexError
from ...schemas.wire.stats import Counters
from ..runtime.stop_flag import NO_STOP, StopFlag, seconds_to
from .allocator import VoxelAllocator
from .arena import ArenaBuffer
from .cache_stats import CacheStats
from .eviction import EvictionPolicy, make_policy
from .held_voxels import BackgroundLoad, HeldVoxels
from .load_turns import LOADS_WITHOUT_TURN, LoadTurn, LoadTurns
from .voxel_store import VoxelStore

# Voxels examined to find room for a prefetched one.
MOST_CANDIDATES = 256


class Hold:
    """Context manager of a hold on voxels. A generator would cost a request twice as much."""

    __slots__ = ("_deadline", "_residency", "_rows", "_scan", "_stop")

    def __init__(
        self, residency: "VoxelCache", rows: Sequence[int], deadline: float, scan: bool, stop: StopFlag
    ) -> None:
        """Make a hold; call `VoxelCache.hold` instead."""
        self._residency, self._rows, self._deadline, self._scan = residency, rows, deadline, scan
        self._stop = stop

    def __enter__(self) -> HeldVoxels:
        """Wait until all readable voxels are resident, or for the deadline."""
        return self._residency.acquire(self._rows, self._deadline, scan=self._scan, stop=self._stop)

    def __exit__(self, *_: object) -> None:
        """Release the voxels."""
        self._residency.release(self._rows)


class VoxelCache:
    """Resident voxels of one scene. Thread-safe.

    where: (v, 3) int64, a voxel's runs in the arena, -1 if not resident; kernels read it directly.
    kept: rows at users' positions, evicted only if a request would not fit otherwise.
    owed: called when a load is owed to a request whose deadline came first, see `take_owed`.
    loaded: called with the row and the runs of each loaded voxel, by the loading thread, before the
    voxel is visible to other threads.  took: called afterwards with the duration of the load [s].
    proved: called with the row of each loaded voxel, before it is visible to other threads.
    misled: whether a loaded record has points that the index places elsewhere. The index selects
    the voxels of a query; once it is wrong, it is unknown which voxels it failed to select.
    """

    def __init__(self, store: VoxelStore, budget_bytes: int, policy: EvictionPolicy | None = None) -> None:
        """Reserve the budget; BadRequestError if one voxel exceeds it. policy: `lru` by default."""
        largest = ArenaBuffer.rounded(int(store.sizes.max(initial=0)))
        if budget_bytes < largest:
            raise BadRequestError(
                f"cache of {budget_bytes} bytes: the largest voxel takes {largest}: give a larger --cache, "
                "or build with a smaller --voxel"
            )
        self.budget_bytes = budget_bytes
        self.buffer = ArenaBuffer(budget_bytes)
        self.where = np.full((len(store.sizes), 3), -1, np.int64)
        self.kept: frozenset[int] = frozenset()
        self.on_owed: Callable[[], None] | None = None
        self.on_loaded: Callable[[int, NDArray[np.int64]], None] | None = None
        self.on_load_time: Callable[[float], None] | None = None
        self.on_proved: Callable[[int], None] | None = None
        self.misled = False
        self._store = store
        self._sizes = [ArenaBuffer.rounded(int(size)) for size in store.sizes]
        self.policy = policy or make_policy("lru", budget_bytes)
        self._allocator = VoxelAllocator(self.buffer, self._sizes, self.where, self.policy)
        self._lock = threading.RLock()
        self._changed = threading.Condition(self._lock)
        self._turns = LoadTurns()
        self._pins: dict[int, int] = {}
        self._loading: set[int] = set()
        self._faults: dict[int, str] = {}  # of corrupt records: permanent
        # Temporary faults. A voxel with one is read again only after all holds on it have ended: it
        # never becomes resident while a kernel runs that began without it.
        self._temporary_faults: dict[int, str] = {}
        # Rows in `_loading` left by a request at its deadline; one that waits takes over the load.
        self._abandoned: set[int] = set()
        self._owed: OrderedDict[int, None] = OrderedDict()
        self._waiting_requests = 0  # number of requests that wait
        self._stats = CacheStats(self._sizes)

    @property
    def resident(self) -> int:
        """Return the number of voxels resident or being loaded."""
        return len(self._allocator.offsets)

    @property
    def resident_bytes(self) -> int:
        """Return the bytes of the voxels resident or being loaded."""
        return self._allocator.used_bytes

    @property
    def hits(self) -> int:
        """Return the number of requested voxels that were resident or being loaded."""
        return self._stats.hits

    @property
    def misses(self) -> int:
        """Return the number of requested voxels that were not resident."""
        return self._stats.misses

    @property
    def evictions(self) -> int:
        """Return the number of voxels evicted to make room for others."""
        return self._allocator.evictions

    def counters(self) -> Counters:
        """Return the statistics of the cache."""
        with self._lock:
            return self._stats.counters(self._allocator.evictions, self._allocator.moved_bytes)

    def load_times(self) -> list[float]:
        """Return the durations of the last loads [s], in no particular order."""
        with self._lock:
            return list(self._stats.times)

    def recent(self) -> list[int]:
        """Return the index rows of the resident voxels, in order of eviction."""
        with self._lock:
            return [row for row in self.policy.victims() if row not in self._loading]

    def is_resident(self, row: int) -> bool:
        """Return whether a voxel is resident or being loaded."""
        return row in self._allocator.offsets

    def bytes_of(self, rows: Sequence[int]) -> int:
        """Return the bytes that these voxels take when resident."""
        return sum(self._sizes[row] for row in rows)

    def parts_that_fit(self, rows: Sequence[int], budget_bytes: int) -> Iterator[list[int]]:
        """Split rows, in order, into parts of at most `budget_bytes` or of one larger row."""
        part: list[int] = []
        taken = 0
        for row in rows:
            size = self._sizes[row]
            if part and taken + size > budget_bytes:
                yield part
                part, taken = [], 0
            part.append(row)
            taken += size
        if part:
            yield part

    # --- requests -----------------------------------------------------------------------------------------

    def hold(
        self, rows: Sequence[int], deadline: float = math.inf, *, scan: bool = False, stop: StopFlag = NO_STOP
    ) -> "Hold":
        """Load the voxels of distinct rows; pin them inside a `with` that yields `HeldVoxels`.

        Together they must fit in the budget. Unreadable voxels stay at -1 in `where` and are named
        in the result's faults; all others are resident. deadline: on time.perf_counter()'s clock
        [s]; voxels not resident by then are `late`. No load begins after it; one that has begun is
        finished.  scan: the voxels are used in passing and should not displace those that others
        use repeatedly (eviction.py).  stop: setting it has the effect of the deadline.
        """
        return Hold(self, rows, deadline, scan, stop)

    def frozen(self) -> AbstractContextManager[bool]:
        """Return the lock that freezes the resident set; hold it for some tens of microseconds."""
        return self._lock

    def use(self, rows: Sequence[int], *, scan: bool = False) -> None:
        """Record a use of resident voxels; call it inside `frozen`."""
        for row in rows:
            self.policy.used(row, scan=scan)
        self._stats.found(rows)

    def acquire(
        self, rows: Sequence[int], deadline: float = math.inf, *, scan: bool = False, stop: StopFlag = NO_STOP
    ) -> HeldVoxels:
        """Begin a hold; the caller must call `release` unless this raises."""
        begin = time.perf_counter()
        turn = self._take_turn(deadline, stop) if self._missing(rows) > LOADS_WITHOUT_TURN else None
        try:
            return self._acquire(rows, deadline, scan, stop, begin)
        finally:
            self._turns.give_back(turn)

    def _missing(self, rows: Sequence[int]) -> int:
        """Return how many rows are neither resident nor being loaded, and have no fault."""
        offsets = self._allocator.offsets
        return sum(row not in offsets and not self._fault(row) for row in rows)

    def _take_turn(self, deadline: float, stop: StopFlag) -> LoadTurn | None:
        """Wait for a turn to load; `_waiting_requests` counts the request meanwhile."""
        with self._changed:
            self._waiting_requests += 1
        try:
            return self._turns.take(deadline, stop)
        finally:
            with self._changed:
                self._waiting_requests -= 1
                self._changed.notify_all()

    def _acquire(
        self, rows: Sequence[int], deadline: float, scan: bool, stop: StopFlag, begin: float
    ) -> HeldVoxels:
        """Begin a hold. begin: time of the call of `acquire` on time.perf_counter()'s clock [s]."""
        mine, hits, waits, settled = self._reserve(rows, deadline, scan, stop)
        if settled:
            return HeldVoxels(len(rows), 0, ())  # all are resident, and the pins keep them so
        try:
            wanted = mine
            while True:
                self._load(wanted, deadline, stop)
                with self._changed:
                    while not self._settled(rows) and self._wait(deadline, stop):
                        pass
                    late_now = seconds_to(deadline, stop) == 0
                    wanted = [] if late_now else [row for row in rows if row in self._abandoned]
                    if not wanted:
                        faults = tuple(fault for row in rows if (fault := self._fault(row)))
                        late = tuple(row for row in rows if not self._fault(row) and not self._is_loaded(row))
                        self._waiting_requests -= 1
                        self._stats.late += len(late)
                        owed = self.on_owed
                        # A request that is stopped before its deadline needs nothing more.
                        if owed is not None and time.perf_counter() >= deadline:
                            self._owed.update(dict.fromkeys(late))
                        self._changed.notify_all()
                        break
                    self._abandoned.difference_update(wanted)
        except BaseException:
            with self._changed:
                self._waiting_requests -= 1
            self.release(rows)
            raise
        if late and owed is not None:
            owed()
        # If the only missing voxels have faults known before this call, the request did not wait.
        waited = time.perf_counter() - begin if mine or waits or late else 0.0
        return HeldVoxels(hits, len(mine), faults, late, waited)

    def _is_loaded(self, row: int) -> bool:
        """Return whether a voxel is resident and completely loaded."""
        return row in self._allocator.offsets and row not in self._loading

    def _settled(self, rows: Sequence[int]) -> bool:
        """Return whether none of these is being loaded, or a load was left to this caller."""
        loading = [row for row in rows if row in self._loading]
        return not loading or any(row in self._abandoned for row in loading)

    def release(self, rows: Sequence[int]) -> None:
        """End a hold."""
        with self._changed:
            self._unpin(rows)
            self._changed.notify_all()

    def _reserve(
        self, rows: Sequence[int], deadline: float, scan: bool, stop: StopFlag
    ) -> tuple[list[int], int, bool, bool]:
        """Pin all rows and make room for those that this caller is to load.

        Return the rows to load, none without room before the deadline; how many others are resident
        or being loaded (a voxel with a fault is neither); whether some are being loaded; and
        whether all are resident: if not, `_waiting_requests` counts this request. No pins if this
        raises.
        """
        if self.bytes_of(rows) > self.buffer.total_bytes:
            raise ValueError(
                f"{len(rows)} voxels take {self.bytes_of(rows)} bytes, over the budget: ask in pieces"
            )
        offsets = self._allocator.offsets
        with self._changed:
            self._pin(rows)
            mine = [row for row in rows if row not in offsets and not self._fault(row)]
            settled = not mine and self._all_loaded(rows)
            if not settled:
                self._waiting_requests += 1
                try:
                    mine = self._make_room(rows, mine, deadline, scan, stop)
                except BaseException:
                    self._waiting_requests -= 1
                    self._changed.notify_all()
                    raise
            new = set(mine)
            there = [row for row in rows if row in offsets and row not in new] if not settled else rows
            for row in there:
                self.policy.used(row, scan=scan)
            self._stats.found(there)
            if settled:
                return [], len(rows), False, True
            self._stats.missed(mine)
            self._stats.waited(there, self._loading)
            waits = not self._loading.isdisjoint(there)
            self._loading.update(mine)
            return mine, len(there), waits, False

    def _all_loaded(self, rows: Sequence[int]) -> bool:
        """Return whether all rows are resident. Each must have allocated bytes or a fault."""
        if self._loading and not self._loading.isdisjoint(rows):
            return False
        return not (self._faults or self._temporary_faults) or not any(map(self._fault, rows))

    def _make_room(
        self, rows: Sequence[int], mine: list[int], deadline: float, scan: bool, stop: StopFlag
    ) -> list[int]:
        """Make room for the rows `mine` among `rows`, which this caller has pinned; wait if needed.

        Return the rows to load, none if the deadline comes before there is room. If this raises,
        the rows are no longer pinned.
        """
        while True:
            try:
                if self._allocate_all(mine, scan):
                    return mine
            except BaseException:
                self._unpin(rows)
                raise
            self._unpin(rows)
            if self._pins or self._loading:
                has_room = self._wait(deadline, stop)
            else:
                # No other request holds anything, but the free runs lie between this caller's
                # voxels.
                self._allocator.evict_all_but(set(rows), self._stats.evicted)
                has_room = True
            self._pin(rows)
            mine = [row for row in rows if row not in self._allocator.offsets and not self._fault(row)]
            if not has_room:
                return []

    def _wait(self, deadline: float, stop: StopFlag) -> bool:
        """Wait until another thread changes the state; return False at the deadline or on stop."""
        while (left := seconds_to(deadline, stop)) != 0:
            if self._changed.wait(left):
                break
        return seconds_to(deadline, stop) != 0

    def _pin(self, rows: Sequence[int]) -> None:
        for row in rows:
            self._pins[row] = self._pins.get(row, 0) + 1

    def _allocate_all(self, rows: list[int], scan: bool) -> bool:
        """Make room for every row, or for none. Voxels at users' positions are evicted last."""
        done = 0
        try:
            for row in rows:
                if not self._make_one(row, scan):
                    break
                done += 1
        finally:
            if done < len(rows):
                for row in rows[:done]:
                    self._allocator.forget(row)
        return done == len(rows)

    def _make_one(self, row: int, scan: bool) -> bool:
        evicted = self._stats.evicted
        return any(
            self._allocator.allocate(row, may_evict, self._free, evicted, scan=scan)
            for may_evict in (self._idle, self._free)
        )

    def _free(self, row: int) -> bool:
        """Return whether no thread uses or loads a voxel."""
        return row not in self._pins and row not in self._loading

    def _idle(self, row: int) -> bool:
        """Return whether a voxel is free and not at a user's position."""
        return row not in self._pins and row not in self._loading and row not in self.kept

    def _unpin(self, rows: Sequence[int]) -> None:
        for row in rows:
            self._pins[row] -= 1
            if not self._pins[row]:
                del self._pins[row]
                self._temporary_faults.pop(row, None)
                if row in self._abandoned:
                    self._drop_abandoned(row)

    def _drop_abandoned(self, row: int) -> None:
        """Release the bytes of a voxel whose load never began."""
        self._abandoned.discard(row)
        self._loading.discard(row)
        self._allocator.forget(row)
        if row in self._owed and self.on_owed is not None:
            self.on_owed()

    def _abandon(self, rows: list[int]) -> None:
        """Leave loads that have not begun to the other requests that hold these rows."""
        with self._changed:
            for row in rows:
                self._abandoned.add(row)
                if self._pins[row] == 1:  # only the caller holds it
                    self._drop_abandoned(row)
            self._changed.notify_all()

    def _fault(self, row: int) -> str:
        """Return why a voxel cannot be read; "" if it has no fault."""
        return self._faults.get(row, "") or self._temporary_faults.get(row, "")

    # --- loads --------------------------------------------------------------------------------------------

    def _load(self, rows: list[int], deadline: float, stop: StopFlag) -> None:
        """Load reserved rows: each leaves `_loading`, loaded or faulty, or is left to others."""
        for number, row in enumerate(rows):
            if seconds_to(deadline, stop) == 0:
                self._abandon(rows[number:])
                return
            try:
                self._load_one(row)
            except BaseException as error:
                with self._changed:
                    for left in rows[number + 1 :]:
                        self._fail(left, f"not loaded ({error!r}): ask again")
                    self._changed.notify_all()
                raise

    def _load_one(self, row: int) -> bool:
        """Load a voxel whose bytes are allocated; return whether it is resident then."""
        begin, where, fault, corrupt = time.perf_counter(), None, "", False
        try:
            where = self._store.load(row, self.buffer.arena, self._allocator.offsets[row])
            if self.on_proved is not None:
                self.on_proved(row)
            if self.on_loaded is not None:
                self.on_loaded(row, where)  # now: it may be evicted once it is visible to others
        except CorruptError as error:
            fault, corrupt = str(error), True
            self.misled |= isinstance(error, MisleadingIndexError)
        except OSError as error:
            fault = f"cannot be read ({error}): check the disk"
        except BaseException as error:
            with self._changed:
                self._fail(row, f"not loaded ({error!r}): ask again")
                self._changed.notify_all()
            raise
        with self._changed:
            if where is None:
                self._fail(row, fault, corrupt=corrupt)
            else:
                self.where[row] = where
                self._loading.discard(row)
                self._stats.times.append(seconds := time.perf_counter() - begin)
            self._changed.notify_all()
        if where is not None and self.on_load_time is not None:
            self.on_load_time(seconds)
        return where is not None

    def _fail(self, row: int, fault: str, *, corrupt: bool = False) -> None:
        """Record a failed load: permanently if `corrupt`, else for requests that hold the row."""
        self._stats.lost(row)
        self._allocator.forget(row)
        self._loading.discard(row)
        if corrupt:
            self._faults[row] = fault
        elif row in self._pins:
            self._temporary_faults[row] = f"{self._store.archive.where(row)}: {fault}"

    def take_owed(self) -> int | None:
        """Return the voxel whose load has been owed longest; None if no load is owed."""
        with self._lock:
            for row in list(self._owed):
                if row in self._abandoned:  # a waiting request may load it; if none does, it is owed again
                    continue
                del self._owed[row]
                if row not in self._allocator.offsets and not self._fault(row):
                    return row
        return None

    def wait_until_idle(self) -> None:
        """Wait until no request waits for voxels."""
        with self._changed:
            while self._waiting_requests:
                self._changed.wait()

    def load_in_background(
        self, row: int, may_evict: Callable[[int], bool], *, owed: bool = False
    ) -> BackgroundLoad:
        """Load a voxel that no request waits for; unless it is owed, once no request waits at all.

        may_evict: whether a voxel, neither used nor at a user's position, may be evicted for it.
        owed: whether a request asked for it. Raise load errors that are no faults of the record.
        """
        with self._changed:
            if not owed:
                self.wait_until_idle()
            if row in self._allocator.offsets or self._fault(row):
                return BackgroundLoad.RESIDENT if row in self._allocator.offsets else BackgroundLoad.FAILED
            if not self._allocator.allocate(
                row, lambda other: self._idle(other) and may_evict(other), self._free, self._stats.evicted, scan=False,
                most=MOST_CANDIDATES,
            ):  # fmt: skip
                return BackgroundLoad.NO_ROOM
            self._loading.add(row)
            if not owed:
                self._stats.begun_ahead(row)
        return BackgroundLoad.RESIDENT if self._load_one(row) else BackgroundLoad.FAILED

    def check(self) -> None:
        """Assert the invariants: bytes add up, and runs neither overlap nor leave the buffer."""
        with self._changed:
            self._allocator.check()
            offsets = set(self._allocator.offsets)
            resident = {int(row) for row in np.flatnonzero(self.where[:, 0] >= 0)}
            assert resident == offsets - self._loading
            assert self._abandoned <= self._loading <= offsets and self._abandoned <= set(self._pins)
            assert all(count > 0 for count in self._pins.values())
            assert self._stats.fresh <= offsets and self._waiting_requests >= 0
            self._stats.check()
