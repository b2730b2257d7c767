"""Which voxel has which bytes of the arena, and which one goes for another.

Not thread-safe: the residency calls it under its lock.
"""

import bisect
import ctypes
from collections.abc import Callable, Collection
from itertools import islice

import numpy as np
from numpy.typing import NDArray

from .arena import ArenaBuffer
from .policies import Policy

Which = Callable[[int], bool]

# Voxels to either side of where room was made that are looked at before all are: some tenths of a millisecond. Of a
# stretch that is short enough to be moved there is one there nearly always.
AROUND = 512


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
        Where what may go is too little, nothing goes; where what stays lies in between, some may have gone for nothing.
        """
        size = self.sizes[row]
        offset = self.buffer.allocate(size)
        if offset is None:
            victims = self._enough(size, may_go, most)
            if victims is None:
                return False
            near = 0
            for victim in victims:
                near = self.offsets[victim]
                self._evict(victim, gone)
            offset = self._whole_run(size, may_move, near)
            while offset is None:  # what is pinned lies in between
                victim = next(filter(may_go, islice(self.policy.victims(), most)), -1)
                if victim < 0:
                    return False
                near = self.offsets[victim]
                self._evict(victim, gone)
                offset = self._whole_run(size, may_move, near)
        self.offsets[row] = offset
        bisect.insort(self._runs, (offset, row))
        self.used_bytes += size
        self.policy.added(row, size, scan=scan)
        return True

    def _enough(self, size: int, may_go: Which, most: int | None) -> list[int] | None:
        """The voxels to go for a run of `size` bytes, in order; None where all that may are too little."""
        free, found = self.buffer.total_bytes - self.used_bytes, list[int]()
        candidates = filter(may_go, islice(self.policy.victims(), most))
        while free < size:
            row = next(candidates, -1)
            if row < 0:
                return None
            found.append(row)
            free += self.sizes[row]
        return found

    def _whole_run(self, size: int, may_move: Which, near: int) -> int | None:
        """A run of `size` bytes, for which voxels are moved together if need be; None where pins prevent it.

        near: where room was made just now: the voxels around it are looked at first.
        """
        offset = self.buffer.allocate(size)
        if offset is not None or self.buffer.total_bytes - self.used_bytes < size:
            return offset
        at = bisect.bisect_left(self._runs, (near, -1))
        some = slice(max(0, at - AROUND), at + AROUND)
        if len(self._runs) > 2 * AROUND:
            offset = self._join(size, may_move, some)
        return self._join(size, may_move, slice(0, len(self._runs))) if offset is None else offset

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
