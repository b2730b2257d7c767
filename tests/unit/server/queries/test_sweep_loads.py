"""The bits of `sweep` do not depend on which voxels were loaded before."""

from pathlib import Path

import archive_cases
import numpy as np
from levels_in_memory import level_bytes
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


def test_what_a_level_settles_changes_no_bits(tmp_path: Path) -> None:
    """Turning motions towards a wall, over a floor, with half of the scene and all of the level in memory."""
    rng, n = np.random.default_rng(2), 120_000
    wall = [rng.uniform(-3, 3, n), 1 + rng.normal(0, 0.01, n), rng.uniform(0, 2, n)]
    floor = [rng.uniform(-3, 3, n), rng.uniform(-3, 1, n), rng.normal(0, 0.005, n)]
    case = archive_cases.build(tmp_path, np.vstack([np.transpose(wall), np.transpose(floor)]), voxel=0.5)
    body = rng.normal(size=(200, 3))
    body = body / np.linalg.norm(body, axis=1)[:, None] * [0.3, 0.3, 0.8] + [0.0, 0.0, 0.9]
    places = rng.uniform([-2.0, -1.0, 0.05], [2.0, 0.3, 0.15], (1000, 3))[:60]
    first = np.array([archive_cases.pose_of(np.eye(3), place) for place in places])
    last = np.array(
        [
            archive_cases.pose_of(archive_cases.random_rotation(rng), place + rng.normal(0, 0.4, 3))
            for place in places
        ]
    )
    with Scene.open(case.archive, level_bytes=0) as whole:
        whole.add_avatar("body", body, 0.01)
        expected = whole.sweep("body", first, last, tolerance=1e-5)
        half = whole.residency.resident_bytes // 2
    room = level_bytes(case.archive)
    with Scene.open(case.archive, budget_bytes=room + half, level_bytes=room) as scene:
        scene.add_avatar("body", body, 0.01)
        found = [scene.sweep("body", *motion, tolerance=1e-5) for motion in zip(first, last, strict=True)]
        assert scene.stats().evicted > 0 and set(expected.verdict.tolist()) == {0, 1}
    for name in ("verdict", "lower", "upper", "witness_cloud"):
        assert (
            np.concatenate([getattr(one, name) for one in found]).tobytes()
            == getattr(expected, name).tobytes()
        )
