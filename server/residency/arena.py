"""Arena: one buffer that holds all resident voxels; its free runs, and which voxel has which run.

Not thread-safe: `VoxelCache` calls it under its lock.
"""

import bisect
import ctypes
from collections import deque
from collections.abc import Callable, Collection, Iterator
from itertools import islice

import numpy as np
from numpy.typing import NDArray

from ..kernels.core.scene_arrays import Arena
from .cache_stats import CacheStats
from .eviction import EvictionPolicy

ALIGNMENT = 64  # a cache line: a row of the arena straddles as few cache lines as possible
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


class ArenaBuffer:
    """Best-fit allocator of a buffer of fixed size.

    A run is a contiguous range of bytes. An allocation takes the shortest free run that suffices;
    of equals, the one at the lowest offset.
    arena: array views that kernels read. The system commits pages when they are first written, so a
    large budget takes no memory until it is used.
    """

    def __init__(self, budget_bytes: int) -> None:
        """Reserve budget_bytes, rounded down to whole cache lines."""
        self.total_bytes = budget_bytes // ALIGNMENT * ALIGNMENT
        raw = np.empty(self.total_bytes + ALIGNMENT, np.uint8)
        start = -raw.ctypes.data % ALIGNMENT
        buffer = raw[start : start + self.total_bytes]
        self.arena = Arena(buffer.view(np.float32), buffer.view(np.int32), buffer.view(np.uint16))
        self._free: list[tuple[int, int]] = []  # (offset, bytes), ascending, never adjacent
        self._by_size: list[tuple[int, int]] = []  # the same as (bytes, offset), ascending
        if self.total_bytes:
            self._put(0, 0, self.total_bytes)

    @staticmethod
    def rounded(size: int) -> int:
        """Return the bytes that a run of `size` bytes takes: whole cache lines."""
        return -(-size // ALIGNMENT) * ALIGNMENT

    def allocate(self, size: int) -> int | None:
        """Allocate a run of `size` bytes and return its offset, or None if no free run suffices."""
        size = self.rounded(size)
        at = bisect.bisect_left(self._by_size, (size, -1))
        if at == len(self._by_size):
            return None
        offset = self._by_size[at][1]
        self.take(offset, size)
        return offset

    def take(self, offset: int, size: int) -> None:
        """Allocate the run of `size` bytes at `offset`, all of which is free."""
        size = self.rounded(size)
        i = bisect.bisect_right(self._free, (offset, self.total_bytes)) - 1
        start, free = self._drop(i)
        behind = start + free - offset - size
        if behind:
            self._put(i, offset + size, behind)
        if offset > start:
            self._put(i, start, offset - start)

    def release(self, offset: int, size: int) -> None:
        """Release an allocated run, joining it to its free neighbours."""
        size = self.rounded(size)
        i = bisect.bisect_left(self._free, (offset, 0))
        if i < len(self._free) and offset + size == self._free[i][0]:
            size += self._drop(i)[1]
        if i > 0 and sum(self._free[i - 1]) == offset:
            i -= 1
            offset, before = self._drop(i)
            size += before
        self._put(i, offset, size)

    def _put(self, i: int, offset: int, size: int) -> None:
        """Insert a free run at position `i` in the order of offsets."""
        self._free.insert(i, (offset, size))
        bisect.insort(self._by_size, (size, offset))

    def _drop(self, i: int) -> tuple[int, int]:
        """Remove the free run at position `i` in the order of offsets, and return it."""
        offset, size = self._free.pop(i)
        del self._by_size[bisect.bisect_left(self._by_size, (size, offset))]
        return offset, size

    def largest_run(self) -> tuple[int, int]:
        """Return the longest free run (offset, bytes), the last of equals; (-1, 0) if none."""
        size, offset = self._by_size[-1] if self._by_size else (0, -1)
        return offset, size

    def free_runs(self) -> list[tuple[int, int]]:
        """Return the free runs (offset, bytes), ascending."""
        return list(self._free)


class VoxelAllocator:
    """Allocation of the arena's bytes to the voxels that are resident or loading.

    It evicts and moves voxels to make room. A run is a contiguous range of bytes.
    offsets: row -> byte offset.  used_bytes: the total of all runs.
    where: (v, 3) int64, see `VoxelCache`.  sizes: bytes of each row, rounded with
    `ArenaBuffer.rounded`.  pins, loading: rows in use, which are neither evicted nor moved.
    """

    def __init__(
        self,
        buffer: ArenaBuffer,
        sizes: list[int],
        where: NDArray[np.int64],
        policy: EvictionPolicy,
        stats: CacheStats,
        pins: Collection[int],
        loading: Collection[int],
    ) -> None:
        """Begin with an empty `buffer`."""
        self.buffer, self.sizes, self.where, self.policy, self.stats = buffer, sizes, where, policy, stats
        self._pins, self._loading = pins, loading
        self.offsets: dict[int, int] = {}
        self.used_bytes = 0
        self._address = buffer.arena.halves.ctypes.data
        self._runs: list[tuple[int, int]] = []  # (offset, row), ascending

    def allocate(
        self, row: int, keeps: Callable[[int], bool], *, scan: bool, most: int | None = None
    ) -> bool:
        """Allocate a run for a voxel without one, evicting others in the policy's order if needed.

        Return whether the voxel has a run now.
        keeps: whether to evict no voxel of a row, besides those in use.
        scan: see `EvictionPolicy.added`.
        most: limit of rows examined to find victims; None: all rows.
        Nothing is evicted if evicting everything allowed would free too few bytes. If free bytes
        are fragmented, more voxels are evicted than the size requires. If voxels that must stay lie
        between the free runs, the allocation may fail although voxels were evicted.
        """
        size = self.sizes[row]
        offset = self.buffer.allocate(size)
        if offset is None:
            offset = self._clear(size, keeps, most)
        if offset is None:
            return False
        self.offsets[row] = offset
        bisect.insort(self._runs, (offset, row))
        self.used_bytes += size
        self.policy.added(row, size, scan=scan)
        return True

    def _is_free(self, row: int) -> bool:
        """Return whether no thread uses or loads a voxel."""
        return row not in self._pins and row not in self._loading

    def _victims(self, keeps: Callable[[int], bool], most: int | None) -> Iterator[int]:
        """Iterate over the rows that may be evicted, in order."""
        rows = islice(self.policy.victims(), most)
        return (row for row in rows if self._is_free(row) and not keeps(row))

    def _clear(self, size: int, keeps: Callable[[int], bool], most: int | None) -> int | None:
        """Evict and move voxels for a run of `size` bytes; return its offset, or None on failure.

        See `allocate` for the parameters. Free runs are joined around the last victim and around
        the largest free run. While that does not suffice, more voxels are evicted, up to SLACK of
        the buffer. After that, all runs are searched.
        """
        free, needed = self.buffer.total_bytes - self.used_bytes, list[int]()
        victims = self._victims(keeps, most)
        while free < size:
            row = next(victims, -1)
            if row < 0:
                return None
            needed.append(row)
            free += self.sizes[row]
        more, near = deque(islice(victims, SPARE_VICTIMS)), -1
        for row in needed:
            near = self._evict(row)
        slack = int(self.buffer.total_bytes * SLACK)
        all_at = size + slack  # free bytes at which all runs are searched
        while True:
            offset = self._join_around(size, near)
            if offset is not None:
                return offset
            if not more:
                more = deque(islice(self._victims(keeps, most), SPARE_VICTIMS))
            free = self.buffer.total_bytes - self.used_bytes
            if not more or free >= all_at:
                all_at = free + slack
                offset = self._join(size, slice(0, len(self._runs)))
                if offset is not None or not more:
                    return offset
            near = self._evict(more.popleft())  # pinned voxels may separate it from the other free runs

    def _join_around(self, size: int, near: int) -> int | None:
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
            offset, looked = self._join(size, some), some
            if offset is not None:
                return offset
        return None

    def _join(self, size: int, some: slice) -> int | None:
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
            if self._is_free(row):
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
        self.stats.moved_bytes += size

    def _evict(self, row: int) -> int:
        """Evict a voxel; return the offset of its run."""
        self.stats.count_eviction(row)
        return self.forget(row)

    def evict_all_but(self, rows: Collection[int]) -> None:
        """Evict all voxels but these and move these together; none may be in use or loading."""
        for row in [row for row in self.offsets if row not in rows]:
            self._evict(row)
        to = 0
        for offset, row in list(self._runs):
            self._move(row, offset, to)
            to += self.sizes[row]

    def forget(self, row: int) -> int:
        """Release a voxel's run; return its offset."""
        self.where[row] = -1
        offset = self.offsets.pop(row)
        del self._runs[bisect.bisect_left(self._runs, (offset, row))]
        self.buffer.release(offset, self.sizes[row])
        self.used_bytes -= self.sizes[row]
        self.policy.removed(row)
        return offset

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
