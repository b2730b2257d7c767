"""The overlap of two hierarchies: tangency to the unit, trees of unequal height, the paper's figures 5 and 6."""

from pathlib import Path

import archive_cases
import numpy as np
import pytest
import synthetic_scans
from numpy.typing import NDArray
from solidcloud.server.kernels.core.scene_arrays import LANES
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


def test_answers_carry_their_cost(tmp_path: Path, rng: np.random.Generator) -> None:
    case = archive_cases.build(tmp_path, synthetic_scans.make_scan("plane", 4, 2000))
    avatar = rng.uniform(-0.2, 0.2, (100, 3))
    with Scene.open(case.archive) as scene:
        scene.add_avatar("avatar", avatar, 0.01)
        poses = archive_cases.near_poses(rng, case.points, avatar, 20, 0.1)
        far = archive_cases.pose_of(np.eye(3), np.array([100.0, 0, 0]))
        answers = scene.collide("avatar", np.concatenate([poses, far[None]]))
    assert (answers.node_visits[:-1] > 0).all() and (answers.point_tests[:-1] % LANES == 0).all()
    assert (answers.point_tests[answers.verdict == 1] >= LANES).all()
    assert answers.node_visits[-1] == answers.point_tests[-1] == 0
    # A tree is worth its name: far fewer pairs than all of them.
    assert answers.point_tests.max() < 2000 * 100 / 10


# --- [Fig12], figures 5 and 6 -------------------------------------------------------------------------


class _Node:
    """A node of a small tree of spheres, built here and not by the project. points: (n, 3) below it."""

    def __init__(self, points: NDArray[np.float64], height: int) -> None:
        self.points = points
        self.center = points.mean(axis=0)
        self.radius = float(np.linalg.norm(points - self.center, axis=1).max())
        axis = int(np.ptp(points, axis=0).argmax())
        halves = np.array_split(points[points[:, axis].argsort(kind="stable")], 2)
        self.children = [_Node(half, height - 1) for half in halves] if height else []


def _as_printed(a: _Node, b: _Node, reach: float) -> bool:
    """Figures 5 and 6, line by line; their `else`, lines 10 to 12, also serves a leaf A against an inner B."""
    if np.linalg.norm(a.center - b.center) > a.radius + b.radius + reach:
        return False
    if not a.children and not b.children:
        apart = np.linalg.norm(a.points[:, None] - b.points[None], axis=2)
        return bool((apart <= reach).any())
    if a.children and not b.children:
        return any(_as_printed(x, b, reach) for x in a.children)
    return any(_as_printed(x, y, reach) for x in a.children for y in b.children)


def test_figures_5_and_6_lose_leaf_against_inner_contacts(tmp_path: Path, rng: np.random.Generator) -> None:
    case = archive_cases.build(
        tmp_path, synthetic_scans.make_scan("plane", 5, 512), radius=0.01, leaf=2, degree=2
    )
    avatar = rng.uniform(-0.05, 0.05, (8, 3))
    poses = archive_cases.near_poses(rng, case.points, avatar, 300, 0.06)
    contact = case.judge(avatar, 0.01, poses)
    body, wall = _Node(avatar, height=1), _Node(case.points, height=7)
    moved = [_moved(body, pose) for pose in poses[contact]]
    assert len(moved) >= 150
    # The lattice moved points by up to 0.087 mm, which the copy of the figures knows nothing of: 0.1 mm more.
    # A is a leaf before B is: no children, no pairs of children, no contact found in any of these poses.
    assert not any(_as_printed(a, wall, 0.0201) for a in moved)
    # The other way round the figures have a case of their own, so this copy of them does find contacts.
    assert all(_as_printed(wall, b, 0.0201) for b in moved)
    assert archive_cases.ask(case, avatar, 0.01, poses).tolist() == contact.astype(int).tolist()


def _moved(node: _Node, pose: NDArray[np.float64]) -> _Node:
    """A copy of a tree under a pose."""
    copy = object.__new__(_Node)
    copy.points = node.points @ pose[:3, :3].T + pose[:3, 3]
    copy.center = copy.points.mean(axis=0)
    copy.radius = node.radius
    copy.children = [_moved(child, pose) for child in node.children]
    return copy


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
