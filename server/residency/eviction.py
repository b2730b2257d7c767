"""Eviction policies: the orders in which resident voxels are evicted, behind one interface.

A policy uses no threads, no clock and no voxel data: `VoxelCache` calls it under its lock, and
scripts/simulate_cache replays traces with the same objects. A policy does not know about pins or
prefetches: `victims` yields every resident row, and the caller skips those that must stay.
"""

from collections import OrderedDict, deque
from collections.abc import Callable, Iterator
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ...schemas.errors import BadRequestError

POLICIES = ("lru", "lru+prefetch", "distance", "s3fifo")

# Share of the budget that scans may fill while other requests need room. Scans are sweeps along a
# path, and requests right after a teleport. Without a limit, one sweep through the archive evicts
# the voxels around every user. The share equals that of S3-FIFO's small queue. Measured with
# `scripts/simulate_cache --sweeps 10 --kinds stroll`, ten sweeps in five minutes beside eight
# strolling users in a town of 4e7 points: these users miss 362 voxels, 440 if sweeps are not marked
# as scans, and 326 without sweeps.
SCAN_SHARE = 0.1
# S3-FIFO: the small queue's share of the budget, and the largest use count, two bits ([Yang23]).
SMALL_SHARE = 0.1
MAX_USES = 3
# `distance`: initial capacity in rows, and the number of rows at the front that are sorted before
# the others.
INITIAL_ROWS, SORTED_ROWS = 64, 256

PathDistances = Callable[[NDArray[np.int64]], NDArray[np.float64]]


class EvictionPolicy(Protocol):
    """Order of eviction.

    Rows are index rows of voxels; a row is added at most once before it is removed.
    """

    name: str

    def added(self, row: int, size: int, *, scan: bool) -> None:
        """Record that `size` bytes were allocated to a row.

        scan: whether a scan requested the row; False for a prefetch.
        """

    def used(self, row: int, *, scan: bool) -> None:
        """Record that a row that is resident or being loaded was requested."""

    def removed(self, row: int, *, evicted: bool) -> None:
        """Record that the bytes of a row were released: it was evicted, or was never loaded."""

    def victims(self) -> Iterator[int]:
        """Iterate over all rows with allocated bytes in order of eviction, each once.

        The order is computed during the iteration, which any other call invalidates.
        """


def prefetches(name: str) -> bool:
    """Return whether voxels are prefetched under this policy: True for all but `lru` ([Fig12])."""
    return name != "lru"


def make_policy(name: str, budget_bytes: int, path_distances: PathDistances | None = None) -> EvictionPolicy:
    """Make an empty policy by its name.

    path_distances: required by `distance`, see `FarthestFirst`.
    Raise BadRequestError for an unknown name, ValueError for `distance` without path_distances.
    """
    if name in ("lru", "lru+prefetch"):
        return Lru(budget_bytes, name)
    if name == "s3fifo":
        return S3Fifo(budget_bytes)
    if name != "distance":
        raise BadRequestError(f"policy {name!r}: expected one of {', '.join(POLICIES)}")
    if path_distances is None:
        raise ValueError("policy distance: expected path_distances, the function that measures rows: pass it")
    return FarthestFirst(path_distances)


