"""`proximity`: it reports what `distance` answers; what is remembered changes what that costs, and nothing else."""

import shutil
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
from solidcloud.server.simulation.effects.report_effects import CACHE_KEY, make

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


def test_what_is_remembered_changes_no_report(tmp_path: Path, rng: np.random.Generator) -> None:
    case = archive_cases.build(tmp_path, synthetic_scans.make_scan("plane", 3, 500), voxel=0.5)
    avatar = make_avatar(rng.uniform(-0.2, 0.2, (20, 3)), 0.01)
    runner, body = make(Proximity(reach=0.15), None), body_of(avatar)
    place, turn, target = case.points[0] - 0.5, np.eye(3), case.points[0]
    found = set()
    with Scene.open(case.archive, "scene") as scene:
        world, plain = world_of(scene), world_of(scene)
        for number in range(400):
            if number % 5:  # else at rest
                if number % 40 == 1:  # past scan points, and away from them
                    target = case.points[rng.integers(len(case.points))] + rng.normal(0, 0.5, 3)
                place = place + 0.02 * (target - place) / np.linalg.norm(target - place)
                angle = rng.normal(0, 0.01)
                c, s = np.cos(angle), np.sin(angle)
                turn = turn @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
            pose = archive_cases.pose_of(turn, place)
            said = report(runner, world, body, pose)
            assert said == report(runner, plain, body_of(avatar), pose)
            found.add(said.distance is None)
    assert found == {True, False}
    assert world.asked["distance"] < 0.75 * plain.asked["distance"], (
        "at rest nothing is searched, nor far away"
    )


@pytest.mark.interpreted
def test_what_could_not_be_read_is_unknown_and_never_remembered(tmp_path: Path) -> None:
    row = np.column_stack([np.arange(0, 4, 0.1), np.zeros(40), np.zeros(40)])
    case = archive_cases.build(tmp_path, row, voxel=1.0, resolution=1e-3)
    flip_a_byte(case.archive, (1, 0, 0))
    runner, body = make(Proximity(reach=0.3), None), body_of(BALL)
    with Scene.open(case.archive, "scene") as scene:
        world = world_of(scene)
        found = report(runner, world, body, at(1.5, 0, 0.2))
        assert found == ProximityReport(unknown=True) and CACHE_KEY not in body.effect_state
        found = report(runner, world, body, at(0.7, 0, 0.2))
        assert found.unknown is False and found.distance == pytest.approx(0.09, abs=1e-3), (
            "nearer than it can be"
        )
        found = report(runner, world, body, at(1.05, 0, 0.2))
        assert found.unknown and found.distance is not None, "the nearest known, perhaps not the nearest"
        # It looks ahead into what cannot be read, and says what a look as far as its reach says.
        # Its points may be anywhere in its box, at z = 0.
        for height in (0.9, 0.6, 0.5, 0.45):
            assert report(runner, world, body, at(1.5, 0, height)) == ProximityReport()
        assert report(runner, world, body, at(1.5, 0, 0.4)) == ProximityReport(unknown=True)


@pytest.mark.interpreted
def test_what_was_remembered_of_other_avatars_and_archives_tells_nothing(tmp_path: Path) -> None:
    case, other = (
        archive_cases.build(tmp_path, GRID),
        archive_cases.build(tmp_path, GRID + np.array([0, 0, 2.0])),
    )
    runner, body = make(Proximity(reach=0.2), None), body_of(BALL)
    with Scene.open(case.archive, "scene") as scene, Scene.open(other.archive, "other") as second:
        world = world_of(scene)
        assert report(runner, world, body, at(0.5, 0.5, 2.15)).distance is None
        assert report(runner, world_of(second), body, at(0.5, 0.5, 2.15)).distance is not None
        assert report(runner, world, body, at(0.5, 0.5, 2.15)).distance is None
        body.avatar = make_avatar([[0.0, 0, -2.0]], 0.1)
        assert report(runner, world, body, at(0.5, 0.5, 2.15)).distance is not None
        body.avatar = make_avatar(np.empty((0, 3)))
        assert report(runner, world, body, at(0.5, 0.5, 2.15)) == ProximityReport()


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


@pytest.mark.interpreted
def test_what_was_remembered_before_a_reload_tells_nothing(tmp_path: Path) -> None:
    case, other = (
        archive_cases.build(tmp_path, GRID),
        archive_cases.build(tmp_path, GRID + np.array([0, 0, 2.0])),
    )
    runner, body = make(Proximity(reach=0.2), None), body_of(BALL)
    with Scene.open(case.archive, "scene") as scene:
        world = world_of(scene)
        for _ in range(3):
            assert report(runner, world, body, at(0.5, 0.5, 2.15)).distance is None
        shutil.rmtree(case.archive)
        other.archive.rename(case.archive)
        scene.reload()
        assert report(runner, world, body, at(0.5, 0.5, 2.15)).distance is not None
