"""The points of a voxel come back in stored order."""

import numpy as np
import pytest
from solidcloud.builder.config import BuildConfig
from solidcloud.builder.voxel.record_points import voxel_points
from solidcloud.builder.voxel.voxel_octree import VoxelPoints, build_voxel
from solidcloud.schemas.archive.voxel import check_voxel
from synthetic_scans import make_steps


@pytest.mark.interpreted
def test_points_of_a_voxel_come_back_in_stored_order() -> None:
    points = make_steps("corner", 2, 200, 1000)
    voxel = build_voxel(
        1, VoxelPoints(points, points[:, 2].astype(np.uint16)), 1000, BuildConfig(cell_points=20)
    )
    found = voxel_points(voxel, check_voxel(voxel, 1000))
    assert sorted(found.tolist()) == sorted(points.tolist())
    assert np.array_equal(found[:, 2], voxel.scan_index)
