"""`sweep` with spheres of several sizes: each pair's own reach decides, whatever the model, the motion and the tree."""

import math
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import archive_cases
import judged_sweeps
import naive
import numpy as np
import pytest
import radius_class_archives
import synthetic_scans
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from point_clouds import TREES
from sample_sizes import sample
from solidcloud.schemas.archive.radius_model import LOCAL_CLASSES, RADIUS_CLASSES
from solidcloud.schemas.wire.answers import SweepAnswers, Verdict
from solidcloud.server.avatars.avatar_model import make_avatar
from solidcloud.server.queries.collide import collide
from solidcloud.server.queries.query_inputs import QueryBudget
from solidcloud.server.scene import Scene

FOUND = ("verdict", "lower", "upper", "exact", "outside", "witness_avatar", "witness_cloud")
COUNTED = ("steps", "node_visits", "point_tests", "voxels_missing")


def columns(answers: SweepAnswers, names: tuple[str, ...] = FOUND) -> list[str]:
    """The columns of answers as text, where NaN is like itself."""
    return [str(getattr(answers, name).tolist()) for name in names]


@settings(max_examples=sample(3, 16), deadline=None, derandomize=True)
@given(
    seed=st.integers(0, 2**32 - 1),
    kind=st.sampled_from(judged_sweeps.CLOUDS),
    step=st.sampled_from([1e-4, 1e-2]),
    far=st.sampled_from([0.0, 6.4e6]),
    way=st.sampled_from([0.0, 1e-3, 0.1, 2.0]),
    turn=st.sampled_from([0.0, 1e-6, 0.1, np.pi]),
    margin=st.sampled_from([0.0, 0.02]),
    budget=st.sampled_from([QueryBudget(), QueryBudget(), QueryBudget(tolerance=1e-3)]),
    model=st.sampled_from(radius_class_archives.MODELS),
    tree=TREES,
)
def test_no_sampled_pose_contradicts_the_answer(
    seed: int,
    kind: str,
    step: float,
    far: float,
    way: float,
    turn: float,
    margin: float,
    budget: QueryBudget,
    model: str | None,
    tree: dict[str, Any],
) -> None:
    """Nor does `collide`, of a motion that stands still."""
    rng = np.random.default_rng(seed)
    points = synthetic_scans.make_scan(kind, seed, 120) + far
    avatar, radius = rng.uniform(-0.2, 0.2, (9, 3)), float(rng.choice([0, 1e-3, 0.03]))
    first, last = judged_sweeps.motions(rng, points, avatar, 8, float(rng.choice([0.05, 0.3])), way, turn)
    tolerance = max(1e-6, budget.tolerance)
    with TemporaryDirectory() as folder, radius_class_archives.any_classes():
        case = archive_cases.build(
            Path(folder), points, resolution=step, models=radius_class_archives.STORED, **tree
        )
        with judged_sweeps.opened(case, model=model) as data:
            answers = judged_sweeps.ask(data, avatar, radius, first, last, margin=margin, budget=budget)
            judged_sweeps.judge(
                case, data, avatar, radius, first, last, answers, margin=margin, tolerance=tolerance, model=model,
                samples=20,
            )  # fmt: skip
            still = judged_sweeps.ask(data, avatar, radius, first, first, margin=margin)
            assert (
                still.verdict.tolist()
                == collide(data, make_avatar(avatar, radius), first, margin).verdict.tolist()
            )


@pytest.mark.parametrize("model", ["local:0.2", "border:3", "local+border:0.3"])
def test_a_motion_that_stands_still_touches_from_the_very_unit_on(
    tmp_path: Path, rng: np.random.Generator, model: str
) -> None:
    points, avatar = synthetic_scans.make_scan("noise", 5, 60), rng.uniform(-0.1, 0.1, (4, 3))
    with radius_class_archives.any_classes():
        case = archive_cases.build(tmp_path, points, models=radius_class_archives.STORED)
    stored, radii = radius_class_archives.stored_radii(case.archive, model)
    found = 0
    with judged_sweeps.opened(case, model=model) as data:
        b = naive.scan_units(stored, data.arrays.step)
        for pose in archive_cases.near_poses(rng, points, avatar, 10, 0.1):
            apart = naive.placed_units(avatar, pose, data.arrays.origin)[:, None] - b
            roots = [
                [math.isqrt(int(square) - 1) + 1 for square in row] for row in (apart * apart).sum(axis=2)
            ]
            least = int((np.array(roots) - radii).min())
            if least < 1:
                continue
            found += 1
            for margin in (least - 1, least):
                answers = judged_sweeps.ask(
                    data, avatar, 0.0, pose[None], pose[None], margin=margin / naive.UNITS
                )
                assert answers.verdict[0] == (margin == least) and answers.exact[0]
    assert found > 3