class Lru:
    """Least recently used first, with a bounded share for scans.

    A row added by a scan is also in a separate queue until another request uses it. While that
    queue holds more than SCAN_SHARE of the budget, its oldest rows are evicted before all others;
    within that share its rows are treated like the rest.
    """

    def __init__(self, budget_bytes: int, name: str = "lru") -> None:
        """Begin without rows."""
        self.name = name
        self._order: OrderedDict[int, int] = (
            OrderedDict()
        )  # row -> bytes, of all rows; least recently used first
        self._scans: OrderedDict[int, int] = OrderedDict()  # the same, of rows used by scans only
        self._scan_bytes = 0
        self._max_scan_bytes = int(budget_bytes * SCAN_SHARE)

    def added(self, row: int, size: int, *, scan: bool) -> None:
        """See `EvictionPolicy`."""
        self._order[row] = size
        if scan:
            self._scans[row] = size
            self._scan_bytes += size

    def used(self, row: int, *, scan: bool) -> None:
        """See `EvictionPolicy`."""
        self._order.move_to_end(row)
        if row in self._scans:
            if scan:
                self._scans.move_to_end(row)
            else:
                self._scan_bytes -= self._scans.pop(row)

    def removed(self, row: int, *, evicted: bool) -> None:
        """See `EvictionPolicy`."""
        del self._order[row]
        self._scan_bytes -= self._scans.pop(row, 0)

    def victims(self) -> Iterator[int]:
        """See `EvictionPolicy`."""
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


class FarthestFirst:
    """Farthest from every user's predicted path first; of equals, least recently used first.

    Scans need no bounded share here: their rows are far from users and evicted first anyway. Rows
    are stored in arrays, unsorted: the first victim is found in one pass over them, the next ones
    by sorting a part, and only then are all rows sorted.
    """

    name = "distance"

    def __init__(self, path_distances: PathDistances) -> None:
        """Begin without rows.

        path_distances: function that maps rows to the distance (n,) float64 of each from the
        nearest predicted path of a user [m]; inf without users.
        """
        self._nearness = path_distances
        self._at: dict[int, int] = {}  # row -> its position in the arrays
        self._rows = np.empty(INITIAL_ROWS, np.int64)
        self._used = np.empty(INITIAL_ROWS, np.int64)  # value of `_uses` at the last use of the row
        self._uses = 0

    def added(self, row: int, size: int, *, scan: bool) -> None:
        """See `EvictionPolicy`."""
        count = len(self._at)
        if count == len(self._rows):
            self._rows, self._used = np.resize(self._rows, 2 * count), np.resize(self._used, 2 * count)
        self._at[row] = count
        self._rows[count] = row
        self.used(row, scan=scan)

    def used(self, row: int, *, scan: bool) -> None:
        """See `EvictionPolicy`."""
        self._uses += 1
        self._used[self._at[row]] = self._uses

    def removed(self, row: int, *, evicted: bool) -> None:
        """See `EvictionPolicy`."""
        at, last = self._at.pop(row), len(self._at)
        if at < last:  # the last row takes its position
            moved = int(self._rows[last])
            self._rows[at], self._used[at], self._at[moved] = moved, self._used[last], at

    def victims(self) -> Iterator[int]:
        """See `EvictionPolicy`."""
        count = len(self._at)
        if not count:
            return
        rows, used = self._rows[:count], self._used[:count]
        far = self._nearness(rows)
        farthest = np.flatnonzero(far == far.max())
        first = int(rows[farthest[np.argmin(used[farthest])]])
        yield first
        # The first rows may be in use, and the caller continues, seldom by more than a few rows.
        least = (
            np.partition(far, count - SORTED_ROWS)[count - SORTED_ROWS] if count > SORTED_ROWS else -np.inf
        )
        for some in (far >= least, far < least):
            at = np.flatnonzero(some)
            order = at[np.lexsort((used[at], -far[at]))]
            yield from (row for row in rows[order].tolist() if row != first)


