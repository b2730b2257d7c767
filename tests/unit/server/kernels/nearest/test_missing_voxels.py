"""Voxels that are not resident are bounded by their boxes."""

import math
from pathlib import Path

import archive_cases
import numpy as np
import pytest
import synthetic_scans
from solidcloud.builder.voxel.record_points import voxel_points
from solidcloud.server.avatars.avatar_model import make_avatar
from solidcloud.server.kernels.core.voxels_in_reach import VoxelsInReach
from solidcloud.server.kernels.nearest.missing_voxels import split_missing
from solidcloud.server.queries.context.query_context import check_request, make_scene_data
from solidcloud.server.residency.voxel_cache import VoxelCache
from solidcloud.server.residency.voxel_store import VoxelStore

REACH = 3 << 26  # exact units
RESIDENT = [0, 3]


def rows_of(reach: VoxelsInReach) -> list[list[int]]:
    """Return the voxel rows of each pose."""
    ends = zip(reach.starts[:-1], reach.starts[1:], strict=True)
    return [reach.rows[begin:end].tolist() for begin, end in ends]


@pytest.mark.interpreted
@pytest.mark.parametrize("count", [1, 40])
def test_missing_voxels_are_set_aside_and_bounded(
    tmp_path: Path, rng: np.random.Generator, count: int
) -> None:
    """Eight voxels, two of them resident."""
    scan = synthetic_scans.make_scan("noise", 3, 2500) ** 2 / synthetic_scans.SIZE
    store = VoxelStore(archive_cases.build(tmp_path, scan, voxel=1.0, leaf=2, degree=3).archive)
    archive, cache = store.archive, VoxelCache(store, 1 << 24)
    lattice, data = archive.header.lattice, make_scene_data(archive, cache)
    with cache.hold(range(len(store.sizes))):  # proves all boxes
        where = np.full_like(cache.where, -1)
        where[RESIDENT] = cache.where[RESIDENT]
    body = make_avatar(rng.uniform(-0.2, 0.2, (count, 3)), 0.01)
    poses = np.array(
        [
            archive_cases.pose_of(archive_cases.random_rotation(rng), rng.uniform(-0.5, 2.5, 3))
            for _ in range(12)
        ]
    )
    reach = check_request(data, body, poses, REACH)
    which, starts, rows = np.array([0, 2, 3, 7, 8, 9, 11]), np.empty(13, np.int64), np.empty_like(reach.rows)
    bound, counts = np.full(len(poses), math.inf), np.zeros((3, len(poses)), np.uint32)
    arrays = data.arrays._replace(where=where)
    split_missing(poses, body.arrays, arrays, data.broad, reach, which, starts, rows, bound, counts)
    listed = [own if i in which else [] for i, own in enumerate(rows_of(reach))]
    left = rows_of(reach._replace(starts=starts, rows=rows))
    assert left == [[row for row in own if row in RESIDENT] for own in listed]
    missing = [[row for row in own if row not in RESIDENT] for own in listed]
    assert counts[0].tolist() == [len(own) for own in missing] and counts[0].any()
    points = [
        lattice.to_world(
            voxel_points(*archive.read_voxel(row)) + archive.coordinates[row] * lattice.voxel_steps
        )
        for row in range(len(store.sizes))
    ]
    for i, own in enumerate(missing):
        placed = body.points @ poses[i, :3, :3].T + poses[i, :3, 3]
        apart = [np.linalg.norm(placed[:, None] - points[row], axis=-1).min() for row in own]
        assert bound[i] * lattice.step <= min(apart, default=math.inf)
    assert np.isinf(bound[counts[0] == 0]).all() and (bound[counts[0] > 0] > 0).any()