@settings(max_examples=sample(4, 20), deadline=None, derandomize=True)
@given(seed=st.integers(0, 2**32 - 1), model=st.sampled_from(radius_class_archives.MODELS), tree=TREES)
def test_a_point_going_straight_touches_when_the_quadratic_says(
    seed: int, model: str | None, tree: dict[str, Any]
) -> None:
    """The first sphere that is met need not be of the nearest point, nor the largest."""
    rng = np.random.default_rng(seed)
    points, point, radius = rng.uniform(-0.5, 0.5, (200, 3)), np.zeros((1, 3)), 0.004
    first, last = np.tile(np.eye(4), (2, 30, 1, 1))
    first[:, :3, 3] = rng.normal(size=(30, 3))
    first[:, :3, 3] *= 1.2 / np.linalg.norm(first[:, :3, 3], axis=1)[:, None]
    last[:, :3, 3] = -first[:, :3, 3] + rng.normal(size=(30, 3)) * 0.3
    with TemporaryDirectory() as folder, radius_class_archives.any_classes():
        case = archive_cases.build(Path(folder), points, models=radius_class_archives.STORED, **tree)
        with judged_sweeps.opened(case, model=model) as data:
            answers = judged_sweeps.ask(data, point, radius, first, last)
            stored, units = radius_class_archives.stored_radii(case.archive, model)
            places = data.arrays.origin + stored * data.arrays.step
    begin, way = first[:, None, :3, 3] - places, (last - first)[:, None, :3, 3]
    a, b = (way * way).sum(axis=2), (begin * way).sum(axis=2)

    def met(more: int) -> NDArray[np.float64]:
        """When each sphere (k, n) is met, were it so many units larger; inf: never."""
        reach = (units + more) / naive.UNITS + radius
        root = b * b - a * ((begin * begin).sum(axis=2) - reach * reach)
        when = np.where(root >= 0, (-b - np.sqrt(np.maximum(root, 0))) / a, np.inf)
        assert (when > 0).all()  # begins outside of all
        return np.where(when > 1, np.inf, when)

    # Rounding a coordinate to whole units moves a point by less than one.
    sooner, later = met(1), met(-1)
    soonest, latest = sooner.min(axis=1), later.min(axis=1)
    assert (answers.verdict[np.isfinite(latest)] == Verdict.CONTACT).all()
    assert (answers.verdict[np.isinf(soonest)] == Verdict.CLEAR).all()
    touches = answers.verdict == Verdict.CONTACT
    assert ((answers.lower <= latest) & (answers.upper >= soonest))[touches].all()
    assert answers.exact.all()
    # The witness is the point that is met, where no other is within a micrometre's time.
    alone = touches & (np.sort(sooner, axis=1)[:, 1] > latest + 1e-5)
    assert np.abs(answers.witness_cloud - places[sooner.argmin(axis=1)])[alone].max(initial=0.0) < 1e-9


@settings(max_examples=sample(3, 8), deadline=None, derandomize=True)
@given(
    seed=st.integers(0, 2**32 - 1),
    kind=st.sampled_from(judged_sweeps.CLOUDS),
    turn=st.sampled_from([0.0, 0.3, 2.0]),
    model=st.sampled_from(radius_class_archives.MODELS[:3]),
)
def test_no_tree_nor_order_changes_an_answer(seed: int, kind: str, turn: float, model: str) -> None:
    """To the last bit, and the witness with it."""
    rng = np.random.default_rng(seed)
    points, avatar = synthetic_scans.make_scan(kind, seed, 300), rng.uniform(-0.2, 0.2, (60, 3))
    first, last = judged_sweeps.motions(rng, points, avatar, 40, 0.4, 0.5, turn)
    expected: list[str] | None = None
    with TemporaryDirectory() as folder, radius_class_archives.any_classes():
        for options in (
            {"degree": 8, "leaf": 32},
            {"degree": 2, "leaf": 1},
            {"degree": 16, "leaf": 7, "cell_points": 10, "with_slab": False},
        ):
            case = archive_cases.build(
                Path(folder),
                rng.permutation(points),
                resolution=1e-3,
                models=radius_class_archives.STORED,
                **options,
            )
            with judged_sweeps.opened(case, model=model) as data:
                answers = judged_sweeps.ask(data, rng.permutation(avatar), 0.01, first, last)
            if expected is None:
                expected = columns(answers)
            assert columns(answers) == expected


