"""Arena: one buffer that holds all resident voxels, and its free runs. Not thread-safe."""

import bisect

import numpy as np

from ..kernels.core.scene_arrays import Arena

ALIGNMENT = 64  # a cache line: a row of the arena straddles as few cache lines as possible


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
