"""What the voxel cache says of a hold on voxels, and of a load that no request waits for."""

from enum import Enum
from typing import NamedTuple


class Held(NamedTuple):
    """Result of a hold on voxels.

    hits, misses: voxels that were resident before, and that were not.
    faults: one sentence for each unreadable voxel.
    late: rows that were not resident by the deadline. They may become resident during the hold: read
    `where` without them (`as_held`).
    waited: time spent on loads, its own and others', and on waits for memory [s].
    """

    hits: int
    misses: int
    faults: tuple[str, ...]
    late: tuple[int, ...] = ()
    waited: float = 0.0


class Ahead(Enum):
    """Result of a load that no request waits for."""

    THERE = "the voxel is resident, or was"
    NO_ROOM = "no voxel may be evicted for it"
    FAILED = "the voxel cannot be read"
