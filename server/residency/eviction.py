"""Which resident voxel goes first: the orders of eviction, behind one interface.

No threads, no clock, no bytes of its own: the residency calls it under its lock, and scripts/simulate_cache replays
traces with the same objects. What a policy is not told of, pins and predictions, whoever evicts looks at: `victims`
names every resident row, and those in use are passed over.
"""

from collections import OrderedDict, deque
from collections.abc import Callable, Iterator
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ...schemas.errors import BadRequestError

POLICIES = ("lru", "lru+prefetch", "distance", "s3fifo")

# Of the budget, what scans may fill while others want room: sweeps along a path, and what is asked right after a
# teleport. With all of it, one sweep through the archive washes out what every user stands in. As much as S3-FIFO gives
# to what is new. Ten sweeps in five minutes beside eight strollers, `scripts/simulate_cache --sweeps 10 --kinds stroll`
# in a town of 4e7 points: the strollers miss 362 voxels, and 440 where the sweeps are not told; 326 without sweeps.
SCAN_SHARE = 0.1
# S3-FIFO's small queue, of the budget, and the uses counted: two bits ([Yang23]).
SMALL_SHARE = 0.1
MOST_USES = 3
# `distance`: rows there is room for at first; and those at the front that are put in order before the rest.
FEW_ROWS, SOME_ROWS = 64, 256

Nearness = Callable[[NDArray[np.int64]], NDArray[np.float64]]


class Policy(Protocol):
    """An order of eviction. Rows are index rows of voxels; each is added once, until it is removed."""

    name: str

    def added(self, row: int, size: int, *, scan: bool) -> None:
        """Room of `size` bytes was given to a row, for a demand (of a scan, or not) or to prefetch it (no scan)."""

    def used(self, row: int, *, scan: bool) -> None:
        """A row was demanded that is resident or being loaded."""

    def removed(self, row: int, *, evicted: bool) -> None:
        """A row gave its room back: evicted, or it was never loaded."""

    def victims(self) -> Iterator[int]:
        """Every row that has room, once, first to go first. Found as they are taken, and void after any other call."""


def prefetches(name: str) -> bool:
    """Whether voxels are loaded before they are asked for under this policy: all but [Fig12]'s."""
    return name != "lru"


def make_policy(name: str, budget_bytes: int, nearness: Nearness | None = None) -> Policy:
    """The policy of this name, empty. nearness: what `distance` goes by, see `Distance`.

    Raises BadRequestError for another name, ValueError for `distance` without nearness.
    """
    if name in ("lru", "lru+prefetch"):
        return Lru(budget_bytes, name)
    if name == "s3fifo":
        return S3Fifo(budget_bytes)
    if name != "distance":
        raise BadRequestError(f"policy {name!r}: expected one of {', '.join(POLICIES)}")
    if nearness is None:
        raise ValueError("policy distance: needs to know how near rows are to users")
    return Distance(nearness)


class Lru:
    """Least recently used first; of scans, no more than their share.

    What a scan added stands in a queue of its own until somebody else uses it. While that queue holds more than
    SCAN_SHARE of the budget, its oldest go before anything else; within its share it is as good as the rest.
    """

    def __init__(self, budget_bytes: int, name: str = "lru") -> None:
        """Empty."""
        self.name = name
        self._order: OrderedDict[int, int] = (
            OrderedDict()
        )  # row -> bytes, all of them; least recently used first
        self._scans: OrderedDict[int, int] = OrderedDict()  # those that only scans wanted
        self._scan_bytes = 0
        self._scan_most = int(budget_bytes * SCAN_SHARE)

    def added(self, row: int, size: int, *, scan: bool) -> None:
        """See `Policy`."""
        self._order[row] = size
        if scan:
            self._scans[row] = size
            self._scan_bytes += size

    def used(self, row: int, *, scan: bool) -> None:
        """See `Policy`."""
        self._order.move_to_end(row)
        if row in self._scans:
            if scan:
                self._scans.move_to_end(row)
            else:
                self._scan_bytes -= self._scans.pop(row)

    def removed(self, row: int, *, evicted: bool) -> None:
        """See `Policy`."""
        del self._order[row]
        self._scan_bytes -= self._scans.pop(row, 0)

    def victims(self) -> Iterator[int]:
        """See `Policy`."""
        over = self._scan_bytes - self._scan_most
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


