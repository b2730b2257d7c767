"""`collide` equals the definition, whatever the scan, the avatar, the pose, the tree and the order of points.

Few builds and many questions: a build takes a tenth of a second, a question a ten-thousandth.
"""

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import archive_cases
import naive
import numpy as np
import pytest
import synthetic_scans
import trimesh
from hypothesis import example, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
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
from solidcloud.server.avatars.avatar_shape import avatar_shape
from solidcloud.server.scene import Scene


def build(points: NDArray[np.float64], folder: str, **options: Any) -> archive_cases.Case:
    """An archive in a folder of hypothesis's example."""
    return archive_cases.build(Path(folder), points, **options)


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
def test_contact_begins_where_the_definition_says(
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
    """For each pose the margin is set to the least unit that is contact, and to one unit less."""
    rng = np.random.default_rng(seed)
    extent = step * min(voxel_steps * rng.uniform(0.1, 3), 1 << 21)
    if step <= far * 1e-14:  # float64 holds no such lattice there
        far = 0.0
    points = cloud(rng, kind, count) * extent + far * rng.uniform(-1, 1, 3)
    avatar = cloud(rng, body, 20) * (extent * rng.uniform(0.01, 0.5)) + off * rng.uniform(-1, 1, 3)
    radius, scan_radius = step * rng.choice([0, 0.7, 9]), step * rng.choice([0, 0.5, 9])
    with TemporaryDirectory() as folder:
        case = build(
            points, folder, voxel=step * voxel_steps, resolution=step, radius=float(scan_radius), **tree
        )
        with Scene.open(case.archive) as scene:
            info = scene.info()
            scene.add_avatar("avatar", avatar, float(radius))
            for pose in archive_cases.near_poses(rng, points, avatar, 12, extent):
                if np.abs(pose[:3, 3]).max() > 1e9:
                    continue
                least, _ = archive_cases.least_reach(case, avatar, pose, info.origin, step)
                given_units = naive.reach_units(float(radius), info.radius, 0.0)
                for reach in (least - 1, least, least + 1):
                    if not max(given_units, 0) <= reach <= 1 << 30:
                        continue
                    answers = scene.collide("avatar", pose[None], (reach - given_units) / naive.UNITS)
                    assert answers.verdict[0] == (reach >= least), (pose.tolist(), reach, least)
                verdict = scene.collide("avatar", pose[None]).verdict[0]
                assert verdict == (given_units >= least)


@settings(max_examples=sample(3, 12), deadline=None, derandomize=True)
@given(seed=st.integers(0, 2**32 - 1), kind=st.sampled_from(KINDS), margin=st.sampled_from([0.0, 0.05]))
def test_no_tree_voxel_order_or_thread_changes_an_answer(seed: int, kind: str, margin: float) -> None:
    rng = np.random.default_rng(seed)
    points, avatar = cloud(rng, kind, 300), cloud(rng, "sphere", 60) * 0.2
    poses = archive_cases.near_poses(rng, points, avatar, 60, 0.15)
    expected: list[int] | None = None
    with TemporaryDirectory() as folder:
        for options in (
            {"voxel": 4.0},
            {"voxel": 0.5, "degree": 2, "leaf": 1},
            {"voxel": 0.9, "degree": 16, "leaf": 32, "cell_points": 10, "with_slab": False},
        ):
            case = build(rng.permutation(points), folder, resolution=1e-3, **options)
            if expected is None:
                expected = case.judge(avatar, 0.01, poses, margin).astype(int).tolist()
            with Scene.open(case.archive) as scene, ThreadPoolExecutor(4) as pool:
                scene.add_avatar("avatar", rng.permutation(avatar), 0.01)
                assert scene.collide("avatar", poses, margin).verdict.tolist() == expected
                parts = pool.map(lambda p, s=scene: s.collide("avatar", p[None], margin).verdict[0], poses)
                assert list(parts) == expected


@settings(max_examples=sample(3, 10), deadline=None, derandomize=True)
@given(seed=st.integers(0, 2**32 - 1), kinds=st.tuples(st.sampled_from(KINDS), st.sampled_from(KINDS)))
def test_either_may_be_the_scan(seed: int, kinds: tuple[str, str]) -> None:
    """collide(A, B, M) == collide(B, A, M^-1) for M exactly invertible (NUMERICS.md case 29), to the unit."""
    rng = np.random.default_rng(seed)
    step, radii = archive_cases.BINARY_STEP, (3 * archive_cases.BINARY_STEP, 7 * archive_cases.BINARY_STEP)
    clouds = [
        np.rint(cloud(rng, kind, count) / step) * step for kind, count in zip(kinds, (8, 400), strict=True)
    ]
    turns = signed_permutations()
    with TemporaryDirectory() as folder:
        cases_of = [
            build(c, folder, resolution=step, radius=r, leaf=2, degree=2)
            for c, r in zip(clouds, radii, strict=True)
        ]
        with Scene.open(cases_of[0].archive) as first, Scene.open(cases_of[1].archive) as second:
            first.add_avatar("avatar", clouds[1], radii[1])
            second.add_avatar("avatar", clouds[0], radii[0])
            for _ in range(30):
                turn = turns[rng.integers(24)]
                a, b = (c[rng.integers(len(c))] for c in clouds)
                # b of the second cloud comes to lie a whole number of steps beside a of the first.
                pose = archive_cases.pose_of(turn, a - turn @ b + rng.integers(-14, 15, 3) * step)
                back = archive_cases.pose_of(turn.T, -turn.T @ pose[:3, 3])
                one = first.collide("avatar", pose[None]).verdict[0]
                assert one == second.collide("avatar", back[None]).verdict[0]
                placed = clouds[1] @ turn.T + pose[:3, 3]
                square = ((placed[:, None] - clouds[0]) ** 2).sum(axis=2).min()  # exact in float64
                assert one == (square <= sum(radii) ** 2)


@settings(max_examples=sample(3, 10), deadline=None, derandomize=True)
@example(seed=1, shift=(6_378_137, -6_378_137, 6_356_752))
@given(seed=st.integers(0, 2**32 - 1), shift=st.tuples(*[st.integers(-(10**7), 10**7)] * 3))
def test_far_from_the_origin_is_as_at_the_origin(seed: int, shift: tuple[int, int, int]) -> None:
    """Shifts of whole metres of coordinates that are whole 2^-20 m are exact: nothing at all may differ."""
    rng = np.random.default_rng(seed)
    points = np.rint(cloud(rng, "plane", 300) * 2.0**20) * 2.0**-20
    avatar = cloud(rng, "noise", 50) * 0.2
    poses = archive_cases.near_poses(rng, points, avatar, 60, 0.2)
    poses[:, :3, 3] = np.rint(poses[:, :3, 3] * 2.0**20) * 2.0**-20
    moved = poses.copy()
    moved[:, :3, 3] += shift
    with TemporaryDirectory() as folder:
        at_origin, far = build(points, folder), build(points + shift, folder)
        answers = []
        for case, where in ((at_origin, poses), (far, moved)):
            with Scene.open(case.archive) as scene:
                scene.add_avatar("avatar", avatar, 0.01)
                found = scene.collide("avatar", where)
                columns = (found.verdict, found.outside, found.node_visits, found.point_tests)
                answers.append([column.tolist() for column in columns])
    assert answers[0] == answers[1]
    assert 0 < sum(answers[0][0]) < 60


@pytest.mark.parametrize("kind", synthetic_scans.WITH_POINTS)
def test_a_few_poses_of_every_kind_of_scan(tmp_path: Path, rng: np.random.Generator, kind: str) -> None:
    case = archive_cases.build(tmp_path, synthetic_scans.make_scan(kind, 11, 60), radius=0.05)
    avatar = rng.uniform(-0.2, 0.2, (9, 3))
    poses = archive_cases.near_poses(rng, case.points, avatar, 16, 0.3)
    expected = case.judge(avatar, 0.05, poses, 0.02)
    assert archive_cases.ask(case, avatar, 0.05, poses, 0.02).tolist() == expected.astype(int).tolist()
    assert expected.any() and not expected.all()


@settings(max_examples=sample(3, 20), deadline=None, derandomize=True)
@given(
    seed=st.integers(0, 2**32 - 1),
    kind=st.sampled_from(KINDS),
    radius=st.sampled_from([0.02, 0.04]),
    tree=TREES,
)
def test_a_filled_mesh_touches_what_its_spheres_touch(
    seed: int, kind: str, radius: float, tree: dict[str, Any]
) -> None:
    """Scattered points in and around a ball, issue 35: most leaf nodes of the scan hold its inside."""
    rng = np.random.default_rng(seed)
    shape = avatar_shape(trimesh.creation.icosphere(2, 0.3), radius)
    avatar = np.asarray(shape.points)
    points = np.concatenate([cloud(rng, kind, 9), rng.uniform(-2, 2, (3, 3))])
    poses = archive_cases.near_poses(rng, points, avatar, 100, 0.5)
    with TemporaryDirectory() as folder:
        case = build(points, folder, radius=0.005, **tree)
        with Scene.open(case.archive) as scene:
            scene.add_avatar("filled", shape)
            for margin in (0.0, 0.03):
                expected = case.judge(avatar, radius, poses, margin)
                assert scene.collide("filled", poses, margin).verdict.tolist() == expected.tolist()
            early = scene.collide("filled", poses, tolerance=0.03).verdict
            assert (early >= case.judge(avatar, radius, poses)).all() and (early <= expected).all()
            assert (scene.distance("filled", poses, 0.0).verdict == case.judge(avatar, radius, poses)).all()
