"""`distance` and the bounded searches with spheres of several sizes: the least gap, exactly, whatever the tree."""

import math
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import archive_cases
import naive
import naive_distance
import numpy as np
import pytest
import radius_class_archives
from hypothesis import given, settings
from hypothesis import strategies as st
from judged_distance import compare, judge_collide, judge_distance
from numpy.typing import NDArray
from point_clouds import KINDS, TREES, cloud
from sample_sizes import sample
from solidcloud.schemas.archive.radius_model import RIM_BIT
from solidcloud.schemas.wire.answers import Verdict
from solidcloud.server.scene import Scene

# `local` and `border` as they are: spheres as large as the cloud, so that avatars are inside most of them.
MODELS = (*radius_class_archives.MODELS, "local", "local+border", "border:0.5")


def signed_of(judged: list[naive_distance.Expected | None]) -> NDArray[np.float64]:
    """What was judged as numbers, inf beyond reach."""
    return np.array([math.inf if found is None else found.signed for found in judged])


@settings(max_examples=sample(5, 30), deadline=None, derandomize=True)
@given(
    seed=st.integers(0, 2**32 - 1),
    kind=st.sampled_from(KINDS),
    count=st.sampled_from([1, 2, 33, 300]),
    body=st.sampled_from(KINDS),
    model=st.sampled_from(MODELS),
    voxel=st.sampled_from([0.07, 0.5, 4.0]),
    step=st.sampled_from([1e-4, archive_cases.BINARY_STEP, 1e-2]),
    tree=TREES,
)
def test_distance_is_that_of_the_least_gap(
    seed: int,
    kind: str,
    count: int,
    body: str,
    model: str | None,
    voxel: float,
    step: float,
    tree: dict[str, Any],
) -> None:
    rng = np.random.default_rng(seed)
    points, avatar = cloud(rng, kind, count), cloud(rng, body, 30) * 0.3
    radius = float(rng.choice([0.0, 0.01]))
    poses = archive_cases.near_poses(rng, points, avatar, 12, 0.6)
    if step == archive_cases.BINARY_STEP:  # all on the lattice: ties abound
        points, avatar = np.rint(points * 16) / 16, np.rint(avatar * 16) / 16
        poses[:, :3, :3], poses[:, :3, 3] = np.eye(3), np.rint(poses[:, :3, 3] * 16) / 16
    reach = float(10.0 ** rng.uniform(-2, 0.5))
    with TemporaryDirectory() as folder, radius_class_archives.any_classes():
        case = archive_cases.build(
            Path(folder), points, voxel=math.ceil(voxel / step) * step, resolution=step,
            models=radius_class_archives.STORED, **tree
        )  # fmt: skip
        stored, radii = radius_class_archives.stored_radii(case.archive, model)
        with Scene.open(case.archive) as scene:
            scan = (stored, scene.info().origin, step, radii, avatar, radius)
            scene.add_avatar("avatar", avatar, radius)
            judged = naive_distance.distance_by_radii(*scan, poses, reach)
            answers = scene.distance("avatar", poses, reach, radius_model=model)
            compare(answers, judged, reach)
            touching = scene.collide("avatar", poses, radius_model=model).verdict
            assert ((answers.verdict == Verdict.CONTACT) == touching).all()
            for pose in poses[:4]:
                # The reach to the very unit, and one less.
                found = naive_distance.distance_by_radii(*scan, pose[None], 9.0)[0]
                assert found is not None
                root = math.isqrt(found.square)
                for units in range(root - 1 - found.radii, root + 3 - found.radii):
                    if units < 0:
                        continue
                    limit = units / naive.UNITS
                    again = scene.distance("avatar", pose[None], limit, radius_model=model)
                    within = found.square <= (units + found.radii) ** 2
                    compare(again, [found if within else None], limit)


def test_an_avatar_whose_front_is_inner_nodes(tmp_path: Path, rng: np.random.Generator) -> None:
    points = cloud(rng, "plane", 500) * [1, 1, 0.1]
    direction = rng.normal(size=(10_000, 3))
    avatar = direction / np.linalg.norm(direction, axis=1)[:, None] * rng.uniform(0.2, 0.21, (10_000, 1))
    poses = np.stack(
        [
            archive_cases.pose_of(archive_cases.random_rotation(rng), rng.uniform(-1.2, 1.2, 3))
            for _ in range(8)
        ]
    )
    with radius_class_archives.any_classes():
        case = archive_cases.build(tmp_path, points, leaf=4, degree=3, models=radius_class_archives.STORED)
    with Scene.open(case.archive) as scene:
        info = scene.info()
        scene.add_avatar("avatar", avatar, 0.002)
        for model in ("local:0.2", "local+border"):
            stored, radii = radius_class_archives.stored_radii(case.archive, model)
            scan = (stored, info.origin, info.lattice_step, radii)
            judged = naive_distance.distance_by_radii(*scan, avatar, 0.002, poses, 0.3)
            compare(scene.distance("avatar", poses, 0.3, radius_model=model), judged, 0.3)
            assert {found is None for found in judged} == {True, False}


