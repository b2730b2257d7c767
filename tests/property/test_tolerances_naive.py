"""`collide` and `distance` within a tolerance, compared with brute force: early, never late, and never longer."""

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
from judged_distance import ROUNDED, judge_collide, judge_distance
from point_clouds import KINDS, TREES, cloud
from project_scripts import load_script
from sample_sizes import sample
from solidcloud.schemas.wire.answers import Verdict
from solidcloud.server.scene import Scene

MODELS = (*radius_class_archives.MODELS, "local", "local+border", "border:0.5")
TOLERANCES = (2.0**-26, 1e-4, 3e-3, 0.05, 0.4, 20.0)


@settings(max_examples=sample(3, 25), deadline=None, derandomize=True)
@given(
    seed=st.integers(0, 2**32 - 1),
    kind=st.sampled_from(KINDS),
    body=st.sampled_from(KINDS),
    model=st.sampled_from(MODELS),
    voxel=st.sampled_from([0.07, 0.5, 4.0]),
    cache=st.sampled_from([None, 2]),
    tree=TREES,
)
def test_bounds_hold_and_a_larger_tolerance_never_takes_longer(
    seed: int, kind: str, body: str, model: str | None, voxel: float, cache: int | None, tree: dict[str, Any]
) -> None:
    """cache: so many of the largest voxel, so that poses are looked at in pieces."""
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
            most = max(scene.residency.bytes_of([row]) for row in range(info.voxels))
        scan = (stored, info.origin, info.lattice_step, radii, avatar, 0.02)
        judged = naive_distance.distance_by_radii(*scan, poses, 5.0)
        signed = np.array([math.inf if found is None else found.signed for found in judged])
        within = np.where(signed <= reach, signed, np.inf)
        # Of the centres of the nearest pair.
        apart = np.array([0.0 if found is None else math.sqrt(found.square) / 2**26 for found in judged])
        with Scene.open(case.archive, **({} if cache is None else {"budget_bytes": cache * most})) as scene:
            scene.add_avatar("avatar", avatar, 0.02)
            if cache is None:  # the cost of a search depends on what is in memory before
                with scene.residency.hold(range(info.voxels)):
                    pass
            last = scene.collide("avatar", poses, margin, radius_model=model).node_visits
            exact = scene.distance("avatar", poses, reach, radius_model=model).node_visits
            for tolerance in TOLERANCES:
                options: dict[str, Any] = {"tolerance": tolerance, "radius_model": model}
                touch = scene.collide("avatar", poses, margin, **options)
                judge_collide(touch, signed, margin, tolerance, True)
                if cache is None:
                    assert (touch.node_visits <= last).all()
                    last = touch.node_visits
                near = scene.distance("avatar", poses, reach, **options)
                assert cache is not None or (near.node_visits <= exact).all()
                judge_distance(near, within, reach, tolerance, True)
            for share in (1e-9, 0.3, 5.0):
                near = scene.distance("avatar", poses, reach, relative_tolerance=share, radius_model=model)
                found = np.isfinite(within)
                allowed = np.maximum(1e-3, share * apart)
                assert (near.signed_distance[found] <= (within + allowed)[found] + ROUNDED).all()
                judge_distance(near, within, reach, float(allowed[found].max(initial=0.0)), True)


@pytest.mark.case(30, "soles above a floor: in contact early, for no more visits with a larger tolerance")
@pytest.mark.parametrize("turned", [False, True])
def test_soles_above_a_floor_are_in_contact_early(
    tmp_path: Path, rng: np.random.Generator, turned: bool
) -> None:
    """The exact search ends at nodes of the floor that a tolerance looks into, for fewer visits."""
    turn = archive_cases.random_rotation(rng) if turned else np.eye(3)
    floor = np.stack(np.meshgrid(np.arange(40), np.arange(40), [0]), -1).reshape(-1, 3) * 0.02
    floor = floor + rng.uniform(-2e-3, 2e-3, floor.shape)
    body = rng.uniform(-0.1, 0.1, (80, 3))
    body[:, 2] -= body[:, 2].min()
    case = archive_cases.build(tmp_path, floor @ turn.T, radius=0.0, leaf=8, degree=4, cell_points=200)
    poses = np.array(
        [
            archive_cases.pose_of(turn, turn @ [x, y, height])
            for x in (0.2, 0.4, 0.6)
            for y in (0.2, 0.4, 0.6)
            for height in (0.005, 0.015, 0.03)
        ]
    )
    with Scene.open(case.archive) as scene:
        scene.add_avatar("body", body, 0.0)
        exact = scene.collide("body", poses)
        assert (exact.verdict == Verdict.CLEAR).all()
        visits, last = exact.node_visits, np.zeros(len(poses), bool)
        for tolerance in (0.005, 0.02, 0.04, 0.07):
            found = scene.collide("body", poses, tolerance=tolerance)
            early = found.verdict == Verdict.CONTACT
            signed = scene.distance("body", poses).signed_distance
            assert (signed[early] <= tolerance).all() and (early | ~last).all()
            assert not found.exact[early].any() and found.exact[~early].all()
            assert (found.lower <= signed).all() and (found.upper >= signed).all()
            assert (found.node_visits <= visits).all()
            visits, last = found.node_visits, early
        assert early.mean() > 0.8 and visits.sum() < exact.node_visits.sum()


@pytest.mark.timeout(900)
@pytest.mark.case(
    30,
    "100,000 poses with tolerances of 1 mm to 1 m: brute force finds no answer outside its bounds",
)
def test_a_hundred_thousand_poses_by_brute_force() -> None:
    """As scripts/check_tolerances, which judges 10^7."""
    count = sample(4_000, 100_000)
    figures = load_script("check_tolerances").run(count, count // 5, 1)
    assert figures["poses"] == count and figures["what"] == {}
    assert figures["contact early"] > count / 4 and figures["distance not exact"] > count


def test_a_pair_just_beyond_the_first_bound_ends_the_search(tmp_path: Path) -> None:
    """`distance` searches within twice the radii first, then within widening bounds.

    A pair found at such a bound left the search to repeat it, although nothing nearer was worth finding.
    """
    rng = np.random.default_rng(7)
    points, body = rng.uniform(-1, 1, (300, 3)), rng.uniform(-0.15, 0.15, (12, 3))
    points *= 0.3 * rng.random((300, 1)) ** 2
    case = archive_cases.build(tmp_path, points, radius=0.0, voxel=4.0, leaf=16, degree=4, cell_points=128)
    poses = np.tile(np.eye(4), (sample(2_000, 20_000), 1, 1))
    poses[:, :3, 3] = points[rng.integers(300, size=len(poses))] + rng.normal(size=(len(poses), 3)) * 0.1
    with Scene.open(case.archive) as scene:
        scene.add_avatar("body", body, 0.01)
        exact = scene.distance("body", poses, 1.0).node_visits
        for tolerance in (0.01, 0.03, 0.1):
            assert (scene.distance("body", poses, 1.0, tolerance=tolerance).node_visits <= exact).all()
