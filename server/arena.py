"""The arena: one buffer that holds all resident voxels, and who has which bytes of it. Not thread-safe."""

import bisect

import numpy as np

from .kernels.layout import Arena

ALIGNMENT = 64  # a cache line, so that a row never straddles two more than it must


class ArenaBuffer:
    """A buffer of fixed size, given out in runs, first fit.

    arena: the views the kernels read. The system commits its pages when they are first written, so a large
    budget costs nothing until it is used.
    """

    def __init__(self, budget_bytes: int) -> None:
        """Reserve budget_bytes, rounded down to whole cache lines."""
        self.total_bytes = budget_bytes // ALIGNMENT * ALIGNMENT
        raw = np.empty(self.total_bytes + ALIGNMENT, np.uint8)
        start = -raw.ctypes.data % ALIGNMENT
        buffer = raw[start : start + self.total_bytes]
        self.arena = Arena(buffer.view(np.float32), buffer.view(np.int32), buffer.view(np.uint16))
        self._free = (
            [(0, self.total_bytes)] if self.total_bytes else []
        )  # (offset, bytes), ascending, never adjacent

    @staticmethod
    def rounded(size: int) -> int:
        """The bytes a run of `size` takes."""
        return -(-size // ALIGNMENT) * ALIGNMENT

    def allocate(self, size: int) -> int | None:
        """The offset of a free run of `size` bytes, now taken; None when there is none."""
        size = self.rounded(size)
        for i, (offset, free) in enumerate(self._free):
            if free >= size:
                if free == size:
                    del self._free[i]
                else:
                    self._free[i] = (offset + size, free - size)
                return offset
        return None

    def take(self, offset: int, size: int) -> None:
        """Take a run of `size` bytes from `offset` on, all of which is free."""
        size = self.rounded(size)
        i = bisect.bisect_right(self._free, (offset, self.total_bytes)) - 1
        start, free = self._free[i]
        before, behind = offset - start, start + free - offset - size
        left = [(start, before)] if before else []
        self._free[i : i + 1] = [*left, (offset + size, behind)] if behind else left

    def release(self, offset: int, size: int) -> None:
        """Give back a run that `allocate` gave out, joining it to its free neighbours."""
        size = self.rounded(size)
        i = bisect.bisect_left(self._free, (offset, 0))
        if i < len(self._free) and offset + size == self._free[i][0]:
            size += self._free.pop(i)[1]
        if i > 0 and sum(self._free[i - 1]) == offset:
            i -= 1
            offset, before = self._free.pop(i)
            size += before
        self._free.insert(i, (offset, size))

    def free_runs(self) -> list[tuple[int, int]]:
        """The free runs (offset, bytes), ascending."""
        return list(self._free)
