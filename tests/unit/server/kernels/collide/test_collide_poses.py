"""The overlap of two hierarchies: tangency to the unit, trees of unequal height, the paper's figures 5 and 6."""

from pathlib import Path

import archive_cases
import numpy as np
import pytest
import synthetic_scans
from numpy.typing import NDArray
from solidcloud.server.scene import Scene


@pytest.mark.interpreted
@pytest.mark.parametrize("with_slab", [True, False])
@pytest.mark.parametrize(("degree", "leaf"), [(2, 1), (16, 32)])
def test_contact_begins_at_the_very_unit(
    tmp_path: Path, rng: np.random.Generator, degree: int, leaf: int, with_slab: bool
) -> None:
    case = archive_cases.build(
        tmp_path,
        synthetic_scans.make_scan("plane", 1, 60),
        radius=0.0,
        degree=degree,
        leaf=leaf,
        with_slab=with_slab,
    )
    avatar = rng.uniform(-0.3, 0.3, (12, 3))
    with Scene.open(case.archive) as scene:
        info = scene.info()
        scene.add_avatar("avatar", avatar, 0.0)
        for pose in archive_cases.near_poses(rng, case.points, avatar, 8, 0.3):
            reach, _ = archive_cases.least_reach(case, avatar, pose, info.origin, info.lattice_step)
            verdicts = [
                int(scene.collide("avatar", pose[None], units * 2.0**-26).verdict[0])
                for units in (reach - 1, reach, reach + 1)
            ]
            assert verdicts == [0, 1, 1], (pose.tolist(), reach)


@pytest.mark.interpreted
@pytest.mark.parametrize("axis", range(3))
def test_touching_sphere_is_contact(tmp_path: Path, axis: int) -> None:
    # 0.75 m apart along an axis, and 0.25 + 0.5 m of radii: tangent, every number exact.
    case = archive_cases.build(tmp_path, np.zeros((1, 3)), radius=0.25, resolution=archive_cases.BINARY_STEP)
    at = np.zeros(3)
    at[axis] = 0.75
    inside, outside = at.copy(), at.copy()
    inside[axis] -= 2.0**-26
    outside[axis] += 2.0**-26
    poses = np.array([archive_cases.pose_of(np.eye(3), t) for t in (inside, at, outside)])
    assert archive_cases.ask(case, np.zeros((1, 3)), 0.5, poses).tolist() == [1, 1, 0]


def test_one_avatar_point_against_a_tall_tree(tmp_path: Path, rng: np.random.Generator) -> None:
    case = archive_cases.build(
        tmp_path, synthetic_scans.make_scan("plane", 2, 100_000), radius=0.002, voxel=4.0
    )
    _judged(case, np.array([[0.1, 0.2, 0.3]]), 0.001, rng)


def test_tall_avatar_against_one_scan_point(tmp_path: Path, rng: np.random.Generator) -> None:
    case = archive_cases.build(tmp_path, np.array([[1.0, 2.0, 3.0]]), radius=0.002)
    _judged(case, synthetic_scans.make_scan("corner", 3, 10_000) - 1.0, 0.001, rng)


def _judged(
    case: archive_cases.Case, avatar: NDArray[np.float64], radius: float, rng: np.random.Generator
) -> None:
    poses = archive_cases.near_poses(rng, case.points, avatar, 60, 0.02)
    verdicts = archive_cases.ask(case, avatar, radius, poses)
    expected = case.judge(avatar, radius, poses)
    assert 10 < expected.sum() < 50, "the poses should be a mixture"
    assert verdicts.tolist() == expected.astype(int).tolist()


# --- [Fig12], figures 5 and 6 -------------------------------------------------------------------------


@pytest.mark.parametrize("degree", [2, 8])
def test_an_avatar_whose_front_is_inner_nodes_equals_brute_force(
    tmp_path: Path, rng: np.random.Generator, degree: int
) -> None:
    # 12,000 points: more leaf nodes than a front holds, so that the avatar's side is descended as well.
    points = synthetic_scans.make_scan("corner", 5, 4_000)
    case = archive_cases.build(tmp_path, points, degree=degree, leaf=8)
    direction = rng.normal(size=(12_000, 3))
    avatar = direction / np.linalg.norm(direction, axis=1)[:, None] * rng.uniform(0.28, 0.3, (12_000, 1))
    low, high = points.min(axis=0) - 0.35, points.max(axis=0) + 0.35
    poses = np.stack(
        [archive_cases.pose_of(archive_cases.random_rotation(rng), rng.uniform(low, high)) for _ in range(60)]
    )
    expected = case.judge(avatar, 0.002, poses)
    assert archive_cases.ask(case, avatar, 0.002, poses).tolist() == expected.astype(int).tolist()
    assert 5 < expected.sum() < 55


@pytest.mark.parametrize("leaf", [1, 32])
def test_bounds_cover_what_float32_loses_in_a_large_voxel(
    tmp_path: Path, rng: np.random.Generator, leaf: int
) -> None:
    # 2^21 steps from a voxel's corner float32 tells apart quarters of a step, and these spheres have no slack but that.
    step, steps = 0.25, (1 << 21) - 2
    points = np.concatenate([np.zeros((1, 3)), rng.integers(steps // 2, steps, (200, 3)) * step])
    case = archive_cases.build(
        tmp_path, points, radius=0.0, resolution=step, voxel=step * (1 << 21), leaf=leaf
    )
    avatar = np.array([[0.1, 0.2, 0.3]])
    with Scene.open(case.archive) as scene:
        origin = scene.info().origin
        scene.add_avatar("avatar", avatar, 0.0)
        for pose in archive_cases.near_poses(rng, points[1:], avatar, 300, 3 * step):
            reach, _ = archive_cases.least_reach(case, avatar, pose, origin, step)
            verdicts = [
                int(scene.collide("avatar", pose[None], units * 2.0**-26).verdict[0])
                for units in (reach - 1, reach)
            ]
            assert verdicts == [0, 1], (pose.tolist(), reach)
