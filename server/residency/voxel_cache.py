"""Resident voxels: decoded, never more than `budget_bytes`; who holds them, and who loads them.

[Fig12] section 4: "neighbour voxels to a user's position loaded and uncompressed into a LRU queue". One load
for a voxel however many wait for it; what a request uses is pinned until it is answered. Which voxel goes first is the
policy's (eviction.py), which bytes it has the room's (allocator.py), and what is loaded before anybody asks for it the
prefetcher's (prefetch.py).

A request takes all its voxels or none: it never waits for room while holding pins, so two requests that each
hold half of what the other needs cannot wait for each other for ever.
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
from ..runtime.stop_flag import NEVER, Stop, seconds_to
from .allocator import Room
from .arena import ArenaBuffer
from .cache_stats import Accounts
from .eviction import Policy, make_policy
from .held import Ahead, Held
from .load_turns import LoadTurn, LoadTurns
from .voxel_store import Store

# Voxels that are looked at to find room for one that nobody waits for.
MOST_CANDIDATES = 256


class Hold:
    """A hold on voxels, for a `with`; a class and not a generator, which costs a request twice as much."""

    __slots__ = ("_deadline", "_residency", "_rows", "_scan", "_stop")

    def __init__(
        self, residency: "Residency", rows: Sequence[int], deadline: float, scan: bool, stop: Stop
    ) -> None:
        """Use `Residency.hold`."""
        self._residency, self._rows, self._deadline, self._scan = residency, rows, deadline, scan
        self._stop = stop

    def __enter__(self) -> Held:
        """Wait until all that can be read is resident, or the deadline."""
        return self._residency.acquire(self._rows, self._deadline, scan=self._scan, stop=self._stop)

    def __exit__(self, *_: object) -> None:
        """Let the voxels go."""
        self._residency.release(self._rows)


class Residency:
    """The resident voxels of one scene. Thread-safe.

    where: (v, 3) int64, a voxel's runs in the arena, -1 when not resident; the kernels read it directly.
    kept: rows that users stand in: they go only when a request would not fit otherwise.  owed: called when a load is
    owed to a request whose deadline came first, see `take_owed`.  loaded: called with the row and where it is of each
    voxel that was loaded, by the thread that did, before others know of it; took: then, with the seconds it took.
    proved: called with the row of each voxel that was loaded, before others know of it.
    misled: whether a record that was loaded has points that the index places elsewhere. Voxels are chosen by the index,
    so after that it is not known what else was not chosen.
    """

    def __init__(self, store: Store, budget_bytes: int, policy: Policy | None = None) -> None:
        """Reserve budget_bytes for the voxels of `store`. policy: least recently used where left out.

        Raises BadRequestError when one voxel alone is larger.
        """
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
        self.owed: Callable[[], None] | None = None
        self.loaded: Callable[[int, NDArray[np.int64]], None] | None = None
        self.took: Callable[[float], None] | None = None
        self.proved: Callable[[int], None] | None = None
        self.misled = False
        self._store = store
        self._sizes = [ArenaBuffer.rounded(int(size)) for size in store.sizes]
        self.policy = policy or make_policy("lru", budget_bytes)
        self._room = Room(self.buffer, self._sizes, self.where, self.policy)
        self._lock = threading.RLock()
        self._changed = threading.Condition(self._lock)
        self._turns = LoadTurns()
        self._pins: dict[int, int] = {}
        self._loading: set[int] = set()
        self._faults: dict[int, str] = {}  # of corrupt records, which reading again would not mend
        # Of voxels that could not be read this once. Tried again only when nobody holds them any more: a voxel never
        # becomes resident under a kernel that has begun without it.
        self._passing: dict[int, str] = {}
        # Of those in `_loading`: reserved by one whose deadline came before the load began. Who waits takes it over.
        self._left: set[int] = set()
        self._owed: OrderedDict[int, None] = OrderedDict()
        self._demands = 0  # requests that wait
        self._accounts = Accounts(self._sizes)

    @property
    def resident(self) -> int:
        """The number of voxels resident or being loaded."""
        return len(self._room.offsets)

    @property
    def resident_bytes(self) -> int:
        """Their bytes."""
        return self._room.used_bytes

    @property
    def hits(self) -> int:
        """Voxels asked for and there, or being loaded."""
        return self._accounts.hits

    @property
    def misses(self) -> int:
        """Voxels asked for and not there."""
        return self._accounts.misses

    @property
    def evictions(self) -> int:
        """Voxels that went for others."""
        return self._room.evictions

    def counters(self) -> Counters:
        """What was done so far."""
        with self._lock:
            return self._accounts.counters(self._room.evictions, self._room.moved_bytes)

    def load_times(self) -> list[float]:
        """The seconds that the last loads took, in no order."""
        with self._lock:
            return list(self._accounts.times)

    def recent(self) -> list[int]:
        """The index rows of the resident voxels, those that would stay longest at the end."""
        with self._lock:
            return [row for row in self.policy.victims() if row not in self._loading]

    def is_resident(self, row: int) -> bool:
        """Whether a voxel is resident or being loaded."""
        return row in self._room.offsets

    def bytes_of(self, rows: Sequence[int]) -> int:
        """Bytes these voxels take when resident."""
        return sum(self._sizes[row] for row in rows)

    def parts_that_fit(self, rows: Sequence[int], budget_bytes: int) -> Iterator[list[int]]:
        """Cut rows, in their order, into parts that take at most so many bytes, but for a row that alone takes more."""
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

    # --- what a request does ------------------------------------------------------------------------------

    def hold(
        self, rows: Sequence[int], deadline: float = math.inf, *, scan: bool = False, stop: Stop = NEVER
    ) -> "Hold":
        """Make the voxels of distinct index rows resident and keep them so inside a `with`, which gives a `Held`.

        Together they must fit the budget. Voxels that cannot be read stay at -1 in `where` and are named in
        the result's faults; everything else is resident. deadline: on time.perf_counter()'s clock [s]; what is not
        resident by then is `late`. No load is begun after it, one that has begun is finished.  scan: these are passed
        by, not stayed with: they had better not take the place of what others stay with (eviction.py).  stop: once it
        is set the deadline has come.
        """
        return Hold(self, rows, deadline, scan, stop)

    def still(self) -> AbstractContextManager[bool]:
        """For a `with` inside which what is resident stays so, and nobody else goes on: for tens of microseconds."""
        return self._lock

    def use(self, rows: Sequence[int], *, scan: bool = False) -> None:
        """Count resident voxels as used just now; inside `still`."""
        for row in rows:
            self.policy.used(row, scan=scan)
        self._accounts.found(rows)

    def acquire(
        self, rows: Sequence[int], deadline: float = math.inf, *, scan: bool = False, stop: Stop = NEVER
    ) -> Held:
        """Begin a hold; `release` must follow, unless this raises."""
        begin = time.perf_counter()
        turn = None if self._have_room(rows) else self._take_turn(deadline, stop)
        try:
            return self._acquire(rows, deadline, scan, stop, begin)
        finally:
            self._turns.give_back(turn)

    def _have_room(self, rows: Sequence[int]) -> bool:
        """Return whether each of these is resident or being loaded, or has a fault."""
        offsets = self._room.offsets
        return all(row in offsets or self._fault(row) for row in rows)

    def _take_turn(self, deadline: float, stop: Stop) -> LoadTurn | None:
        """Wait for a turn to load; the request counts as one that waits."""
        with self._changed:
            self._demands += 1
        try:
            return self._turns.take(deadline, stop)
        finally:
            with self._changed:
                self._demands -= 1
                self._changed.notify_all()

    def _acquire(self, rows: Sequence[int], deadline: float, scan: bool, stop: Stop, begin: float) -> Held:
        """Begin a hold. begin: when it was asked for, on time.perf_counter()'s clock [s]."""
        mine, hits, waits, settled = self._reserve(rows, deadline, scan, stop)
        if settled:
            return Held(len(rows), 0, ())  # all resident and pinned: nothing can change that
        try:
            wanted = mine
            while True:
                self._load(wanted, deadline, stop)
                with self._changed:
                    while not self._settled(rows) and self._wait(deadline, stop):
                        pass
                    late_now = seconds_to(deadline, stop) == 0
                    wanted = [] if late_now else [row for row in rows if row in self._left]
                    if not wanted:
                        faults = tuple(fault for row in rows if (fault := self._fault(row)))
                        late = tuple(row for row in rows if not self._fault(row) and not self._there(row))
                        self._demands -= 1
                        self._accounts.late += len(late)
                        owed = self.owed
                        # A request that is stopped before its deadline needs nothing more.
                        if owed is not None and time.perf_counter() >= deadline:
                            self._owed.update(dict.fromkeys(late))
                        self._changed.notify_all()
                        break
                    self._left.difference_update(wanted)
        except BaseException:
            with self._changed:
                self._demands -= 1
            self.release(rows)
            raise
        if late and owed is not None:
            owed()
        # Where all that is not there has long been known not to be readable, nothing was waited for.
        waited = time.perf_counter() - begin if mine or waits or late else 0.0
        return Held(hits, len(mine), faults, late, waited)

    def _there(self, row: int) -> bool:
        """Whether a voxel is resident and whole."""
        return row in self._room.offsets and row not in self._loading

    def _settled(self, rows: Sequence[int]) -> bool:
        """Whether nobody loads any of these, or one was left to be loaded."""
        loading = [row for row in rows if row in self._loading]
        return not loading or any(row in self._left for row in loading)

    def release(self, rows: Sequence[int]) -> None:
        """End a hold."""
        with self._changed:
            self._unpin(rows)
            self._changed.notify_all()

    def _reserve(
        self, rows: Sequence[int], deadline: float, scan: bool, stop: Stop
    ) -> tuple[list[int], int, bool, bool]:
        """Pin all rows and make room for those to be loaded by this caller; none where there is no room in time.

        Returns these, how many of the others are resident or being loaded (a voxel with a fault is neither), whether
        some of them are being loaded, and whether all is there; where not, `_demands` counts this request until it is.
        Nothing is pinned where this raises.
        """
        if self.bytes_of(rows) > self.buffer.total_bytes:
            raise ValueError(
                f"{len(rows)} voxels take {self.bytes_of(rows)} bytes, over the budget: ask in pieces"
            )
        offsets = self._room.offsets
        with self._changed:
            self._pin(rows)
            mine = [row for row in rows if row not in offsets and not self._fault(row)]
            settled = not mine and self._all_there(rows)
            if not settled:
                self._demands += 1
                try:
                    mine = self._make_room(rows, mine, deadline, scan, stop)
                except BaseException:
                    self._demands -= 1
                    self._changed.notify_all()
                    raise
            new = set(mine)
            there = [row for row in rows if row in offsets and row not in new] if not settled else rows
            for row in there:
                self.policy.used(row, scan=scan)
            self._accounts.found(there)
            if settled:
                return [], len(rows), False, True
            self._accounts.missed(mine)
            self._accounts.waited(there, self._loading)
            waits = not self._loading.isdisjoint(there)
            self._loading.update(mine)
            return mine, len(there), waits, False

    def _all_there(self, rows: Sequence[int]) -> bool:
        """Whether none of these, all of which have room or a fault, has a fault or is being loaded."""
        if self._loading and not self._loading.isdisjoint(rows):
            return False
        return not (self._faults or self._passing) or not any(map(self._fault, rows))

    def _make_room(
        self, rows: Sequence[int], mine: list[int], deadline: float, scan: bool, stop: Stop
    ) -> list[int]:
        """Room for `mine`, of `rows` that are pinned by this caller; returns those it is to load. It may wait.

        None of them where the deadline comes before there is room. The rows are not pinned where this raises.
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
                roomy = self._wait(deadline, stop)
            else:
                # Nobody else holds anything, and yet the room is in pieces between our own voxels.
                self._room.leave_only(set(rows), self._accounts.evicted)
                roomy = True
            self._pin(rows)
            mine = [row for row in rows if row not in self._room.offsets and not self._fault(row)]
            if not roomy:
                return []

    def _wait(self, deadline: float, stop: Stop) -> bool:
        """Wait until another thread has changed something; return False when the time is up or the stop is set."""
        while (left := seconds_to(deadline, stop)) != 0:
            if self._changed.wait(left):
                break
        return seconds_to(deadline, stop) != 0

    def _pin(self, rows: Sequence[int]) -> None:
        for row in rows:
            self._pins[row] = self._pins.get(row, 0) + 1

    def _allocate_all(self, rows: list[int], scan: bool) -> bool:
        """Make room for every row; all or nothing. What users stand in goes last."""
        done = 0
        try:
            for row in rows:
                if not self._make_one(row, scan):
                    break
                done += 1
        finally:
            if done < len(rows):
                for row in rows[:done]:
                    self._room.forget(row)
        return done == len(rows)

    def _make_one(self, row: int, scan: bool) -> bool:
        """Make room for a row that is asked for."""
        evicted = self._accounts.evicted
        return any(
            self._room.make(row, may_go, self._free, evicted, scan=scan)
            for may_go in (self._idle, self._free)
        )

    def _free(self, row: int) -> bool:
        """Whether nobody uses or loads a voxel."""
        return row not in self._pins and row not in self._loading

    def _idle(self, row: int) -> bool:
        """Whether also no user stands in it."""
        return row not in self._pins and row not in self._loading and row not in self.kept

    def _unpin(self, rows: Sequence[int]) -> None:
        for row in rows:
            self._pins[row] -= 1
            if not self._pins[row]:
                del self._pins[row]
                self._passing.pop(row, None)
                if row in self._left:
                    self._drop_left(row)

    def _drop_left(self, row: int) -> None:
        """Give back the room of a voxel whose load never began."""
        self._left.discard(row)
        self._loading.discard(row)
        self._room.forget(row)
        if row in self._owed and self.owed is not None:
            self.owed()

    def _leave(self, rows: list[int]) -> None:
        """Leave loads that have not begun to whoever else holds these rows."""
        with self._changed:
            for row in rows:
                self._left.add(row)
                if self._pins[row] == 1:  # nobody but the caller
                    self._drop_left(row)
            self._changed.notify_all()

    def _fault(self, row: int) -> str:
        """Why a voxel cannot be read, or ""."""
        return self._faults.get(row, "") or self._passing.get(row, "")

    # --- loads --------------------------------------------------------------------------------------------

    def _load(self, rows: list[int], deadline: float, stop: Stop) -> None:
        """Load what this caller reserved; every row leaves `_loading`, loaded or with a fault, or is left to others."""
        for number, row in enumerate(rows):
            if seconds_to(deadline, stop) == 0:
                self._leave(rows[number:])
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
        """Load a voxel that room was made for; whether it is there then."""
        begin, where, fault, corrupt = time.perf_counter(), None, "", False
        try:
            where = self._store.load(row, self.buffer.arena, self._room.offsets[row])
            if self.proved is not None:
                self.proved(row)
            if self.loaded is not None:
                self.loaded(row, where)  # now, for it may go as soon as others know of it
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
                self._accounts.times.append(seconds := time.perf_counter() - begin)
            self._changed.notify_all()
        if where is not None and self.took is not None:
            self.took(seconds)
        return where is not None

    def _fail(self, row: int, fault: str, *, corrupt: bool = False) -> None:
        """A load ended without a voxel. Who holds it is told; nobody else, unless it will always be so."""
        self._accounts.lost(row)
        self._room.forget(row)
        self._loading.discard(row)
        if corrupt:
            self._faults[row] = fault
        elif row in self._pins:
            self._passing[row] = f"{self._store.archive.where(row)}: {fault}"

    def take_owed(self) -> int | None:
        """A voxel whose load is owed, the longest first; None where none is."""
        with self._lock:
            for row in list(self._owed):
                if row in self._left:  # whoever still waits for it may load it; dropped, it is owed again
                    continue
                del self._owed[row]
                if row not in self._room.offsets and not self._fault(row):
                    return row
        return None

    def wait_for_nobody(self) -> None:
        """Wait until no request waits for anything."""
        with self._changed:
            while self._demands:
                self._changed.wait()

    def load_ahead(self, row: int, may_go: Callable[[int], bool], *, owed: bool = False) -> Ahead:
        """Load a voxel that nobody waits for, once no request waits for anything; one that is owed at once.

        may_go: whether a resident voxel may go for it, besides that nobody uses it or stands in it.  owed: somebody has
        asked for it. Raises what a load raises that is no fault of the record.
        """
        with self._changed:
            if not owed:
                self.wait_for_nobody()
            if row in self._room.offsets or self._fault(row):
                return Ahead.THERE if row in self._room.offsets else Ahead.FAILED
            if not self._room.make(
                row, lambda other: self._idle(other) and may_go(other), self._free, self._accounts.evicted, scan=False,
                most=MOST_CANDIDATES,
            ):  # fmt: skip
                return Ahead.NO_ROOM
            self._loading.add(row)
            if not owed:
                self._accounts.begun_ahead(row)
        return Ahead.THERE if self._load_one(row) else Ahead.FAILED

    def check(self) -> None:
        """Assert what must always hold: bytes add up, runs neither overlap nor leave the buffer."""
        with self._changed:
            self._room.check()
            offsets = set(self._room.offsets)
            resident = {int(row) for row in np.flatnonzero(self.where[:, 0] >= 0)}
            assert resident == offsets - self._loading
            assert self._left <= self._loading <= offsets and self._left <= set(self._pins)
            assert all(count > 0 for count in self._pins.values())
            assert self._accounts.fresh <= offsets and self._demands >= 0
            self._accounts.check()
