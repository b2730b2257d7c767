"""Results of a hold on voxels and of a prefetch."""

from enum import Enum
from typing import NamedTuple


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
