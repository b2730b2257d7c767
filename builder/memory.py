"""How `--memory` is shared: all processes of a build together, what they hold of the data and what they are made of."""

import numpy as np
from numpy.typing import NDArray

from ..schemas.errors import SolidcloudError
from .config import BuildConfig

# What a process takes before it holds a point, sum of PSS: Python, numpy, numba's compiled code, HDF5, a reader
# (measured with two workers on LAS: the builder itself 75 MB, each worker 85 to 110).
BUILDER_BYTES = 90 << 20
WORKER_BYTES = 110 << 20
# A build of one job is one process.
ALONE_BYTES = 150 << 20
# What a worker cannot do without: a part of a dense voxel (dense.py) and what is around it.
LEAST_SHARE = 96 << 20
# What a build may take over `--memory` rather than be refused: 64 MB is less than Python with numba.
OVER_BYTES = 200 << 20
# Bytes a point of a record that radius, preview and verify hold: its frame, its planes, and its nodes.
RECORD_BYTES_A_POINT = 18
# Of all other things they hold.
RECORD_BYTES = 16 << 20


def jobs_that_fit(jobs: int, config: BuildConfig) -> int:
    """Processes that the memory bound allows, of so many that are wanted; at least one."""
    room = config.memory_bytes + OVER_BYTES - BUILDER_BYTES
    return max(1, min(jobs, room // (WORKER_BYTES + LEAST_SHARE)))


def memory_share(jobs: int, config: BuildConfig) -> int:
    """Bytes of data that each of `jobs` processes may hold."""
    base = ALONE_BYTES if jobs == 1 else BUILDER_BYTES + jobs * WORKER_BYTES
    return max(LEAST_SHARE, (config.memory_bytes - base) // jobs)


def readers_that_fit(counts: NDArray[np.int64], jobs: int, config: BuildConfig) -> int:
    """How many of `jobs` processes may each hold the record of a voxel at a time, whichever of `counts` (v,) points.

    Raises SolidcloudError where not even one may hold the largest.
    """
    largest = np.sort(counts)[::-1][:jobs]
    needed = np.cumsum(largest * RECORD_BYTES_A_POINT + RECORD_BYTES)
    fits = int(np.searchsorted(needed, _room(jobs, config), "right"))
    if not fits and len(largest):
        most = int(needed[0])
        memory = config.memory_bytes + most - _room(jobs, config)
        fewer = next((n for n in range(jobs - 1, 0, -1) if most <= _room(n, config)), 0)
        jobs_too = f"--jobs {fewer} or " if fewer else ""
        raise SolidcloudError(
            f"a voxel of {config.voxel:g} m holds {int(largest[0])} points, and to read its record back takes "
            f"{most >> 20} MB: give {jobs_too}--memory {(memory + (1 << 20) - 1) >> 20}MB to go on from what is done, "
            "or a smaller --voxel and --fresh"
        )
    return jobs if fits == len(largest) else fits


def _room(jobs: int, config: BuildConfig) -> int:
    """Bytes that all of `jobs` processes may hold together of records that are read back."""
    base = ALONE_BYTES if jobs == 1 else BUILDER_BYTES + jobs * WORKER_BYTES
    return max(config.memory_bytes + OVER_BYTES - base, LEAST_SHARE)
