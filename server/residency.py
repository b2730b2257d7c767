"""Resident voxels: decoded, least recently used first to go, never more than `budget_bytes`.

[Fig12] section 4: "neighbour voxels to a user's position loaded and uncompressed into a LRU queue". One load
for a voxel however many wait for it; what a request uses is pinned until it is answered.

A request takes all its voxels or none: it never waits for room while holding pins, so two requests that each
hold half of what the other needs cannot wait for each other for ever.
"""

import math
import threading
import time
from collections import OrderedDict
from collections.abc import Sequence
from contextlib import AbstractContextManager
from typing import NamedTuple

import numpy as np

from ..schemas.errors import BadRequestError, CorruptError
from .arena import ArenaBuffer
from .store import Store


class Held(NamedTuple):
    """What a hold found. hits, misses: voxels resident before, and not.  faults: one sentence an unreadable voxel.

    late: rows that were not resident by the deadline. They may become so while held: read `where` without them
    (`request.as_held`).
    """

    hits: int
    misses: int
    faults: tuple[str, ...]
    late: tuple[int, ...] = ()


class Hold:
    """A hold on voxels, for a `with`; a class and not a generator, which costs a request twice as much."""

    __slots__ = ("_deadline", "_residency", "_rows")

    def __init__(self, residency: "Residency", rows: Sequence[int], deadline: float) -> None:
        """Use `Residency.hold`."""
        self._residency, self._rows, self._deadline = residency, rows, deadline

    def __enter__(self) -> Held:
        """Wait until all that can be read is resident, or the deadline."""
        return self._residency.acquire(self._rows, self._deadline)

    def __exit__(self, *_: object) -> None:
        """Let the voxels go."""
        self._residency.release(self._rows)


def _seconds_to(deadline: float) -> float | None:
    """Seconds left, 0 when there are none and never more than a lock can be waited for; None: no deadline."""
    if deadline == math.inf:
        return None
    return min(max(0.0, deadline - time.perf_counter()), threading.TIMEOUT_MAX)