class _Queues:
    """Small and main queue of S3-FIFO.

    small, main: row -> bytes, oldest first.  uses: row -> use count, 0 to MAX_USES.
    """

    def __init__(self, max_small_bytes: int) -> None:
        self.small: OrderedDict[int, int] = OrderedDict()
        self.main: OrderedDict[int, int] = OrderedDict()
        self.uses: dict[int, int] = {}
        self.small_bytes, self.max_small_bytes = 0, max_small_bytes

    def remove(self, row: int) -> int | None:
        """Remove a row; return its bytes if it was in the small queue, else None."""
        del self.uses[row]
        if row in self.main:
            del self.main[row]
            return None
        size = self.small.pop(row)
        self.small_bytes -= size
        return size

    def move_used(self) -> None:
        """Move used rows until the next victim is at the front of its queue ([Yang23] alg. 1)."""
        while self.small or self.main:
            if self.small and (self.small_bytes >= self.max_small_bytes or not self.main):
                row = next(iter(self.small))
                if self.uses[row] <= 1:
                    return
                size = self.small.pop(row)
                self.small_bytes -= size
                self.main[row] = size
                self.uses[row] = 0
            else:
                row = next(iter(self.main))
                if not self.uses[row]:
                    return
                self.uses[row] -= 1
                self.main.move_to_end(row)

    def victims(self) -> Iterator[int]:
        """Iterate over the victims in the order in which repeated evictions would select them.

        This simulates `move_used` between evictions without moving any row.
        """
        small, small_bytes = iter(self.small.items()), self.small_bytes
        main = ((row, self.uses[row]) for row in self.main)
        again: deque[tuple[int, int]] = deque()  # moved to the end of the main queue: row, uses left
        new, old = next(small, None), next(main, None)
        while new or old:
            if new and (small_bytes >= self.max_small_bytes or not old):
                row, size = new
                new, small_bytes = next(small, None), small_bytes - size
                if self.uses[row] <= 1:
                    yield row
                    continue
                again.append((row, 0))
            elif old:
                row, uses = old
                old = None
                if not uses:
                    yield row
                else:
                    again.append((row, uses - 1))
            if old is None:
                old = next(main, None) or (again.popleft() if again else None)


class S3Fifo:
    """S3-FIFO, measured in bytes: a small queue for new rows, a main queue and a ghost queue.

    After [Yang23] J. Yang, Y. Zhang, Z. Qiu, Y. Yue, K. V. Rashmi, "FIFO queues are all you need
    for cache eviction", SOSP 2023, algorithm 1. New rows enter the small queue, or the main queue
    if the ghost queue contains them. A row at the end of the small queue that was used more than
    once moves to the main queue. A row at the end of the main queue that was used is reinserted
    with its count reduced by one. The ghost queue lists rows recently evicted from the small queue.
    Uses by scans are not counted, and a scan ignores the ghost queue.
    """

    name = "s3fifo"

    def __init__(self, budget_bytes: int) -> None:
        """Begin without rows."""
        max_small_bytes = int(budget_bytes * SMALL_SHARE)
        self._queues = _Queues(max_small_bytes)
        self._ghost: OrderedDict[int, int] = (
            OrderedDict()
        )  # row -> bytes, of rows evicted from the small queue
        self._ghost_bytes, self._max_ghost_bytes = (
            0,
            budget_bytes - max_small_bytes,
        )  # as large as the main queue

    def added(self, row: int, size: int, *, scan: bool) -> None:
        """See `EvictionPolicy`."""
        queues = self._queues
        queues.uses[row] = 0
        if row in self._ghost and not scan:
            self._ghost_bytes -= self._ghost.pop(row)
            queues.main[row] = size
        else:
            queues.small[row] = size
            queues.small_bytes += size

    def used(self, row: int, *, scan: bool) -> None:
        """See `EvictionPolicy`."""
        uses = self._queues.uses
        if not scan and uses[row] < MAX_USES:
            uses[row] += 1

    def removed(self, row: int, *, evicted: bool) -> None:
        """See `EvictionPolicy`."""
        size = self._queues.remove(row)
        if size is None or not evicted:
            return
        self._ghost_bytes += size - self._ghost.pop(row, 0)
        self._ghost[row] = size
        while self._ghost_bytes > self._max_ghost_bytes:
            self._ghost_bytes -= self._ghost.popitem(last=False)[1]

    def victims(self) -> Iterator[int]:
        """See `EvictionPolicy`. Finding the first victim moves rows, as in algorithm 1.

        Iterating over all rows therefore changes the counts as one eviction does.
        """
        self._queues.move_used()
        yield from self._queues.victims()
