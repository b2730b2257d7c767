"""Limits of a build: sizes of its work units and files, the largest inputs, and its memory.

`--memory` is divided among all processes of a build: their data and their baseline.
"""

import math
import os
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ..schemas.archive.codec import point_dtype
from ..schemas.errors import SolidcloudError
from .config import BuildConfig

# The points of a record are numbered by int32 (schemas/archive/voxel.py).
MAX_RECORD_POINTS = (1 << 31) - 1

# Least and most points of a range of a scan. A worker takes 2 s for 2^24 points. A small scan is
# also cut, which gives two workers something to do. A file is cut into about RANGES ranges, on
# every machine.
RANGE_POINTS = (1 << 20, 1 << 24)
RANGES = 32

# Points in a work unit (one shard), see `shard_points`: large enough that the cost of opening a
# file is negligible, small enough that a killed worker loses only a few seconds.
SHARD_POINTS = 1 << 22
# A server opens all shards of an archive, and most systems limit a process to 1,024 open files.
MAX_SHARDS = 512

# Voxels with more points are always built in parts of at most this many (dense_voxel.py), so that
# no archive depends on the memory of its builder. Building a part takes some 60 bytes per point.
DENSE_POINTS = 1 << 20
# Bytes per point at the peak of building one voxel (measured with 10^7 points in one voxel: 128).
VOXEL_BYTES_A_POINT = 160

# Most bytes per point on disk at the end (the target is 5 at 0.1 mm). A build that cannot fit is
# refused.
ARCHIVE_BYTES_A_POINT = 6
# Additional bytes per point of a dense voxel while it is built; each job builds at most one.
SCRATCH_BYTES_A_POINT = 21

# Closest-point distances are measured at about this many points; at all points if there are fewer.
RADIUS_SAMPLE = 1_000_000
# Most points of a preview: a viewer rotates them smoothly, and they take 1.2 MB.
MAX_PREVIEW_POINTS = 200_000
# The preview has at most one in PREVIEW_PART of an archive's points, or it would outweigh the
# records of a small archive. Archives of up to WHOLE_PREVIEW_POINTS points are previewed whole.
PREVIEW_PART, WHOLE_PREVIEW_POINTS = 8, 20_000

# Baseline of a process before it holds a point, as PSS: Python, numpy, numba's compiled code, HDF5
# and a reader (measured with two workers on LAS: the builder itself 75 MB, each worker 85 to 110).
BUILDER_BYTES = 90 << 20
WORKER_BYTES = 110 << 20
# Baseline of a build with one job, which is a single process.
ALONE_BYTES = 150 << 20
# Minimum that a worker needs: a part of a dense voxel (dense_voxel.py) and its surroundings.
MIN_SHARE = 96 << 20
# A build may exceed `--memory` by this much, because `--memory 64MB` is less than Python with numba
# takes.
OVER_BYTES = 200 << 20
# Memory of radius, preview and verify for a record: its frame, at most as long as its rows, the
# byte planes of the rows, and this much per node. There are 1.2 to 1.4 times as many nodes as leaf
# nodes if all were full.
RECORD_BYTES_A_NODE = 72
NODES_A_FULL_LEAF = 1.5
# Other memory of these passes.
RECORD_BYTES = 16 << 20

# In addition to its share of --memory, a worker of the local cluster has memory for Python, numba,
# HDF5, the readers and dask itself, and some slack: dask kills a worker that exceeds this fraction
# of the sum without warning.
CLUSTER_WORKER_AIR_BYTES = 384 << 20
CLUSTER_WORKER_KILLED = 0.95
# Baseline of such a worker as dask measures it, shared libraries included (measured: 205 MB after
# reading records).
CLUSTER_WORKER_BYTES = 240 << 20

# End of the advice for a voxel that is too large when a build is refused: the finished work is
# kept.
OTHERWISE = " to resume, or a smaller --voxel and --fresh"


