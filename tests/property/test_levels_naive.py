"""Levels of detail, compared with brute force: what they say without a voxel of the archive is true."""

import math
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import archive_cases
import naive_distance
import numpy as np
import pytest
import radius_class_archives
from hypothesis import given, settings
from hypothesis import strategies as st
from judged_distance import judge_collide, judge_distance
from levels_in_memory import level_bytes
from point_clouds import KINDS, TREES, cloud
from sample_sizes import sample
from solidcloud.schemas.wire.answers import Verdict
from solidcloud.server.scene import Scene

MODELS = (*radius_class_archives.MODELS, "local", "local+border", "border:0.5")
TOLERANCES = (0.0, 2.0**-26, 3e-3, 0.05, 0.4, 20.0)


@pytest.mark.case(
    35,
    "25 scenes, six tolerances, radii per point: brute force, with no voxel in memory, and from an empty cache on",
)
@settings(max_examples=sample(4, 25), deadline=None, derandomize=True)
@given(
    seed=st.integers(0, 2**32 - 1),
    kind=st.sampled_from(KINDS),
    body=st.sampled_from(KINDS),
    model=st.sampled_from(MODELS),
    voxel=st.sampled_from([0.5, 4.0]),
    tree=TREES,
)
def test_without_a_voxel_everything_said_is_true(
    seed: int, kind: str, body: str, model: str | None, voxel: float, tree: dict[str, Any]
) -> None:
    """The memory holds the level alone: verdicts and bounds are those of the level, or unknown.

    With memory for everything, each answer within a tolerance begins with an empty cache.
    """
    rng = np.random.default_rng(seed)
    points, avatar = cloud(rng, kind, 300), cloud(rng, body, 50) * rng.uniform(0.05, 0.5)
    poses = archive_cases.near_poses(rng, points, avatar, 20, 0.6)
    margin, reach = float(rng.choice([0.0, 0.02, 0.2])), float(rng.choice([0.05, 1.0]))
    with TemporaryDirectory() as folder, radius_class_archives.any_classes():
        case = archive_cases.build(
            Path(folder), points, voxel=voxel, models=radius_class_archives.STORED, **tree
        )
        stored, radii = radius_class_archives.stored_radii(case.archive, model)
        with Scene.open(case.archive) as scene:
            info = scene.info()
        scan = (stored, info.origin, info.lattice_step, radii, avatar, 0.02)
        judged = naive_distance.distance_by_radii(*scan, poses, 5.0)
        signed = np.array([math.inf if found is None else found.signed for found in judged])
        within = np.where(signed <= reach, signed, np.inf)
        room = level_bytes(case.archive)
        with Scene.open(case.archive, level_bytes=0) as scene:
            scene.add_avatar("avatar", avatar, 0.02)
            true = scene.sweep("avatar", poses[:-1], poses[1:], margin, radius_model=model)
        for tolerance in TOLERANCES:
            options: dict[str, Any] = {
                "radius_model": model,
                **({"tolerance": tolerance} if tolerance else {}),
            }
            with Scene.open(case.archive, budget_bytes=room, level_bytes=room) as alone:
                alone.add_avatar("avatar", avatar, 0.02)
                touch = alone.collide("avatar", poses, margin, **options)
                said = signed + 1e-9
                assert (said[touch.verdict == Verdict.CLEAR] > margin).all()
                assert (signed[touch.verdict == Verdict.CONTACT] <= margin + tolerance + 1e-9).all()
                dark = alone.collide("avatar", poses, margin, budget_ms=0.0, **options)
                assert (said[dark.verdict == Verdict.CLEAR] > margin).all()
                assert (signed[dark.verdict == Verdict.CONTACT] <= margin + tolerance + 1e-9).all()
                if tolerance:
                    assert (dark.lower <= signed + 1e-9).all() and (dark.upper >= signed - 1e-9).all()
                near = alone.distance("avatar", poses, reach, budget_ms=0.0, **options)
                assert (near.lower <= np.minimum(within, reach) + 1e-9).all()
                assert (near.upper >= within - 1e-9).all()
                assert alone.residency.resident == 0
                swept = alone.sweep(
                    "avatar", poses[:-1], poses[1:], margin, budget_ms=0.0, radius_model=model
                )
                clear = swept.verdict == Verdict.CLEAR
                assert (true.verdict[clear] == Verdict.CLEAR).all() and (swept.lower[clear] == 1.0).all()
                assert (swept.lower <= np.minimum(true.upper, 1.0)).all()
            with Scene.open(case.archive) as whole:
                whole.add_avatar("avatar", avatar, 0.02)
                touch = whole.collide("avatar", poses, margin, **options)
                if tolerance:
                    judge_collide(touch, signed, margin, tolerance, True)
                else:
                    assert ((touch.verdict == Verdict.CONTACT) == (signed <= margin)).all()
            with Scene.open(case.archive) as whole:
                whole.add_avatar("avatar", avatar, 0.02)
                near = whole.distance("avatar", poses, reach, **options)
                judge_distance(near, within, reach, tolerance, True)


@pytest.mark.case(
    35, "a dense wall: tolerances of 10 and 30 cm need no voxel, an exact answer does; both are right"
)
def test_a_dense_wall_is_answered_from_its_level(tmp_path: Path, rng: np.random.Generator) -> None:
    """Where points are some centimetres apart, 10 and 30 cm need no voxel; an exact answer does."""
    wall = rng.uniform(0, 1, (6000, 3)) * [2.0, 0.003, 2.0]
    body = rng.uniform(-0.1, 0.1, (30, 3))
    case = archive_cases.build(tmp_path, wall, radius=0.002, voxel=1.0)
    poses = np.array(
        [
            archive_cases.pose_of(np.eye(3), np.array([x, y, 1.0]))
            for x in (0.5, 1.0)
            for y in (0.05, 0.3, 0.6)
        ]
    )
    with Scene.open(case.archive) as scene:
        scene.add_avatar("body", body, 0.0)
        loose = scene.collide("body", poses, tolerance=0.1)
        near = scene.distance("body", poses, 1.0, tolerance=0.3)
        assert loose.misses == near.misses == 0 and scene.residency.resident == 0
        exact, true = scene.collide("body", poses), scene.distance("body", poses, 1.0)
        assert exact.misses > 0
        assert (loose.verdict[exact.verdict == Verdict.CONTACT] == Verdict.CONTACT).all()
        assert (true.signed_distance[loose.verdict == Verdict.CONTACT] <= 0.1).all()
        assert (near.lower <= true.signed_distance).all() and (near.upper >= true.signed_distance).all()
        assert (near.upper - near.lower <= 0.3).all()
