"""Store without files, for tests of residency: it counts loads, and waits and fails on demand."""

import threading
import time
from collections import Counter

import numpy as np
from numpy.typing import NDArray
from solidcloud.schemas.errors import CorruptError
from solidcloud.server.kernels.core.scene_arrays import Arena
from solidcloud.server.residency.arena import ALIGNMENT as BLOCK


class FakeStore:
    """Replacement for a `VoxelStore`: the methods that `VoxelCache` calls.

    sizes: (v,) int64 [bytes].  loads: row -> number of loads.  faults: row -> fault of its load.
    gate: loads wait until it is set.
    """

    def __init__(self, blocks: list[int]) -> None:
        """Create voxels of these numbers of cache lines."""
        self.sizes = np.array(blocks, np.int64) * BLOCK
        self.loads: Counter[int] = Counter()
        self.faults: dict[int, str] = {}
        self.gate = threading.Event()
        self.gate.set()
        self.archive = self

    def where(self, row: int) -> str:
        """Return the location of a record, for messages."""
        return f"file.h5: voxel {row}"

    def load(self, row: int, arena: Arena, offset: int) -> NDArray[np.int64]:
        """Fill a voxel's run with its row number, or fail."""
        self.loads[row] += 1
        assert self.gate.wait(20.0)
        fault = self.faults.get(row)
        if fault == "corrupt":
            raise CorruptError(f"{self.where(row)}: not what was written")
        if fault == "unreadable":
            raise OSError(5, "Input/output error")
        if fault == "out of memory":
            raise MemoryError("no room to decode")
        arena.ints[offset // 4 : (offset + int(self.sizes[row])) // 4] = row
        return np.array([offset // 4, offset // 4, offset // 2], np.int64)

    def wait_for_load(self, row: int, seconds: float) -> bool:
        """Return whether a load of this row begins within this many seconds."""
        deadline = time.monotonic() + seconds
        while not self.loads[row] and time.monotonic() < deadline:
            time.sleep(0.001)
        return self.loads[row] > 0
