"""Allocator of the arena: assigns its bytes to voxels, and evicts and moves voxels to make room.

Not thread-safe: `VoxelCache` calls it under its lock.
"""

import bisect
import ctypes
from collections import deque
from collections.abc import Callable, Collection
from itertools import islice

import numpy as np
from numpy.typing import NDArray

from .arena import ArenaBuffer
from .eviction import EvictionPolicy

Which = Callable[[int], bool]

# Number of runs on either side of an offset that are searched for free bytes to join. The limit
# makes the cost of a load independent of the number of resident voxels: searching 64 runs takes
# some 20 µs.
AROUND = 32
# Bytes on either side that are searched in addition, as a multiple of the requested size. A large
# voxel may replace many small ones, and loading it takes long enough to justify the longer search.
AROUND_SIZES = 16
# Number of victims that a search finds beyond those it needs. Every search skips the pinned voxels
# at the front of the policy's order again, so it is not repeated for each victim.
SPARE_VICTIMS = 32
# Share of the buffer that may be evicted beyond the requested bytes before all runs are searched.
SLACK = 1 / 32


class VoxelAllocator:
    """Allocation of the arena's bytes to the voxels that are resident or being loaded.

    A run is a contiguous range of bytes.
    offsets: row -> byte offset.  where: (v, 3) int64, see VoxelCache.
    used_bytes: the total of all runs.  evictions: voxels evicted to make room for others.
    moved_bytes: bytes of voxels that were moved to join free runs.
    """

    def __init__(
        self, buffer: ArenaBuffer, sizes: list[int], where: NDArray[np.int64], policy: EvictionPolicy
    ) -> None:
        """Begin with an empty `buffer`.

        sizes: bytes of each row, rounded with `ArenaBuffer.rounded`.
        """
        self.buffer, self.sizes, self.where, self.policy = buffer, sizes, where, policy
        self.offsets: dict[int, int] = {}
        self.used_bytes = self.evictions = self.moved_bytes = 0
        self._address = buffer.arena.halves.ctypes.data
        self._runs: list[tuple[int, int]] = []  # (offset, row), ascending

    def allocate(
        self,
        row: int,
        may_evict: Which,
        may_move: Which,
        gone: Callable[[int], None],
        *,
        scan: bool,
        most: int | None = None,
    ) -> bool:
        """Allocate a run for a voxel without one, evicting others in the policy's order if needed.

        Return whether the voxel has a run now.
        may_evict, may_move: whether the voxel of a row may be evicted or moved.
        gone: called with each evicted row.  scan: see `EvictionPolicy.added`.
        most: limit of rows examined to find victims; None: all rows.
        Nothing is evicted if evicting everything allowed would free too few bytes. If free bytes
        are fragmented, more voxels are evicted than the size requires. If voxels that must stay lie
        between the free runs, the allocation may fail although voxels were evicted.
        """
        size = self.sizes[row]
        offset = self.buffer.allocate(size)
        if offset is None:
            offset = self._clear(size, may_evict, may_move, gone, most)
        if offset is None:
            return False
        self.offsets[row] = offset
        bisect.insort(self._runs, (offset, row))
        self.used_bytes += size
        self.policy.added(row, size, scan=scan)
        return True

    def _clear(
        self, size: int, may_evict: Which, may_move: Which, gone: Callable[[int], None], most: int | None
    ) -> int | None:
        """Evict and move voxels for a run of `size` bytes; return its offset, or None on failure.

        See `allocate` for the parameters. Free runs are joined around the last victim and around
        the largest free run. While that does not suffice, more voxels are evicted, up to SLACK of
        the buffer. After that, all runs are searched.
        """
        found = self._select_victims(size, may_evict, most)
        if found is None:
            return None
        needed, more = found
        near, slack = -1, int(self.buffer.total_bytes * SLACK)
        all_at = size + slack  # free bytes at which all runs are searched
        for victim in needed:
            near = self.offsets[victim]
            self._evict(victim, gone)
        while True:
            offset = self._join_around(size, may_move, near)
            if offset is not None:
                return offset
            if not more:
                more = deque(islice(filter(may_evict, islice(self.policy.victims(), most)), SPARE_VICTIMS))
            victim = more.popleft() if more else -1
            free = self.buffer.total_bytes - self.used_bytes
            if victim < 0 or free >= all_at:
                all_at = free + slack
                offset = self._join(size, may_move, slice(0, len(self._runs)))
                if offset is not None or victim < 0:
                    return offset
            near = self.offsets[victim]  # pinned voxels may separate it from the other free runs
            self._evict(victim, gone)

    def _select_victims(
        self, size: int, may_evict: Which, most: int | None
    ) -> tuple[list[int], deque[int]] | None:
        """Select the voxels to evict for a run of `size` bytes, in order, and SPARE_VICTIMS more.

        Return None if all voxels that may be evicted free too few bytes together.
        """
        free, found = self.buffer.total_bytes - self.used_bytes, list[int]()
        candidates = filter(may_evict, islice(self.policy.victims(), most))
        while free < size:
            row = next(candidates, -1)
            if row < 0:
                return None
            found.append(row)
            free += self.sizes[row]
        return found, deque(islice(candidates, SPARE_VICTIMS))

    def _join_around(self, size: int, may_move: Which, near: int) -> int | None:
        """Allocate a run of `size` bytes, moving voxels together near an offset if needed.

        Search around the offset `near`, unless it is negative, and around the largest free run.
        Return the run's offset, or None if there are too few free bytes.
        """
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
        """Join free bytes within a slice of the runs, in order of offset, and allocate `size`.

        Of the stretches with `size` free bytes and only movable voxels, choose the one with the
        fewest bytes to move. Return the run's offset, or None if there is no such stretch.
        """
        runs = self._runs[some]
        low = self._end(some.start - 1) if some.start else 0
        high = self._runs[some.stop][0] if some.stop < len(self._runs) else self.buffer.total_bytes
        best, moves = None, 0
        # The stretch begins at run `begin`; `free` and `held` are its free and used bytes.
        begin, at, free, held = 0, low, 0, 0
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
        """Return the offset of the end of a run."""
        offset, row = self._runs[number]
        return offset + self.sizes[row]

    def _move(self, row: int, offset: int, to: int) -> None:
        """Move a voxel to a lower offset `to`, and update its row of `where`.

        A row of `where` counts from the start of the arena in words, words and halfwords.
        """
        size = self.sizes[row]
        if to == offset:
            return
        ctypes.memmove(self._address + to, self._address + offset, size)
        self.buffer.release(offset, size)
        self.buffer.take(to, size)
        # The order of the runs stays, because a voxel moves into the free bytes before it.
        self._runs[bisect.bisect_left(self._runs, (offset, row))] = (to, row)
        self.offsets[row] = to
        shift = offset - to
        self.where[row] -= (shift // 4, shift // 4, shift // 2)
        self.moved_bytes += size

    def _evict(self, row: int, gone: Callable[[int], None]) -> None:
        self.evictions += 1
        self.forget(row)
        gone(row)

    def evict_all_but(self, rows: Collection[int], gone: Callable[[int], None]) -> None:
        """Evict all voxels but these and move these together; no voxel may be in use or loading."""
        for row in [row for row in self.offsets if row not in rows]:
            self._evict(row, gone)
        to = 0
        for offset, row in list(self._runs):
            self._move(row, offset, to)
            to += self.sizes[row]

    def forget(self, row: int) -> None:
        """Release a voxel's run."""
        self.where[row] = -1
        offset = self.offsets.pop(row)
        del self._runs[bisect.bisect_left(self._runs, (offset, row))]
        self.buffer.release(offset, self.sizes[row])
        self.used_bytes -= self.sizes[row]
        self.policy.removed(row)

    def check(self) -> None:
        """Assert that the runs tile the buffer and that their bytes add up."""
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
