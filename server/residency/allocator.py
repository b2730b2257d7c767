"""Which voxel has which bytes of the arena, and which one goes for another.

Not thread-safe: the residency calls it under its lock.
"""

import bisect
import ctypes
from collections import deque
from collections.abc import Callable, Collection
from itertools import islice

import numpy as np
from numpy.typing import NDArray

from .arena import ArenaBuffer
from .eviction import Policy

Which = Callable[[int], bool]

# Runs to either side of a place that are looked at to join free room. A load costs the same then however many voxels
# are resident: the search of 64 runs takes some 20 us.
AROUND = 32
# The same in bytes, as multiples of what is asked for: small voxels around a large one are many, and so is the work of
# loading it.
AROUND_SIZES = 16
# Victims that one search finds beyond those it needs. A search passes all pinned voxels at the front
# of the policy's order, so that it is not repeated for each victim.
MORE = 32
# Of the buffer, what may go beyond the bytes that are asked for before all runs are looked at.
SLACK = 1 / 32


class Room:
    """The runs of the resident voxels, and of those being loaded.

    offsets: row -> byte offset.  where: (v, 3) int64, see Residency.  used_bytes: of all runs.  evictions: voxels that
    went for others; moved_bytes: of voxels that were moved to join free runs.
    """

    def __init__(
        self, buffer: ArenaBuffer, sizes: list[int], where: NDArray[np.int64], policy: Policy
    ) -> None:
        """Nothing in `buffer` yet. sizes: of each row, rounded as the buffer does."""
        self.buffer, self.sizes, self.where, self.policy = buffer, sizes, where, policy
        self.offsets: dict[int, int] = {}
        self.used_bytes = self.evictions = self.moved_bytes = 0
        self._address = buffer.arena.halves.ctypes.data
        self._runs: list[tuple[int, int]] = []  # (offset, row), ascending

    def make(
        self,
        row: int,
        may_go: Which,
        may_move: Which,
        gone: Callable[[int], None],
        *,
        scan: bool,
        most: int | None = None,
    ) -> bool:
        """Room for a voxel that has none, at the cost of voxels that may go, in the policy's order.

        may_go, may_move: of a row.  gone: told each row that went.  most: rows looked at to find those; None: all.
        Where what may go is too little, nothing goes. Where the free room is in pieces far apart, more go than the
        bytes need; where what stays lies in between, some may have gone for nothing.
        """
        size = self.sizes[row]
        offset = self.buffer.allocate(size)
        if offset is None:
            offset = self._clear(size, may_go, may_move, gone, most)
        if offset is None:
            return False
        self.offsets[row] = offset
        bisect.insort(self._runs, (offset, row))
        self.used_bytes += size
        self.policy.added(row, size, scan=scan)
        return True

    def _clear(
        self, size: int, may_go: Which, may_move: Which, gone: Callable[[int], None], most: int | None
    ) -> int | None:
        """Take a run of `size` bytes, see `make`; None where there is none.

        Free room is joined around the last victim and around the largest free run. While that is in vain, more voxels
        go, up to SLACK of the buffer; then all runs are looked at.
        """
        found = self._enough(size, may_go, most)
        if found is None:
            return None
        needed, more = found
        near, slack = -1, int(self.buffer.total_bytes * SLACK)
        all_at = size + slack  # the free bytes from which on all runs are looked at
        for victim in needed:
            near = self.offsets[victim]
            self._evict(victim, gone)
        while True:
            offset = self._join_around(size, may_move, near)
            if offset is not None:
                return offset
            if not more:
                more = deque(islice(filter(may_go, islice(self.policy.victims(), most)), MORE))
            victim = more.popleft() if more else -1
            free = self.buffer.total_bytes - self.used_bytes
            if victim < 0 or free >= all_at:
                all_at = free + slack
                offset = self._join(size, may_move, slice(0, len(self._runs)))
                if offset is not None or victim < 0:
                    return offset
            near = self.offsets[victim]  # what is pinned may lie in between
            self._evict(victim, gone)

    def _enough(self, size: int, may_go: Which, most: int | None) -> tuple[list[int], deque[int]] | None:
        """Return the voxels to evict for a run of `size` bytes, in order, and some of those that follow them.

        None where all that may be evicted are too little.
        """
        free, found = self.buffer.total_bytes - self.used_bytes, list[int]()
        candidates = filter(may_go, islice(self.policy.victims(), most))
        while free < size:
            row = next(candidates, -1)
            if row < 0:
                return None
            found.append(row)
            free += self.sizes[row]
        return found, deque(islice(candidates, MORE))

    def _join_around(self, size: int, may_move: Which, near: int) -> int | None:
        """Take a run of `size` bytes, for which voxels near the offset `near`, or near the largest free run, are moved
        together if need be; None where there is too little room there."""
        offset = self.buffer.allocate(size)
        if offset is not None:
            return offset
        looked = slice(0, 0)
        largest, _ = self.buffer.largest_run()
        for place in (near, largest) if near >= 0 else (largest,):
            at = bisect.bisect_left(self._runs, (place, -1))
            low = bisect.bisect_left(self._runs, (place - AROUND_SIZES * size, -1))
            high = bisect.bisect_left(self._runs, (place + AROUND_SIZES * size, -1))
            some = slice(max(0, min(at - AROUND, low)), min(len(self._runs), max(at + AROUND, high)))
            if some == looked:
                continue
            offset, looked = self._join(size, may_move, some), some
            if offset is not None:
                return offset
        return None

    def _join(self, size: int, may_move: Which, some: slice) -> int | None:
        """The same among some of the runs alone, in order of place.

        Of the stretches that hold so much free room and nothing that stays, the one with the least to be moved.
        """
        runs = self._runs[some]
        low = self._end(some.start - 1) if some.start else 0
        high = self._runs[some.stop][0] if some.stop < len(self._runs) else self.buffer.total_bytes
        best, moves = None, 0
        begin, at, free, held = 0, low, 0, 0  # a stretch from run `begin` on; free and held bytes in it
        first = low
        for number, (offset, row) in enumerate([*runs, (high, -1)]):
            free += offset - at
            while free >= size:
                if best is None or held < moves:
                    best, moves = (first, begin, number), held
                # Shorten the stretch from its beginning.
                if begin == number:
                    break
                start, gone = runs[begin]
                free -= start - first
                held -= self.sizes[gone]
                first, begin = start + self.sizes[gone], begin + 1
            if row < 0:
                break
            at = offset + self.sizes[row]
            if may_move(row):
                held += self.sizes[row]
            else:
                begin, first, free, held = number + 1, at, 0, 0
        if best is None:
            return None
        to, begin, end = best
        for offset, row in runs[begin:end]:
            self._move(row, offset, to)
            to += self.sizes[row]
        return self.buffer.allocate(size)

    def _end(self, number: int) -> int:
        """Where a run ends."""
        offset, row = self._runs[number]
        return offset + self.sizes[row]

    def _move(self, row: int, offset: int, to: int) -> None:
        """Move a voxel down; its runs are numbered from the arena's start, in words, words and halfwords."""
        size = self.sizes[row]
        if to == offset:
            return
        ctypes.memmove(self._address + to, self._address + offset, size)
        self.buffer.release(offset, size)
        self.buffer.take(to, size)
        self._runs[bisect.bisect_left(self._runs, (offset, row))] = (to, row)  # they keep their order
        self.offsets[row] = to
        shift = offset - to
        self.where[row] -= (shift // 4, shift // 4, shift // 2)
        self.moved_bytes += size

    def _evict(self, row: int, gone: Callable[[int], None]) -> None:
        self.evictions += 1
        self.forget(row, evicted=True)
        gone(row)

    def leave_only(self, rows: Collection[int], gone: Callable[[int], None]) -> None:
        """Let go of every voxel but these, and move them together; nobody may use or load any."""
        for row in [row for row in self.offsets if row not in rows]:
            self._evict(row, gone)
        to = 0
        for offset, row in list(self._runs):
            self._move(row, offset, to)
            to += self.sizes[row]

    def forget(self, row: int, *, evicted: bool = False) -> None:
        """Give back a voxel's room."""
        self.where[row] = -1
        offset = self.offsets.pop(row)
        del self._runs[bisect.bisect_left(self._runs, (offset, row))]
        self.buffer.release(offset, self.sizes[row])
        self.used_bytes -= self.sizes[row]
        self.policy.removed(row, evicted=evicted)

    def check(self) -> None:
        """Assert that runs tile the buffer and the bytes add up."""
        held = sum(self.sizes[row] for row in self.offsets)
        runs = sorted(
            [(offset, self.sizes[row]) for row, offset in self.offsets.items()] + self.buffer.free_runs()
        )
        assert held == self.used_bytes <= self.buffer.total_bytes, (held, self.used_bytes)
        at = 0
        for offset, size in runs:
            assert offset == at, (offset, at)
            at += size
        assert at == self.buffer.total_bytes
        assert self._runs == sorted((offset, row) for row, offset in self.offsets.items())
        assert sorted(self.policy.victims()) == sorted(self.offsets)