class Distance:
    """Farthest from every user's predicted way first; of those as far, least recently used first.

    What a scan added needs no share: far from users it goes first as it is. Rows lie in arrays, in no order: the first
    to go is found in one pass over them, those behind it in the order of a part, and only then of all.
    """

    name = "distance"

    def __init__(self, nearness: Nearness) -> None:
        """nearness: rows -> (n,) float64, least distance of each to any user's predicted way [m], inf: no users."""
        self._nearness = nearness
        self._at: dict[int, int] = {}  # where each row is in the arrays
        self._rows = np.empty(FEW_ROWS, np.int64)
        self._used = np.empty(FEW_ROWS, np.int64)  # when, in uses of any
        self._uses = 0

    def added(self, row: int, size: int, *, scan: bool) -> None:
        """See `Policy`."""
        count = len(self._at)
        if count == len(self._rows):
            self._rows, self._used = np.resize(self._rows, 2 * count), np.resize(self._used, 2 * count)
        self._at[row] = count
        self._rows[count] = row
        self.used(row, scan=scan)

    def used(self, row: int, *, scan: bool) -> None:
        """See `Policy`."""
        self._uses += 1
        self._used[self._at[row]] = self._uses

    def removed(self, row: int, *, evicted: bool) -> None:
        """See `Policy`."""
        at, last = self._at.pop(row), len(self._at)
        if at < last:  # the last takes its place
            moved = int(self._rows[last])
            self._rows[at], self._used[at], self._at[moved] = moved, self._used[last], at

    def victims(self) -> Iterator[int]:
        """See `Policy`."""
        count = len(self._at)
        if not count:
            return
        rows, used = self._rows[:count], self._used[:count]
        far = self._nearness(rows)
        farthest = np.flatnonzero(far == far.max())
        first = int(rows[farthest[np.argmin(used[farthest])]])
        yield first
        # Who looks further is refused the first ones, and seldom more than a few.
        least = np.partition(far, count - SOME_ROWS)[count - SOME_ROWS] if count > SOME_ROWS else -np.inf
        for some in (far >= least, far < least):
            at = np.flatnonzero(some)
            order = at[np.lexsort((used[at], -far[at]))]
            yield from (row for row in rows[order].tolist() if row != first)


class _Queues:
    """The queues of S3-FIFO that hold. small, main: row -> bytes, oldest first.  uses: row -> 0 to MOST_USES."""

    def __init__(self, small_most: int) -> None:
        self.small: OrderedDict[int, int] = OrderedDict()
        self.main: OrderedDict[int, int] = OrderedDict()
        self.uses: dict[int, int] = {}
        self.small_bytes, self.small_most = 0, small_most

    def remove(self, row: int) -> int | None:
        """Take a row out. Returns its bytes if it was in the small queue, else None."""
        del self.uses[row]
        if row in self.main:
            del self.main[row]
            return None
        size = self.small.pop(row)
        self.small_bytes -= size
        return size

    def settle(self) -> None:
        """Bring who goes next to the front of its queue: what was used changes its place, as algorithm 1 has it."""
        while self.small or self.main:
            if self.small and (self.small_bytes >= self.small_most or not self.main):
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
        """Who goes, one after another, were each to go; nothing changes its place. `settle`, looked up only."""
        small, small_bytes = iter(self.small.items()), self.small_bytes
        main = ((row, self.uses[row]) for row in self.main)
        again: deque[tuple[int, int]] = deque()  # what was moved to the end of the main queue: row, uses left
        new, old = next(small, None), next(main, None)
        while new or old:
            if new and (small_bytes >= self.small_most or not old):
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
    """S3-FIFO, in bytes: a small queue for what is new, a main queue for what was used, a ghost for what was new once.

    After [Yang23] J. Yang, Y. Zhang, Z. Qiu, Y. Yue, K. V. Rashmi, "FIFO queues are all you need for cache eviction",
    SOSP 2023, algorithm 1. New rows enter the small queue, or the main one where the ghost still knows them. What
    leaves the small queue used more than once moves to the main one; what leaves the main queue used at all goes
    round again, its count one less. Uses by scans are not counted, nor does a scan find anything in the ghost.
    """

    name = "s3fifo"

    def __init__(self, budget_bytes: int) -> None:
        """Empty."""
        small_most = int(budget_bytes * SMALL_SHARE)
        self._queues = _Queues(small_most)
        self._ghost: OrderedDict[int, int] = (
            OrderedDict()
        )  # row -> bytes, of what left the small queue unused
        self._ghost_bytes, self._ghost_most = 0, budget_bytes - small_most  # as much as the main queue holds

    def added(self, row: int, size: int, *, scan: bool) -> None:
        """See `Policy`."""
        queues = self._queues
        queues.uses[row] = 0
        if row in self._ghost and not scan:
            self._ghost_bytes -= self._ghost.pop(row)
            queues.main[row] = size
        else:
            queues.small[row] = size
            queues.small_bytes += size

    def used(self, row: int, *, scan: bool) -> None:
        """See `Policy`."""
        uses = self._queues.uses
        if not scan and uses[row] < MOST_USES:
            uses[row] += 1

    def removed(self, row: int, *, evicted: bool) -> None:
        """See `Policy`."""
        size = self._queues.remove(row)
        if size is None or not evicted:
            return
        self._ghost_bytes += size - self._ghost.pop(row, 0)
        self._ghost[row] = size
        while self._ghost_bytes > self._ghost_most:
            self._ghost_bytes -= self._ghost.popitem(last=False)[1]

    def victims(self) -> Iterator[int]:
        """See `Policy`. To find the first, rows change places as algorithm 1 has it; those behind are only looked up.

        So whoever looks at all of them leaves the counts as they are, but for one eviction's.
        """
        self._queues.settle()
        yield from self._queues.victims()