class Residency:
    """The resident voxels of one scene. Thread-safe.

    where: (v, 3) int64, a voxel's runs in the arena, -1 when not resident; the kernels read it directly.
    """

    def __init__(self, store: Store, budget_bytes: int) -> None:
        """Reserve budget_bytes for the voxels of `store`. Raises BadRequestError when one voxel alone is larger."""
        largest = ArenaBuffer.rounded(int(store.sizes.max(initial=0)))
        if budget_bytes < largest:
            raise BadRequestError(
                f"cache of {budget_bytes} bytes: the largest voxel takes {largest}: give a larger --cache, "
                "or build with a smaller --voxel"
            )
        self.budget_bytes = budget_bytes
        self.buffer = ArenaBuffer(budget_bytes)
        self.where = np.full((len(store.sizes), 3), -1, np.int64)
        self._store = store
        self._sizes = [ArenaBuffer.rounded(int(size)) for size in store.sizes]
        self._lock = threading.RLock()
        self._changed = threading.Condition(self._lock)
        self._offsets: OrderedDict[int, int] = OrderedDict()  # row -> offset; least recently used first
        self._pins: dict[int, int] = {}
        self._loading: set[int] = set()
        self._faults: dict[int, str] = {}  # of corrupt records, which reading again would not mend
        # Of voxels that could not be read this once. Tried again only when nobody holds them any more: a voxel never
        # becomes resident under a kernel that has begun without it.
        self._passing: dict[int, str] = {}
        # Of those in `_loading`: reserved by one whose deadline came before the load began. Who waits takes it over.
        self._left: set[int] = set()
        self.resident_bytes = 0
        self.hits = 0
        self.misses = 0
        self.evictions = 0

    @property
    def resident(self) -> int:
        """The number of voxels resident or being loaded."""
        return len(self._offsets)

    def recent(self) -> list[int]:
        """The index rows of the resident voxels, those used last at the end."""
        with self._lock:
            return [row for row in self._offsets if row not in self._loading]

    def bytes_of(self, rows: Sequence[int]) -> int:
        """Bytes these voxels take when resident."""
        return sum(self._sizes[row] for row in rows)

    def hold(self, rows: Sequence[int], deadline: float = math.inf) -> "Hold":
        """Make the voxels of distinct index rows resident and keep them so inside a `with`, which gives a `Held`.

        Together they must fit the budget. Voxels that cannot be read stay at -1 in `where` and are named in
        the result's faults; everything else is resident. deadline: on time.perf_counter()'s clock [s]; what is not
        resident by then is `late`. No load is begun after it, one that has begun is finished.
        """
        return Hold(self, rows, deadline)

    def still(self) -> AbstractContextManager[bool]:
        """For a `with` inside which what is resident stays so, and nobody else goes on: for tens of microseconds."""
        return self._lock

    def use(self, rows: Sequence[int]) -> None:
        """Count resident voxels as used just now; inside `still`."""
        for row in rows:
            self._offsets.move_to_end(row)
        self.hits += len(rows)

    def acquire(self, rows: Sequence[int], deadline: float = math.inf) -> Held:
        """Begin a hold; `release` must follow, unless this raises."""
        mine, hits, roomy = self._reserve(rows, deadline)
        if roomy and not mine and not self._loading and not self._faults and not self._passing:
            return Held(len(rows), 0, ())  # all resident and pinned: nothing can change that
        try:
            wanted = mine
            while True:
                self._load(wanted, deadline)
                with self._changed:
                    self._changed.wait_for(lambda: self._settled(rows), _seconds_to(deadline))
                    wanted = [row for row in rows if row in self._left] if _seconds_to(deadline) != 0 else []
                    if not wanted:
                        faults = tuple(fault for row in rows if (fault := self._fault(row)))
                        late = tuple(row for row in rows if not self._fault(row) and not self._there(row))
                        break
                    self._left.difference_update(wanted)
        except BaseException:
            self.release(rows)
            raise
        return Held(hits, len(mine), faults, late)

    def _there(self, row: int) -> bool:
        """Whether a voxel is resident and whole."""
        return row in self._offsets and row not in self._loading

    def _settled(self, rows: Sequence[int]) -> bool:
        """Whether nobody loads any of these, or one was left to be loaded."""
        loading = [row for row in rows if row in self._loading]
        return not loading or any(row in self._left for row in loading)

    def release(self, rows: Sequence[int]) -> None:
        """End a hold."""
        with self._changed:
            self._unpin(rows)
            self._changed.notify_all()

    def _reserve(self, rows: Sequence[int], deadline: float) -> tuple[list[int], int, bool]:
        """Pin all rows and allocate for those to be loaded by this caller.

        Returns these, how many of the others are resident or being loaded (a voxel with a fault is neither), and
        whether there was room before the deadline: without it nothing is to be loaded.
        """
        if self.bytes_of(rows) > self.buffer.total_bytes:
            raise ValueError(
                f"{len(rows)} voxels take {self.bytes_of(rows)} bytes, over the budget: ask in pieces"
            )
        with self._changed:
            while True:
                for row in rows:
                    self._pins[row] = self._pins.get(row, 0) + 1
                mine = [row for row in rows if row not in self._offsets and not self._fault(row)]
                if self._allocate_all(mine):
                    roomy = True
                    break
                self._unpin(rows)
                if not self._pins:
                    # Nobody else holds anything, and yet the room is in pieces between our own voxels.
                    for row in list(self._offsets):
                        self._evict(row)
                    continue
                if not self._changed.wait(_seconds_to(deadline)):
                    for row in rows:
                        self._pins[row] = self._pins.get(row, 0) + 1
                    roomy, mine = False, []
                    break
            self._loading.update(mine)
            for row in rows:
                if row in self._offsets:
                    self._offsets.move_to_end(row)
            hits = sum(row in self._offsets for row in rows) - len(mine)
            self.hits += hits
            self.misses += len(mine)
            return mine, hits, roomy

    def _allocate_all(self, rows: list[int]) -> bool:
        """Allocate for every row, evicting what is neither pinned nor loading; all or nothing."""
        done: list[int] = []
        for row in rows:
            offset = self.buffer.allocate(self._sizes[row])
            while offset is None and (victim := self._victim()) is not None:
                self._evict(victim)
                offset = self.buffer.allocate(self._sizes[row])
            if offset is None:
                for other in done:
                    self._forget(other)
                return False
            self._offsets[row] = offset
            self.resident_bytes += self._sizes[row]
            done.append(row)
        return True

    def _victim(self) -> int | None:
        """The least recently used voxel that nobody uses."""
        return next((row for row in self._offsets if row not in self._pins), None)

    def _evict(self, row: int) -> None:
        self.evictions += 1
        self._forget(row)

    def _forget(self, row: int) -> None:
        self.where[row] = -1
        self.buffer.release(self._offsets.pop(row), self._sizes[row])
        self.resident_bytes -= self._sizes[row]

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
        self._forget(row)

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

    def _load(self, rows: list[int], deadline: float) -> None:
        """Load what this caller reserved; every row leaves `_loading`, loaded or with a fault, or is left to others."""
        for number, row in enumerate(rows):
            if _seconds_to(deadline) == 0:
                self._leave(rows[number:])
                return
            where = None
            faults, fault = self._passing, ""
            try:
                where = self._store.load(row, self.buffer.arena, self._offsets[row])
            except CorruptError as error:
                faults, fault = self._faults, str(error)
            except OSError as error:
                fault = f"{self._store.archive.where(row)}: cannot be read ({error}): check the disk"
            except BaseException as error:
                with self._changed:
                    for left in rows[number:]:
                        self._passing[left] = (
                            f"{self._store.archive.where(left)}: not loaded ({error!r}): ask again"
                        )
                        self._forget(left)
                        self._loading.discard(left)
                    self._changed.notify_all()
                raise
            with self._changed:
                if where is None:
                    faults[row] = fault
                    self._forget(row)
                else:
                    self.where[row] = where
                self._loading.discard(row)
                self._changed.notify_all()

    def check(self) -> None:
        """Assert what must always hold: bytes add up, runs neither overlap nor leave the buffer."""
        with self._changed:
            held = sum(self._sizes[row] for row in self._offsets)
            runs = sorted(
                [(offset, self._sizes[row]) for row, offset in self._offsets.items()]
                + self.buffer.free_runs()
            )
            assert held == self.resident_bytes <= self.buffer.total_bytes, (held, self.resident_bytes)
            at = 0
            for offset, size in runs:
                assert offset == at, (offset, at)
                at += size
            assert at == self.buffer.total_bytes
            resident = {int(row) for row in np.flatnonzero(self.where[:, 0] >= 0)}
            assert resident == set(self._offsets) - self._loading
            assert self._left <= self._loading <= set(self._offsets) and self._left <= set(self._pins)
            assert all(count > 0 for count in self._pins.values())
