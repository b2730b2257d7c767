"""How `--memory` is shared: all processes of a build together, what they hold of the data and what they are made of."""

import math
import os
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ..schemas.codec import point_dtype
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
# What radius, preview and verify hold of a record: its frame, at most as long as its rows, and the rows' planes; and of
# each of its nodes, of which there are 1.2 to 1.4 times as many as leaf nodes would be if all were full.
RECORD_BYTES_A_NODE = 72
NODES_A_FULL_LEAF = 1.5
# Of all other things they hold.
RECORD_BYTES = 16 << 20

# Beside its share of --memory a worker of the local cluster has what Python, numba, HDF5, the readers and dask itself
# take, and some air: dask kills what holds more than this part of both, it does not ask.
CLUSTER_WORKER_AIR_BYTES = 384 << 20
CLUSTER_WORKER_KILLED = 0.95
# What such a worker is made of as dask counts it, shared libraries whole (measured: 205 MB when it has read records).
CLUSTER_WORKER_BYTES = 240 << 20

# How the advice for a voxel that is too large goes on where a build is refused: what it has done is kept.
OTHERWISE = " to go on from what is done, or a smaller --voxel and --fresh"


def jobs_that_fit(jobs: int, config: BuildConfig) -> int:
    """Processes that the memory bound allows, of so many that are wanted; at least one."""
    room = config.memory_bytes + OVER_BYTES - BUILDER_BYTES
    return max(1, min(jobs, room // (WORKER_BYTES + LEAST_SHARE)))


def memory_share(jobs: int, config: BuildConfig) -> int:
    """Bytes of data that each of `jobs` processes may hold."""
    base = ALONE_BYTES if jobs == 1 else BUILDER_BYTES + jobs * WORKER_BYTES
    return max(LEAST_SHARE, (config.memory_bytes - base) // jobs)


def cluster_worker_limit(jobs: int, memory_bytes: int) -> int:
    """Bytes at which dask calls each of `jobs` workers that it started here full."""
    return memory_bytes // jobs + CLUSTER_WORKER_AIR_BYTES


def record_bytes_a_point(config: BuildConfig) -> int:
    """Bytes a point that is held of a record while it is read back."""
    row = point_dtype(
        scan_index="scan" in config.keep,
        intensity="intensity" in config.keep,
        radius_class=config.models != {"mean"},
        normal="normal" in config.keep,
    )
    return 2 * row.itemsize + math.ceil(NODES_A_FULL_LEAF * RECORD_BYTES_A_NODE / config.leaf)


def readers_that_fit(
    counts: NDArray[np.int64], jobs: int, config: BuildConfig, otherwise: str = OTHERWISE
) -> int:
    """How many of `jobs` processes may each hold the record of a voxel at a time, whichever of `counts` (v,) points.

    `jobs` for workers of a scheduler that is elsewhere: their memory is not known here. Raises SolidcloudError where
    not even one may hold the largest; otherwise: what its advice ends with, after the memory to be given.
    """
    if config.scheduler or not len(counts):
        return jobs
    largest = np.sort(counts)[::-1][:jobs]
    needed = np.cumsum(largest * record_bytes_a_point(config) + RECORD_BYTES)
    most = int(needed[0])
    if most > _room_of_one(jobs, config):
        option = "--cluster local:" if config.cluster else "--jobs "
        fewer = next((n for n in range(jobs - 1, 0, -1) if most <= _room_of_one(n, config)), 0)
        fewer_too = f"{option}{fewer} or " if fewer else ""
        raise SolidcloudError(
            f"a voxel of {config.voxel:g} m holds {int(largest[0])} points, and to read its record back takes "
            f"{most >> 20} MB: give {fewer_too}--memory {_memory_for(most, jobs, config) >> 20}MB{otherwise}"
        )
    fits = int(np.searchsorted(needed, _room(jobs, config), "right"))
    return jobs if fits == len(largest) else fits


def bytes_beside_records(counts: NDArray[np.int64], readers: int, jobs: int, config: BuildConfig) -> int:
    """What each of `readers` processes, as `readers_that_fit` says, may hold beside the record of a voxel [bytes].

    No more than its share of `--memory`, which alone is what workers elsewhere go by.
    """
    share = memory_share(jobs, config)
    if config.scheduler or not len(counts):
        return share
    largest = np.sort(counts)[::-1][:readers] * record_bytes_a_point(config) + RECORD_BYTES
    left = (_room(jobs, config) - int(largest.sum())) // readers
    return max(0, min(share, left, _room_of_one(jobs, config) - int(largest[0])))


def _base(jobs: int, config: BuildConfig) -> int:
    """Bytes that `jobs` processes are made of."""
    return ALONE_BYTES if jobs == 1 and not config.cluster else BUILDER_BYTES + jobs * WORKER_BYTES


def _room(jobs: int, config: BuildConfig) -> int:
    """Bytes that all of `jobs` processes may hold together of records that are read back."""
    return max(config.memory_bytes + OVER_BYTES - _base(jobs, config), LEAST_SHARE)


def _room_of_one(jobs: int, config: BuildConfig) -> int:
    """Bytes that one of `jobs` processes may hold of them: all, but dask kills a worker for what it holds itself."""
    if not config.cluster:
        return _room(jobs, config)
    limit = cluster_worker_limit(jobs, config.memory_bytes)
    return min(_room(jobs, config), int(limit * CLUSTER_WORKER_KILLED) - CLUSTER_WORKER_BYTES)


def _memory_for(needed: int, jobs: int, config: BuildConfig) -> int:
    """The `--memory` [bytes, whole MB] with which one of `jobs` processes may hold so many bytes, more than it may now.

    With more memory there are more processes, up to those that are wanted, and each takes of it.
    """
    if config.cluster:
        limit = (needed + CLUSTER_WORKER_BYTES + 1) / CLUSTER_WORKER_KILLED
        of_one = int(limit - CLUSTER_WORKER_AIR_BYTES + 1) * jobs
        return _whole_mb(max(needed + _base(jobs, config) - OVER_BYTES, of_one))
    wanted = max(jobs, config.jobs or os.cpu_count() or 1)
    for number in range(jobs, wanted):
        memory = _whole_mb(needed + _base(number, config) - OVER_BYTES)
        if jobs_that_fit(wanted, replace(config, memory_bytes=memory)) <= number:
            return memory
    return _whole_mb(needed + _base(wanted, config) - OVER_BYTES)


def _whole_mb(size: int) -> int:
    """So many bytes, rounded up to whole MB."""
    return -(-size >> 20) << 20
