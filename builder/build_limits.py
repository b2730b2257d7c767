"""Limits of a build: sizes of its work units and files, and the largest inputs that it accepts.

This module imports no kernels. memory_shares.py derives the limits that depend on `--memory`.
"""

import numpy as np
from numpy.typing import NDArray

from ..schemas.errors import BadRequestError
from .config import BuildConfig

# The column of scan numbers is uint16 (schemas/FORMAT.md).
MAX_SCANS = 1 << 16
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


def shard_points(points: int) -> int:
    """Return the number of points per shard of a dataset of `points` points.

    It depends on nothing else, or the bytes of the archive would depend on the number of jobs.
    Small datasets get a quarter of SHARD_POINTS, which gives each of two workers many shards and
    lets them end at about the same time: with 10^7 points in 3 shards, one of them was idle for a
    quarter of the time.
    """
    # Voxels are not cut, so a shard may stay half empty. Two consecutive shards together hold more
    # than this.
    return max(SHARD_POINTS // 4, min(SHARD_POINTS, points // 64), 2 * points // MAX_SHARDS)


def is_dense(points: int, config: BuildConfig) -> bool:
    """Return whether a voxel of so many points is built in parts.

    Balanced cells, an option kept for comparison, require the whole voxel.
    """
    return points > DENSE_POINTS and config.cells == "octree"


def check_normals(counts: NDArray[np.int64], config: BuildConfig) -> None:
    """Refuse normals if a voxel is built in parts, because neighbours may be in another part.

    counts: (v,) points of each voxel.
    """
    most = int(counts.max(initial=0))
    if "normal" in config.keep and is_dense(most, config):
        raise BadRequestError(
            f"--keep normal: a voxel of {config.voxel:g} m holds {most} points, too many to be held in memory: give a "
            "smaller --voxel, or leave it out: a server estimates the normals it needs"
        )
