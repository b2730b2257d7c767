"""`proximity`: it reports what `distance` answers."""

from pathlib import Path

import archive_cases
import numpy as np
import pytest
import synthetic_scans
from effect_frames import body_of, flip_a_byte, report, world_of
from numpy.typing import NDArray
from solidcloud.schemas.scene.effect_table import Proximity
from solidcloud.schemas.wire.motion_messages import ProximityReport
from solidcloud.server.avatars.avatar_model import make_avatar
from solidcloud.server.scene import Scene
from solidcloud.server.simulation.effects.report_effects import make

BALL = make_avatar([[0.0, 0, 0]], 0.1)
GRID = np.stack(np.meshgrid(np.arange(0, 1, 0.05), np.arange(0, 1, 0.05), [0.0]), axis=-1).reshape(-1, 3)


def at(x: float, y: float, z: float) -> NDArray[np.float64]:
    """The ball there."""
    return archive_cases.pose_of(np.eye(3), np.array([x, y, z]))


@pytest.mark.interpreted
def test_the_report_is_that_of_distance(tmp_path: Path, rng: np.random.Generator) -> None:
    case = archive_cases.build(tmp_path, synthetic_scans.make_scan("corner", 3, 150), voxel=0.5)
    avatar = make_avatar(rng.uniform(-0.2, 0.2, (20, 3)), 0.01)
    runner = make(Proximity(reach=0.3), None)
    met = 0
    with Scene.open(case.archive, "scene") as scene:
        scene.add_avatar("avatar", avatar.points, avatar.radius)
        world = world_of(scene)
        for pose in archive_cases.near_poses(rng, case.points, avatar.points, 20, 0.8):
            found = report(runner, world, body_of(avatar), pose)
            judged = scene.distance("avatar", pose[None], 0.3)
            if np.isinf(judged.signed_distance[0]):
                assert found == ProximityReport()
                continue
            met += 1
            columns = (judged.witness_avatar, judged.witness_cloud, judged.normal)
            assert found.distance == judged.signed_distance[0] and not found.unknown
            assert [found.avatar, found.cloud, found.normal] == [tuple(c[0].tolist()) for c in columns]
    assert 5 < met < 20


@pytest.mark.interpreted
def test_what_could_not_be_read_is_unknown(tmp_path: Path) -> None:
    row = np.column_stack([np.arange(0, 4, 0.1), np.zeros(40), np.zeros(40)])
    case = archive_cases.build(tmp_path, row, voxel=1.0, resolution=1e-3)
    flip_a_byte(case.archive, (1, 0, 0))
    runner, body = make(Proximity(reach=0.3), None), body_of(BALL)
    with Scene.open(case.archive, "scene") as scene:
        world = world_of(scene)
        found = report(runner, world, body, at(1.5, 0, 0.2))
        assert found == ProximityReport(unknown=True)
        found = report(runner, world, body, at(0.7, 0, 0.2))
        assert found.unknown is False and found.distance == pytest.approx(0.09, abs=1e-3), (
            "nearer than it can be"
        )
        found = report(runner, world, body, at(1.05, 0, 0.2))
        assert found.unknown and found.distance is not None, "the nearest known, perhaps not the nearest"
        # The points that cannot be read may be anywhere in their box, at z = 0.
        for height in (0.9, 0.6, 0.5, 0.45):
            assert report(runner, world, body, at(1.5, 0, height)) == ProximityReport()
        assert report(runner, world, body, at(1.5, 0, 0.4)) == ProximityReport(unknown=True)


@pytest.mark.interpreted
def test_witnesses_of_an_archive_at_a_pose_are_in_the_world(tmp_path: Path, rng: np.random.Generator) -> None:
    case = archive_cases.build(tmp_path, GRID)
    there = archive_cases.pose_of(archive_cases.random_rotation(rng), np.array([5.0, -3, 1]))
    runner = make(Proximity(reach=0.2), None)
    with Scene.open(case.archive, "scene") as scene:
        plain = report(runner, world_of(scene), body_of(BALL), at(0.5, 0.5, 0.2))
        found = report(runner, world_of(scene, poses=[there]), body_of(BALL), there @ at(0.5, 0.5, 0.2))
    turned = [[*plain.avatar, 1.0], [*plain.cloud, 1.0], [*plain.normal, 0.0]]
    for said, expected in zip((found.avatar, found.cloud, found.normal), turned, strict=True):
        assert said == pytest.approx((there @ expected)[:3].tolist(), abs=1e-7)
    assert found.distance == pytest.approx(plain.distance, abs=1e-7)
