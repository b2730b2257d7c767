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
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager

import numpy as np

from ...schemas.errors import CorruptError, MisleadingIndexError
from ..runtime.stop_flag import NO_STOP, StopFlag, seconds_to
from .arena import ArenaBuffer
from .eviction import EvictionPolicy
from .load_turns import LOADS_WITHOUT_TURN, LoadTurn, LoadTurns
from .voxel_states import BackgroundLoad, CacheFacts, HeldVoxels, Hold, VoxelStates, voxel_sizes
from .voxel_store import VoxelStore


class VoxelCache(CacheFacts):
    """Resident voxels of one scene. Thread-safe.

    where: (v, 3) int64, a voxel's runs in the arena, -1 if not resident; kernels read it directly.
    on_owed: called when a load is owed to a request whose deadline came first, see `take_owed`.
    on_proved: called with the row of each loaded voxel, whose record matches the index, by the loading
    thread, before the voxel is visible to other threads.  on_load_time: called after each load with its duration [s].
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
        sizes = voxel_sizes(store.sizes, budget_bytes, refuse_large=refuse_large)
        self.budget_bytes = budget_bytes
        self.buffer = ArenaBuffer(budget_bytes)
        self.where = np.full((len(store.sizes), 3), -1, np.int64)
        self.on_owed: Callable[[], None] | None = None
        self.on_load_time: Callable[[float], None] | None = None
        self.on_proved: Callable[[int], None] | None = None
        self.misled = False
        self._store = store
        self._sizes = [size if size <= budget_bytes else 0 for size in sizes]
        self.policy = policy or EvictionPolicy(budget_bytes)
        self._states = VoxelStates(self.buffer, self._sizes, self.where, self.policy, store.archive.where)
        self._states.refuse_larger(sizes, budget_bytes)
        self.stats = self._states.stats
        self._lock = threading.RLock()
        self._changed = threading.Condition(self._lock)
        self._turns = LoadTurns()
        self._waiting_requests = 0  # number of requests that wait

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
        repeatedly (eviction.py).
        stop: setting it has the effect of the deadline.
        """
        return Hold(self, rows, deadline, scan, stop)

    def frozen(self) -> AbstractContextManager[bool]:
        """Return the lock that freezes the resident set; hold it for some tens of microseconds."""
        return self._lock

    def use(self, rows: Sequence[int], *, scan: bool = False) -> None:
        """Record a use of resident voxels; call it inside `frozen`."""
        stats = self.stats
        for row in rows:
            self.policy.used(row, scan=scan)
        stats.hits += len(rows)
        if stats.fresh:
            stats.count_used(rows)

    def acquire(
        self, rows: Sequence[int], deadline: float = math.inf, *, scan: bool = False, stop: StopFlag = NO_STOP
    ) -> HeldVoxels:
        """Begin a hold; the caller must call `release` unless this raises."""
        if deadline == -math.inf:
            return self._acquire_resident(rows, scan)
        begin = time.perf_counter()
        many = len(self._states.missing(rows)) > LOADS_WITHOUT_TURN
        turn = self._take_turn(deadline, stop) if many else None
        try:
            return self._acquire(rows, deadline, scan, stop, begin)
        finally:
            if turn is not None:
                self._turns.give_back(turn)

    def _acquire_resident(self, rows: Sequence[int], scan: bool) -> HeldVoxels:
        """Begin a hold on the voxels that are resident; the loads of the others are owed."""
        with self._changed:
            self._states.pin(rows)
            there, faults, late = self._states.sort_out(rows)
            self.use(there, scan=scan)
            self.stats.late += len(late)
            if self.on_owed is not None:
                self._states.owed.update(dict.fromkeys(late))
        if late:
            self._notify_owed()
        return HeldVoxels(len(there), 0, faults, late)

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
        states = self._states
        mine, hits, waits, settled = self._reserve(rows, deadline, scan, stop)
        if settled:
            return HeldVoxels(len(rows), 0, ())  # all are resident and pinned
        try:
            wanted = mine
            # Each further round does loads that other requests abandoned at their deadlines.
            while True:
                self._load(wanted, deadline, stop)
                with self._changed:
                    while not states.settled(rows) and self._wait(deadline, stop):
                        pass
                    late_now = seconds_to(deadline, stop) == 0
                    wanted = [] if late_now else [row for row in rows if row in states.abandoned]
                    if not wanted:
                        faults = tuple(fault for row in rows if (fault := states.fault(row)))
                        late = tuple(
                            row for row in rows if not (states.fault(row) or states.is_resident(row))
                        )
                        self._waiting_requests -= 1
                        self.stats.late += len(late)
                        # A request that is stopped before its deadline needs nothing more.
                        if self.on_owed is not None and late and time.perf_counter() >= deadline:
                            states.owed.update(dict.fromkeys(late))
                        states.is_owed_free |= bool(late)
                        self._changed.notify_all()
                        break
                    states.abandoned.difference_update(wanted)
        except BaseException:
            with self._changed:
                self._waiting_requests -= 1
            self.release(rows)
            raise
        if states.is_owed_free:
            self._notify_owed()
        # If the only missing voxels have faults known before this call, the request did not wait.
        waited = time.perf_counter() - begin if mine or waits or late else 0.0
        return HeldVoxels(hits, len(mine), faults, late, waited)

    def release(self, rows: Sequence[int]) -> None:
        """End a hold."""
        with self._changed:
            self._states.unpin(rows)
            self._changed.notify_all()
        if self._states.is_owed_free:
            self._notify_owed()

    def _notify_owed(self) -> None:
        """Call `on_owed`, which may start a thread, without the lock."""
        self._states.is_owed_free = False
        on_owed = self.on_owed
        if on_owed is not None:
            on_owed()

    def _reserve(
        self, rows: Sequence[int], deadline: float, scan: bool, stop: StopFlag
    ) -> tuple[list[int], int, bool, bool]:
        """Pin all rows and make room for those that this caller is to load.

        Return

        - the rows to load; none if there is no room before the deadline,
        - the number of other rows that are resident or being loaded (not those with a fault),
        - whether other threads are loading some of the rows,
        - whether all rows are resident. If not, `_waiting_requests` counts this request.

        If this raises, nothing is pinned.
        """
        taken = self.bytes_of(rows)
        if taken > self.buffer.total_bytes:
            raise ValueError(f"{len(rows)} voxels take {taken} bytes, over the budget: ask in pieces")
        states, offsets = self._states, self._states.allocator.offsets
        with self._changed:
            states.pin(rows)
            mine = states.missing(rows)
            settled = not mine and states.all_resident(rows)
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
            self.use(there, scan=scan)
            if settled:
                return [], len(rows), False, True
            self.stats.missed(mine)
            self.stats.waited(there, states.loading)
            waits = not states.loading.isdisjoint(there)
            states.loading.update(mine)
            return mine, len(there), waits, False

    def _make_room(
        self, rows: Sequence[int], mine: list[int], deadline: float, scan: bool, stop: StopFlag
    ) -> list[int]:
        """Make room for the rows `mine` among `rows`, which this caller has pinned; wait if needed.

        Return the rows to load, none if the deadline comes before there is room. If this raises,
        the rows are no longer pinned.
        """
        states = self._states
        while True:
            try:
                if states.allocate_all(mine, scan):
                    return mine
            except BaseException:
                states.unpin(rows)
                raise
            states.unpin(rows)
            if states.pins or states.loading:
                has_room = self._wait(deadline, stop)
            else:
                # No other request holds anything: this caller's voxels lie between the free runs.
                states.evict_all_but(rows)
                has_room = True
            states.pin(rows)
            mine = states.missing(rows)
            if not has_room:
                return []

    def _wait(self, deadline: float, stop: StopFlag) -> bool:
        """Wait until another thread changes the state; return False at the deadline or on stop."""
        while (left := seconds_to(deadline, stop)) != 0:
            if self._changed.wait(left):
                break
        return seconds_to(deadline, stop) != 0

    def _abandon(self, rows: list[int]) -> None:
        """Leave loads that have not begun to the other requests that hold these rows."""
        with self._changed:
            self._states.abandon(rows)
            self._changed.notify_all()

    def _load(self, rows: list[int], deadline: float, stop: StopFlag) -> None:
        """Load reserved rows: each is resident or faulty afterwards, or is left to others."""
        for number, row in enumerate(rows):
            if seconds_to(deadline, stop) == 0:
                self._abandon(rows[number:])
                return
            try:
                self._load_one(row)
            except BaseException as error:
                with self._changed:
                    for left in rows[number + 1 :]:
                        self._states.fail(left, f"not loaded ({error!r}): ask again")
                    self._changed.notify_all()
                raise

    def _load_one(self, row: int) -> bool:
        """Load a voxel whose bytes are allocated; return whether it is resident then."""
        begin, where, fault, corrupt = time.perf_counter(), None, "", False
        try:
            where = self._store.load(row, self.buffer.arena, self._states.allocator.offsets[row])
            if self.on_proved is not None:
                self.on_proved(row)
        except CorruptError as error:
            fault, corrupt = str(error), True
            self.misled |= isinstance(error, MisleadingIndexError)
        except OSError as error:
            fault = f"cannot be read ({error}): check the disk"
        except BaseException as error:
            with self._changed:
                self._states.fail(row, f"not loaded ({error!r}): ask again")
                self._changed.notify_all()
            raise
        with self._changed:
            if where is None:
                self._states.fail(row, fault, corrupt=corrupt)
            else:
                self._states.end_load(row, where, seconds := time.perf_counter() - begin)
            self._changed.notify_all()
        if where is not None and self.on_load_time is not None:
            self.on_load_time(seconds)
        return where is not None

    def take_owed(self) -> int | None:
        """Return the voxel whose load has been owed longest; None if no load is owed."""
        with self._lock:
            return self._states.take_owed()

    def wait_until_idle(self) -> None:
        """Wait until no request waits for voxels."""
        with self._changed:
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
        with self._changed:
            if not owed:
                self.wait_until_idle()
            states = self._states
            if row in states.allocator.offsets:
                return BackgroundLoad.RESIDENT
            if states.fault(row):
                return BackgroundLoad.FAILED
            if not states.allocate_for_prefetch(row, may_evict):
                return BackgroundLoad.NO_ROOM
            states.loading.add(row)
            if not owed:
                self.stats.begun_ahead(row)
        return BackgroundLoad.RESIDENT if self._load_one(row) else BackgroundLoad.FAILED

    def check(self) -> None:
        """Assert the invariants of the states between two operations."""
        with self._changed:
            self._states.check()
            assert self._waiting_requests >= 0
