"""The bits of `sweep` do not depend on which voxels were loaded before."""

from pathlib import Path

import archive_cases
import numpy as np
from point_clouds import cloud
from solidcloud.server.scene import Scene


def test_a_motion_asked_alone_from_an_empty_cache_has_the_bits_of_the_last_of_many(tmp_path: Path) -> None:
    """A turning motion has segments, which begin where a voxel's box is met."""
    rng = np.random.default_rng(0)
    points, avatar = cloud(rng, "cluster", 300), cloud(rng, "cluster", 50) * 0.3
    poses = archive_cases.near_poses(rng, points, avatar, 40, 0.6)
    first, last = poses[:-1], poses[1:]
    case = archive_cases.build(tmp_path, points, voxel=0.3, degree=2, leaf=1, cell_points=1)
    with Scene.open(case.archive, level_bytes=0) as warm:
        warm.add_avatar("avatar", avatar, 0.02)
        warm.sweep("avatar", first, last)
        all_loaded = warm.sweep("avatar", first, last)
        assert all_loaded.misses == 0 and len(set(all_loaded.verdict.tolist())) == 2
    for k in range(len(first)):
        with Scene.open(case.archive, level_bytes=0) as cold:
            cold.add_avatar("avatar", avatar, 0.02)
            alone = cold.sweep("avatar", first[k : k + 1], last[k : k + 1])
        found = alone.verdict[0], alone.lower[0], alone.upper[0], alone.steps[0], alone.node_visits[0]
        expected = (
            all_loaded.verdict[k], all_loaded.lower[k], all_loaded.upper[k], all_loaded.steps[k],
            all_loaded.node_visits[k],
        )  # fmt: skip
        assert found == expected, k