def test_a_small_sphere_in_front_of_a_large_one(tmp_path: Path, rng: np.random.Generator) -> None:
    """The nearest centre is not that of the nearest sphere."""
    grid = np.stack(np.meshgrid(np.arange(8), np.arange(8), [0, 1]), -1).reshape(-1, 3) * 0.2
    avatar = grid[:9] - grid[4]
    with radius_class_archives.any_classes():
        case = archive_cases.build(
            tmp_path, grid, resolution=2.0**-8 / 5, radius=0.25, models=radius_class_archives.STORED
        )
    shifts = np.array([(9, 9, 10), (7, -3, 9), (6, 5, -5), (7, 7, 6), (4, 4, 2)]) / 10
    poses = np.array([archive_cases.pose_of(np.eye(3), shift) for shift in shifts])
    poses = np.concatenate([poses, archive_cases.near_poses(rng, grid, avatar, 15, 0.8)])
    farther = 0
    with Scene.open(case.archive) as scene:
        info = scene.info()
        scene.add_avatar("avatar", avatar, 0.0)
        for model in ("local", "border"):
            stored, radii = radius_class_archives.stored_radii(case.archive, model)
            scan = (stored, info.origin, info.lattice_step, radii)
            judged = naive_distance.distance_by_radii(*scan, avatar, 0.0, poses, 2.0)
            compare(scene.distance("avatar", poses, 2.0, radius_model=model), judged, 2.0)
            near = scene.distance("avatar", poses, 2.0, tolerance=0.01, radius_model=model)
            judge_distance(near, signed_of(judged), 2.0, 0.01, True)
            b = naive.scan_units(stored, info.lattice_step)
            for pose, found in zip(poses, judged, strict=True):
                assert found is not None
                farther += found.square > naive.least_square(naive.placed_units(avatar, pose, info.origin), b)
    assert farther > 0 and len(set(radii)) == 2


@pytest.mark.parametrize("rim_right", [True, False])
def test_gaps_that_tie_across_classes_and_a_unit_less(tmp_path: Path, rim_right: bool) -> None:
    """A whole sphere on one side, half a one as near on the other: the lesser point; and a unit decides."""
    half, far = 2.0**-5, 0.5  # of the radius; of the whole sphere's centre
    points = np.array([[-far, 0, 0], [far - half, 0, 0]])
    if not rim_right:
        points = -points
    with radius_class_archives.any_classes(
        lambda local: np.where((local[:, 0] > 512) == rim_right, RIM_BIT, 0).astype(np.uint8)
    ):
        case = archive_cases.build(
            tmp_path,
            points,
            voxel=4.0,
            resolution=archive_cases.BINARY_STEP,
            radius=2 * half,
            models=radius_class_archives.STORED,
        )
    poses = np.array(
        [archive_cases.pose_of(np.eye(3), np.array([units / naive.UNITS, 0, 0])) for units in (-1, 0, 1)]
    )
    with Scene.open(case.archive) as scene:
        info = scene.info()
        stored, radii = radius_class_archives.stored_radii(case.archive, "border")
        assert sorted(radii.tolist()) == [1 << 21, 1 << 22]
        scene.add_avatar("avatar", [[0.0, 0, 0]], 0.0)
        scan = (stored, info.origin, info.lattice_step, radii)
        judged = naive_distance.distance_by_radii(*scan, np.zeros((1, 3)), 0.0, poses, 1.0)
        sides = [found.witness_cloud[0] for found in judged if found is not None]
        assert sides == [points[:, 0].min(), points[:, 0].min(), points[:, 0].max()]
        compare(scene.distance("avatar", poses, 1.0, radius_model="border"), judged, 1.0)


def test_the_class_of_a_node_may_be_that_of_no_point(tmp_path: Path) -> None:
    """A large sphere halved by the rim beside a small one off it: no upper bound may count on a whole one."""
    points = np.array([[0.0, 0, 0], [2.0**-10, 0, 0]])
    with radius_class_archives.any_classes(
        lambda local: np.where(local[:, 0] % 2 == 0, 15 | RIM_BIT, 0).astype(np.uint8)
    ):
        case = archive_cases.build(
            tmp_path,
            points,
            voxel=4.0,
            resolution=archive_cases.BINARY_STEP,
            models=radius_class_archives.STORED,
        )
    poses = np.array(
        [archive_cases.pose_of(np.eye(3), np.array([0, 0, z])) for z in (0.08, 0.0915, 0.1, 0.15, 0.3)]
    )
    with Scene.open(case.archive) as scene:
        info = scene.info()
        stored, radii = radius_class_archives.stored_radii(case.archive, "local+border")
        scene.add_avatar("avatar", [[0.0, 0, 0]], 0.0)
        scan = (stored, info.origin, info.lattice_step, radii, np.zeros((1, 3)), 0.0)
        signed = signed_of(naive_distance.distance_by_radii(*scan, poses, 1.0))
        for tolerance in (0.0, 1e-3):
            options: dict[str, Any] = {"tolerance": tolerance, "radius_model": "local+border"}
            judge_distance(scene.distance("avatar", poses, 1.0, **options), signed, 1.0, tolerance, True)
        judge_collide(scene.collide("avatar", poses, **options), signed, 0.0, tolerance, True)
