"""Arena: one buffer that holds all resident voxels, and the assignment of its bytes to them.

It knows neither records nor requests: voxel_cache.py remembers which voxels are resident or failed.
Not thread-safe: `VoxelCache` calls it under its lock.
"""

import bisect
import ctypes
from collections import deque
from collections.abc import Callable, Collection, Iterable, Iterator
from itertools import islice

import numpy as np

from ..kernels.core.scene_arrays import Arena

ALIGNMENT = 64  # a cache line: a row of the arena straddles as few cache lines as possible
# Number of runs on either side of an offset that are searched for free bytes to join. The limit
# makes the cost of a load independent of the number of resident voxels: searching 64 runs takes
# some 20 µs.
AROUND = 32
# Bytes on either side that are searched in addition, as a multiple of the requested size. A large
# voxel may replace many small ones, and loading it takes long enough to justify the longer search.
AROUND_SIZES = 16
# Number of victims that a search finds beyond those it needs. Every search skips the pinned voxels
# at the front of the order again, so it is not repeated for each victim.
SPARE_VICTIMS = 32
# Share of the buffer that may be evicted beyond the requested bytes before all runs are searched.
SLACK = 1 / 32


class ArenaBuffer:
    """Buffer of fixed size.

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

    @staticmethod
    def rounded(size: int) -> int:
        """Return the bytes that a run of `size` bytes takes: whole cache lines."""
        return -(-size // ALIGNMENT) * ALIGNMENT


class VoxelAllocator:
    """Allocation of the arena's bytes to the voxels that are resident or loading.

    It evicts and moves voxels to make room. A run is the contiguous range of bytes of a voxel, a gap
    the free bytes between two runs. A voxel gets the beginning of the shortest gap that suffices; of
    equals, of the one at the lowest offset.
    offsets: row -> byte offset.  used_bytes: the total of all runs.
    where: (v, 3) int64, see `VoxelCache`.  moved_bytes: of the voxels moved so far.
    sizes: bytes of each row, rounded with `ArenaBuffer.rounded`.
    victims: returns the resident rows in order of eviction.  on_evict: called with each evicted row.
    pins, loading: rows in use, which are neither evicted nor moved.
    """

    def __init__(
        self,
        budget_bytes: int,
        sizes: list[int],
        victims: Callable[[], Iterable[int]],
        on_evict: Callable[[int], None],
        pins: Collection[int],
        loading: Collection[int],
    ) -> None:
        """Begin with an empty buffer of `budget_bytes`."""
        self.buffer, self.sizes = ArenaBuffer(budget_bytes), sizes
        self.where = np.full((len(sizes), 3), -1, np.int64)
        self._ordered, self._on_evict, self._pins, self._loading = victims, on_evict, pins, loading
        self.offsets: dict[int, int] = {}
        self.used_bytes = self.moved_bytes = 0
        self._address = self.buffer.arena.halves.ctypes.data
        self._runs: list[tuple[int, int]] = []  # (offset, row), ascending
        self._gaps: list[tuple[int, int]] = []  # (bytes, offset), ascending, of those with bytes
        self._add_gap(0)

    def allocate(self, row: int, keeps: Callable[[int], bool], most: int | None = None) -> bool:
        """Allocate a run for a voxel without one, evicting others in order if needed.

        Return whether the voxel has a run now.
        keeps: whether to evict no voxel of a row, besides those in use.
        most: limit of rows examined to find victims; None: all rows.
        Nothing is evicted if evicting everything allowed would free too few bytes. If free bytes
        are fragmented, more voxels are evicted than the size requires. If voxels that must stay lie
        between the gaps, the allocation may fail although voxels were evicted.
        """
        size = self.sizes[row]
        offset = self._best_fit(size)
        if offset is None:
            offset = self._clear(size, keeps, most)
        if offset is None:
            return False
        number = bisect.bisect_left(self._runs, (offset, row))
        self._drop_gap(number)
        self._runs.insert(number, (offset, row))
        self._add_gap(number + 1)
        self.offsets[row] = offset
        self.used_bytes += size
        return True

    def forget(self, row: int) -> int:
        """Release a voxel's run; return its offset."""
        self.where[row] = -1
        offset = self.offsets.pop(row)
        number = bisect.bisect_left(self._runs, (offset, row))
        self._drop_gap(number)
        self._drop_gap(number + 1)
        del self._runs[number]
        self._add_gap(number)
        self.used_bytes -= self.sizes[row]
        return offset

    def evict_all_but(self, rows: Collection[int]) -> None:
        """Evict all voxels but these and move these together; none may be in use or loading."""
        for row in [row for row in self.offsets if row not in rows]:
            self._evict(row)
        self._pack(0, len(self._runs))

    # --- gaps ---

    def _gap(self, number: int) -> tuple[int, int]:
        """Return the gap before a run, or behind the last one: (bytes, offset)."""
        low, high = 0, self.buffer.total_bytes
        if number:
            offset, row = self._runs[number - 1]
            low = offset + self.sizes[row]
        if number < len(self._runs):
            high = self._runs[number][0]
        return high - low, low

    def _add_gap(self, number: int) -> None:
        """List the gap before a run."""
        gap = self._gap(number)
        if gap[0]:
            bisect.insort(self._gaps, gap)

    def _drop_gap(self, number: int) -> None:
        """Remove the gap before a run from the list, before one of its ends changes."""
        gap = self._gap(number)
        if gap[0]:
            del self._gaps[bisect.bisect_left(self._gaps, gap)]

    def _best_fit(self, size: int) -> int | None:
        """Return the offset of the gap for `size` bytes; None if none suffices."""
        at = bisect.bisect_left(self._gaps, (size, -1))
        return self._gaps[at][1] if at < len(self._gaps) else None

    # --- room for a voxel ---

    def _is_free(self, row: int) -> bool:
        """Return whether no thread uses or loads a voxel."""
        return row not in self._pins and row not in self._loading

    def _victims(self, keeps: Callable[[int], bool], most: int | None) -> Iterator[int]:
        """Iterate over the rows that may be evicted, in order."""
        rows = islice(self._ordered(), most)
        return (row for row in rows if self._is_free(row) and not keeps(row))

    def _evict(self, row: int) -> int:
        """Evict a voxel; return the offset of its run."""
        self._on_evict(row)
        return self.forget(row)

    def _clear(self, size: int, keeps: Callable[[int], bool], most: int | None) -> int | None:
        """Evict and move voxels for a run of `size` bytes; return its offset, or None on failure.

        See `allocate` for the parameters. Gaps are joined around the last victim and around the
        largest gap. While that does not suffice, more voxels are evicted, up to SLACK of the buffer.
        After that, all runs are searched.
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
                offset = self._join(size, 0, len(self._runs))
                if offset is not None or not more:
                    return offset
            near = self._evict(more.popleft())  # pinned voxels may separate it from the other gaps

    def _join_around(self, size: int, near: int) -> int | None:
        """Make a gap of `size` bytes, moving voxels together near an offset if needed.

        Search around the offset `near`, unless it is negative, and around the largest gap. Return
        the gap's offset, or None if there are too few free bytes.
        """
        offset = self._best_fit(size)
        if offset is not None:
            return offset
        looked, runs = (0, 0), self._runs
        largest = self._gaps[-1][1] if self._gaps else -1
        for place in (near, largest) if near >= 0 else (largest,):
            at = bisect.bisect_left(runs, (place, -1))
            low = bisect.bisect_left(runs, (place - AROUND_SIZES * size, -1))
            high = bisect.bisect_left(runs, (place + AROUND_SIZES * size, -1))
            some = max(0, min(at - AROUND, low)), min(len(runs), max(at + AROUND, high))
            if some != looked:
                offset, looked = self._join(size, *some), some
                if offset is not None:
                    return offset
        return None

    def _join(self, size: int, low: int, high: int) -> int | None:
        """Make a gap of `size` bytes among the runs `low` to `high` - 1 by moving voxels together.

        Of the stretches with `size` free bytes and only movable voxels, choose the one with the
        fewest bytes to move. Return the gap's offset, or None if there is no such stretch.
        """
        best, moves, at = None, 0, self._gap(low)[1]
        # The stretch begins at run `begin`; `free` and `held` are its free and used bytes.
        begin, free, held = low, 0, 0
        behind = (sum(self._gap(high)), -1)
        for number, (offset, row) in enumerate([*self._runs[low:high], behind], low):
            free += offset - at
            while free >= size:
                if best is None or held < moves:
                    best, moves = (begin, number), held
                if begin == number:
                    break
                # Shorten the stretch from its beginning.
                free -= self._gap(begin)[0]
                held -= self.sizes[self._runs[begin][1]]
                begin += 1
            if row < 0:
                break
            at = offset + self.sizes[row]
            if self._is_free(row):
                held += self.sizes[row]
            else:
                begin, free, held = number + 1, 0, 0
        return None if best is None else self._pack(*best)

    def _pack(self, begin: int, end: int) -> int:
        """Move the voxels of runs `begin` to `end` - 1 together; return the offset of the gap behind.

        A row of `where` counts from the start of the arena in words, words and halfwords.
        """
        to = self._gap(begin)[1]
        for number in range(begin, end + 1):
            self._drop_gap(number)
        for number in range(begin, end):
            offset, row = self._runs[number]
            shift, size = offset - to, self.sizes[row]
            if shift:
                ctypes.memmove(self._address + to, self._address + offset, size)
                self._runs[number] = (to, row)
                self.offsets[row] = to
                self.where[row] -= (shift // 4, shift // 4, shift // 2)
                self.moved_bytes += size
            to += size
        self._add_gap(end)
        return to

    def check(self) -> None:
        """Assert that runs and gaps tile the buffer and that their bytes add up."""
        assert self._runs == sorted((offset, row) for row, offset in self.offsets.items())
        gaps = [self._gap(number) for number in range(len(self._runs) + 1)]
        assert all(size >= 0 for size, _ in gaps) and self._gaps == sorted(gap for gap in gaps if gap[0])
        assert self.used_bytes == sum(self.sizes[row] for row in self.offsets)
        assert self.used_bytes + sum(size for size, _ in gaps) == self.buffer.total_bytes