@pytest.mark.parametrize("turn", [0.0, 0.5])
def test_classes_of_one_radius_cost_and_answer_as_one_radius_does(
    tmp_path: Path, rng: np.random.Generator, turn: float
) -> None:
    """To the last bit, and by the same visits: what classes prune by is what one radius is pruned by."""
    points, avatar = synthetic_scans.make_scan("corner", 3, 500), rng.uniform(-0.2, 0.2, (40, 3))
    with radius_class_archives.any_classes():
        case = archive_cases.build(tmp_path, points, models=radius_class_archives.STORED)
    first, last = judged_sweeps.motions(rng, points, avatar, 100, 0.4, 0.5, turn)
    with judged_sweeps.opened(case) as data:
        alike = data._replace(arrays=data.arrays._replace(radius_deficit=np.zeros(RADIUS_CLASSES, np.int64)))
        one, many = (judged_sweeps.ask(which, avatar, 0.01, first, last) for which in (data, alike))
    assert columns(one, FOUND + COUNTED) == columns(many, FOUND + COUNTED)
    assert {int(Verdict.CLEAR), int(Verdict.CONTACT)} <= set(one.verdict.tolist())


def one_large(local: NDArray[np.int32]) -> NDArray[np.uint8]:
    """The largest local class for the point that is lowest in all coordinates, the smallest for all others."""
    return np.where((local == local.min(axis=0)).all(axis=1), LOCAL_CLASSES - 1, 0).astype(np.uint8)


def test_a_large_sphere_makes_no_work_where_spheres_are_small(
    tmp_path: Path, rng: np.random.Generator
) -> None:
    """One in the voxel is of 160 mm and all others of 5 mm: motions near the others cost as if it were not there."""
    points, avatar = synthetic_scans.make_scan("plane", 3, 2000) + 5.0, rng.uniform(-0.1, 0.1, (200, 3))
    points = np.concatenate([points, points.min(axis=0, keepdims=True) - 1.5])
    with radius_class_archives.any_classes(one_large):
        case = archive_cases.build(tmp_path, points, voxel=64.0, models=radius_class_archives.STORED)
    radii = radius_class_archives.stored_radii(case.archive, "local:5")[1]
    assert np.unique(radii, return_counts=True)[1].tolist() == [2000, 1]
    first, last = judged_sweeps.motions(rng, points[:-1], avatar, 50, 0.15, 0.02, 0.1)
    visits = {}
    for model in ("local:5", "fixed:0.005"):
        with judged_sweeps.opened(case, model=model) as data:
            visits[model] = int(judged_sweeps.ask(data, avatar, 0.0, first, last).node_visits.sum())
    assert 1000 < visits["local:5"] < 1.2 * visits["fixed:0.005"]


@pytest.mark.parametrize("model", ["local", "border:3"])
def test_a_path_asks_of_each_part_what_a_scene_answers(
    tmp_path: Path, rng: np.random.Generator, model: str
) -> None:
    points, avatar = synthetic_scans.make_scan("corner", 7, 60), rng.uniform(-0.2, 0.2, (5, 3))
    with radius_class_archives.any_classes():
        case = archive_cases.build(tmp_path, points, models=radius_class_archives.STORED)
    poses = archive_cases.near_poses(rng, points, avatar, 9, 0.1)
    with Scene.open(case.archive) as scene:
        scene.add_avatar("avatar", avatar, 0.01)
        alone = scene.sweep("avatar", poses[:-1], poses[1:], radius_model=model)
        parts = list(scene.path("avatar", poses, "sweep", radius_model=model))
        other = scene.sweep("avatar", poses[:-1], poses[1:])
    assert [columns(part) for part in parts] == [columns(alone)]
    assert columns(alone) != columns(other) and (alone.upper > 0).any()
    with judged_sweeps.opened(case, model=model) as data:
        judged_sweeps.judge(case, data, avatar, 0.01, poses[:-1], poses[1:], alone, model=model, samples=15)