def shard_points(points: int) -> int:
    """Return the number of points per shard of a dataset of `points` points.

    It depends only on `points`, so that the archive's bytes do not depend on the number of jobs.
    Small datasets get a quarter of SHARD_POINTS, which gives each of two workers many shards, so
    that they end at about the same time: with 10^7 points in 3 shards, one of them was idle for a
    quarter of the time.
    """
    # Voxels are not cut, so a shard may stay half empty. Two consecutive shards together hold more
    # than this.
    return max(SHARD_POINTS // 4, min(SHARD_POINTS, points // 64), 2 * points // MAX_SHARDS)


def is_dense(points: int, config: BuildConfig) -> bool:
    """Return whether a voxel of `points` points is built in parts.

    Balanced cells, an option kept for comparison, require the whole voxel.
    """
    return points > DENSE_POINTS and config.cells == "octree"


def jobs_that_fit(jobs: int, config: BuildConfig) -> int:
    """Return how many of `jobs` processes the memory bound allows, at least one."""
    room = config.memory_bytes + OVER_BYTES - BUILDER_BYTES
    return max(1, min(jobs, room // (WORKER_BYTES + MIN_SHARE)))


def memory_share(jobs: int, config: BuildConfig) -> int:
    """Return the bytes of data that each of `jobs` processes may hold."""
    return max(MIN_SHARE, (config.memory_bytes - _base(jobs, config)) // jobs)


def cluster_worker_limit(jobs: int, memory_bytes: int) -> int:
    """Return the dask memory limit [bytes] of each of `jobs` workers started here."""
    return memory_bytes // jobs + CLUSTER_WORKER_AIR_BYTES


def record_bytes_a_point(config: BuildConfig) -> int:
    """Return the bytes per point that a record takes while it is read back."""
    row = point_dtype(
        scan_index="scan" in config.keep,
        intensity="intensity" in config.keep,
        radius_class=config.models != {"mean"},
        rgb="rgb" in config.keep,
        classification="classification" in config.keep,
    )
    return 2 * row.itemsize + math.ceil(NODES_A_FULL_LEAF * RECORD_BYTES_A_NODE / config.leaf)


def readers_that_fit(
    counts: NDArray[np.int64], jobs: int, config: BuildConfig, otherwise: str = OTHERWISE
) -> int:
    """Return how many of `jobs` processes may each hold the record of any voxel at the same time.

    counts: (v,) points of the voxels.  otherwise: end of the error's advice, after the memory to
    give. The result is `jobs` for an external scheduler, whose workers' memory is not known here.
    Raise SolidcloudError if not even one process may hold the largest record.
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
            f"a voxel holds {int(largest[0])} points, and to read its record back takes "
            f"{most >> 20} MB: give {fewer_too}--memory {_memory_for(most, jobs, config) >> 20}MB{otherwise}"
        )
    fits = int(np.searchsorted(needed, _room(jobs, config), "right"))
    return jobs if fits == len(largest) else fits


def bytes_beside_records(counts: NDArray[np.int64], readers: int, jobs: int, config: BuildConfig) -> int:
    """Return the bytes that each of `readers` processes may hold beside the record of a voxel.

    readers: result of `readers_that_fit`. The result is at most the process's share of `--memory`.
    For external workers it is that share.
    """
    share = memory_share(jobs, config)
    if config.scheduler or not len(counts):
        return share
    largest = np.sort(counts)[::-1][:readers] * record_bytes_a_point(config) + RECORD_BYTES
    left = (_room(jobs, config) - int(largest.sum())) // readers
    return max(0, min(share, left, _room_of_one(jobs, config) - int(largest[0])))


def _base(jobs: int, config: BuildConfig) -> int:
    """Return the baseline memory [bytes] of the builder and `jobs` workers; of one process for a single job."""
    alone = jobs == 1 and not (config.cluster or config.scheduler)
    return ALONE_BYTES if alone else BUILDER_BYTES + jobs * WORKER_BYTES


def _room(jobs: int, config: BuildConfig) -> int:
    """Return the bytes that `jobs` processes together may hold of records being read back."""
    return max(config.memory_bytes + OVER_BYTES - _base(jobs, config), MIN_SHARE)


def _room_of_one(jobs: int, config: BuildConfig) -> int:
    """Return the bytes that one of `jobs` processes may hold of such records.

    One process may hold all of them, but dask kills a worker for what it holds itself.
    """
    if not config.cluster:
        return _room(jobs, config)
    limit = cluster_worker_limit(jobs, config.memory_bytes)
    return min(_room(jobs, config), int(limit * CLUSTER_WORKER_KILLED) - CLUSTER_WORKER_BYTES)


def _memory_for(needed: int, jobs: int, config: BuildConfig) -> int:
    """Return the `--memory` with which one of `jobs` processes may hold `needed` bytes.

    The result is in bytes, a whole number of MB. `needed` exceeds what a process may hold now. With
    more memory there are more processes, up to the wanted number, and each takes some of it.
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
    """Round a number of bytes up to whole MB."""
    return -(-size >> 20) << 20
