"""Holds on voxels, and the results of a hold and of a load in the background."""

from collections.abc import Sequence
from enum import Enum
from typing import NamedTuple, Protocol

from ..runtime.stop_flag import StopFlag


class HeldVoxels(NamedTuple):
    """Result of a hold on voxels.

    hits: voxels that were resident or being loaded.  misses: voxels that were not.
    faults: one sentence for each unreadable voxel.
    late: rows that were not resident by the deadline. They may become resident during the hold:
    ignore them when reading `where` (`as_held`).
    waited: time spent on loads, by this thread or others, and on waits for memory [s].
    """

    hits: int
    misses: int
    faults: tuple[str, ...]
    late: tuple[int, ...] = ()
    waited: float = 0.0


class BackgroundLoad(Enum):
    """Result of a load that no request waits for."""

    RESIDENT = "the voxel is resident, or was"
    NO_ROOM = "no voxel may be evicted for it"
    FAILED = "the voxel cannot be read"


class Holder(Protocol):
    """Cache whose voxels can be held: `VoxelCache`."""

    def acquire(self, rows: Sequence[int], deadline: float, *, scan: bool, stop: StopFlag) -> HeldVoxels:
        """Begin a hold."""

    def release(self, rows: Sequence[int]) -> None:
        """End a hold."""


class Hold:
    """Context manager of a hold on voxels. A generator would cost a request twice as much."""

    __slots__ = ("_cache", "_deadline", "_rows", "_scan", "_stop")

    def __init__(
        self, cache: Holder, rows: Sequence[int], deadline: float, scan: bool, stop: StopFlag
    ) -> None:
        """Make a hold; call `VoxelCache.hold` instead."""
        self._cache, self._rows, self._deadline, self._scan, self._stop = cache, rows, deadline, scan, stop

    def __enter__(self) -> HeldVoxels:
        """Wait until all readable voxels are resident, or for the deadline."""
        return self._cache.acquire(self._rows, self._deadline, scan=self._scan, stop=self._stop)

    def __exit__(self, *_: object) -> None:
        """Release the voxels."""
        self._cache.release(self._rows)
