"""`distance` equals the definition bit for bit, witnesses and all, whatever the scan, the pose and the tree."""

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import archive_cases
import naive
import naive_distance
import numpy as np
import pytest
import synthetic_scans
from hypothesis import given, settings
from hypothesis import strategies as st
from judged_distance import compare
from point_clouds import (
    COUNTS,
    FAR,
    KINDS,
    OFF,
    STEPS,
    TREES,
    VOXEL_STEPS,
    cloud,
    signed_permutations,
)
from sample_sizes import sample
from solidcloud.schemas.wire.answers import Verdict
from solidcloud.server.scene import Scene


@settings(max_examples=sample(6, 40), deadline=None, derandomize=True)
@given(
    seed=st.integers(0, 2**32 - 1),
    kind=st.sampled_from(KINDS),
    count=COUNTS,
    body=st.sampled_from(KINDS),
    step=STEPS,
    voxel_steps=VOXEL_STEPS,
    far=FAR,
    off=OFF,
    tree=TREES,
)
def test_distance_and_witnesses_are_those_of_the_definition(
    seed: int,
    kind: str,
    count: int,
    body: str,
    step: float,
    voxel_steps: int,
    far: float,
    off: float,
    tree: dict[str, Any],
) -> None:
    rng = np.random.default_rng(seed)
    extent = step * min(voxel_steps * rng.uniform(0.1, 3), 1 << 21)
    if step <= far * 1e-14:  # float64 holds no such lattice there
        far = 0.0
    points = cloud(rng, kind, count) * extent + far * rng.uniform(-1, 1, 3)
    avatar = cloud(rng, body, 40) * (extent * rng.uniform(0.01, 0.5)) + off * rng.uniform(-1, 1, 3)
    radius, scan_radius = float(step * rng.choice([0, 0.7, 9])), float(step * rng.choice([0, 0.5, 9]))
    poses = archive_cases.near_poses(rng, points, avatar, 16, 2 * extent)
    poses = poses[np.abs(poses[:, :3, 3]).max(axis=1) < 1e9]
    reach = float(extent * 10.0 ** rng.uniform(-2, 1))
    with TemporaryDirectory() as folder:
        case = archive_cases.build(
            Path(folder), points, voxel=step * voxel_steps, resolution=step, radius=scan_radius, **tree
        )
        with Scene.open(case.archive) as scene:
            info = scene.info()
            scan = (points, info.origin, step, info.radius)
            most = 15.9 - max(naive.reach_units(radius, info.radius, 0.0) for pose in poses) / naive.UNITS
            if most <= 0:
                return
            reach = min(reach, most)
            scene.add_avatar("avatar", avatar, radius)
            judged = naive_distance.distance(*scan, avatar, radius, poses, reach)
            compare(scene.distance("avatar", poses, reach), judged, reach)
            for pose, found in list(zip(poses, judged, strict=True))[:4]:
                # The reach to the very unit, and one less.
                radii = naive.reach_units(radius, info.radius, 0.0)
                if found is None or found.square <= radii * radii:
                    continue
                root = round(found.square**0.5)
                for units in range(root - 1 - radii, root + 2 - radii):
                    if units < 0:
                        continue
                    limit = units / naive.UNITS
                    again = naive_distance.distance(*scan, avatar, radius, pose[None], limit)
                    compare(scene.distance("avatar", pose[None], limit), again, limit)
                    assert (again[0] is None) == (found.square > (units + radii) ** 2)


@settings(max_examples=sample(3, 8), deadline=None, derandomize=True)
@given(seed=st.integers(0, 2**32 - 1), kind=st.sampled_from(KINDS))
def test_no_tree_voxel_order_or_budget_changes_an_answer(seed: int, kind: str) -> None:
    rng = np.random.default_rng(seed)
    # A coarse lattice and poses on it: ties abound.
    points = np.rint(cloud(rng, kind, 300) * 16) / 16
    avatar = np.rint(cloud(rng, "sphere", 60) * 4) / 32
    turns = signed_permutations()
    poses = np.array(
        [
            archive_cases.pose_of(turns[rng.integers(24)], np.rint(rng.uniform(-24, 24, 3)) / 16)
            for _ in range(20)
        ]
    )
    expected = None
    with TemporaryDirectory() as folder:
        for options in (
            {"voxel": 4.0},
            {"voxel": 0.5, "degree": 2, "leaf": 1},
            {"voxel": 0.25, "degree": 16, "leaf": 32, "cell_points": 10, "with_slab": False},
            {"voxel": 0.5, "degree": 5, "leaf": 7, "cell_points": 10},
        ):
            case = archive_cases.build(Path(folder), rng.permutation(points), resolution=2.0**-6, **options)
            with Scene.open(case.archive) as scene:
                info = scene.info()
                budget = 2 * max(scene.residency.bytes_of([row]) for row in range(info.voxels))
            if expected is None:
                expected = naive_distance.distance(
                    points, info.origin, info.lattice_step, info.radius, avatar, 0.01, poses, 1.5
                )
            for options in ({}, {"budget_bytes": budget}):  # as a whole, and in pieces
                with Scene.open(case.archive, **options) as scene:
                    scene.add_avatar("avatar", rng.permutation(avatar), 0.01)
                    compare(scene.distance("avatar", poses, 1.5), expected, 1.5)
                    scene.residency.check()


@settings(max_examples=sample(3, 10), deadline=None, derandomize=True)
@given(seed=st.integers(0, 2**32 - 1), kinds=st.tuples(st.sampled_from(KINDS), st.sampled_from(KINDS)))
def test_either_may_be_the_scan(seed: int, kinds: tuple[str, str]) -> None:
    """distance(A, B, M) == distance(B, A, M^-1) for M exactly invertible (NUMERICS.md case 29)."""
    rng = np.random.default_rng(seed)
    step, radii = archive_cases.BINARY_STEP, (3 * archive_cases.BINARY_STEP, 7 * archive_cases.BINARY_STEP)
    clouds = [
        np.rint(cloud(rng, kind, count) / step) * step for kind, count in zip(kinds, (8, 400), strict=True)
    ]
    turns = signed_permutations()
    poses = []
    for _ in range(30):
        turn = turns[rng.integers(24)]
        a, b = (c[rng.integers(len(c))] for c in clouds)
        poses.append(archive_cases.pose_of(turn, a - turn @ b + rng.integers(-300, 301, 3) * step))
    back = [archive_cases.pose_of(p[:3, :3].T, -p[:3, :3].T @ p[:3, 3]) for p in poses]
    with TemporaryDirectory() as folder:
        signed = []
        for own, other, way in ((0, 1, poses), (1, 0, back)):
            case = archive_cases.build(
                Path(folder), clouds[own], resolution=step, radius=radii[own], leaf=2, degree=2
            )
            with Scene.open(case.archive) as scene:
                scene.add_avatar("avatar", clouds[other], radii[other])
                signed.append(scene.distance("avatar", np.array(way), 2.0).signed_distance.tolist())
        assert signed[0] == signed[1]


def test_collide_is_distance_within_the_margin(tmp_path: Path, rng: np.random.Generator) -> None:
    case = archive_cases.build(tmp_path, synthetic_scans.make_scan("corner", 3, 2000), voxel=0.4)
    avatar = rng.uniform(-0.2, 0.2, (60, 3))
    poses = archive_cases.near_poses(rng, case.points, avatar, 300, 0.4)
    with Scene.open(case.archive) as scene:
        scene.add_avatar("avatar", avatar, 0.01)
        found = scene.distance("avatar", poses, 0.3)
        for margin in (0.0, 0.01, 0.1, 0.3):
            verdict = scene.collide("avatar", poses, margin).verdict
            assert verdict.tolist() == (found.signed_distance <= margin).astype(int).tolist()
    assert 0 < (found.verdict == Verdict.CONTACT).sum() < 300


def test_more_ties_than_are_kept_until_the_end(tmp_path: Path, rng: np.random.Generator) -> None:
    """Two planes, every point of one above a point of the other: all pairs tie, and the least by coordinates counts."""
    grid = np.stack(np.meshgrid(np.arange(12), np.arange(12), [0]), -1).reshape(-1, 3) / 16
    case = archive_cases.build(
        tmp_path, rng.permutation(grid), resolution=2.0**-6, radius=0.0, leaf=4, degree=2
    )
    shifts = [(0, 0, 2), (2, -3, 2), (0, 1, -5), (1, 1, 0)]
    poses = np.array([archive_cases.pose_of(np.eye(3), np.array(shift) / 16) for shift in shifts])
    with Scene.open(case.archive) as scene:
        info = scene.info()
        scene.add_avatar("avatar", rng.permutation(grid), 0.0)
        expected = naive_distance.distance(
            grid, info.origin, info.lattice_step, info.radius, grid, 0.0, poses, 1.0
        )
        compare(scene.distance("avatar", poses, 1.0), expected, 1.0)


@pytest.mark.parametrize("kind", synthetic_scans.WITH_POINTS)
def test_a_few_poses_of_every_kind_of_scan(tmp_path: Path, rng: np.random.Generator, kind: str) -> None:
    case = archive_cases.build(tmp_path, synthetic_scans.make_scan(kind, 11, 60), radius=0.05)
    avatar = rng.uniform(-0.2, 0.2, (9, 3))
    poses = archive_cases.near_poses(rng, case.points, avatar, 12, 0.5)
    with Scene.open(case.archive) as scene:
        info = scene.info()
        scene.add_avatar("avatar", avatar, 0.05)
        expected = naive_distance.distance(
            case.points, info.origin, info.lattice_step, info.radius, avatar, 0.05, poses, 0.2
        )
        compare(scene.distance("avatar", poses, 0.2), expected, 0.2)


def test_an_avatar_whose_front_is_inner_nodes(tmp_path: Path, rng: np.random.Generator) -> None:
    # 10,000 points: more leaf nodes than a front holds, so that the avatar's side is descended as well.
    points = synthetic_scans.make_scan("corner", 5, 300)
    case = archive_cases.build(tmp_path, points, leaf=4, degree=3)
    direction = rng.normal(size=(10_000, 3))
    avatar = direction / np.linalg.norm(direction, axis=1)[:, None] * rng.uniform(0.2, 0.21, (10_000, 1))
    low, high = points.min(axis=0) - 0.3, points.max(axis=0) + 0.3
    poses = np.stack(
        [archive_cases.pose_of(archive_cases.random_rotation(rng), rng.uniform(low, high)) for _ in range(6)]
    )
    with Scene.open(case.archive) as scene:
        info = scene.info()
        scene.add_avatar("avatar", avatar, 0.002)
        answers = scene.distance("avatar", poses, 0.15)
        expected = naive_distance.distance(
            points, info.origin, info.lattice_step, info.radius, avatar, 0.002, poses, 0.15
        )
    compare(answers, expected, 0.15)
    assert {answer is None for answer in expected} == {True, False}
