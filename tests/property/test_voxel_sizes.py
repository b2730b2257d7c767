"""Every answer about a scan is the same in voxels of three sizes, in memory and from a small cache, bit for bit."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import archive_cases
import judged_sweeps
import naive_sweep
import numpy as np
import pytest
import radius_class_archives
from numpy.typing import NDArray
from sample_sizes import sample
from solidcloud.schemas.wire.answers import Cost, SweepAnswers
from solidcloud.schemas.wire.arrays import array_fields
from solidcloud.server.scene import Scene

STEP = archive_cases.BINARY_STEP
SIZES = (1.0, 3.3, 8.0)
# Of the cache [bytes]: for all voxels, or for two or three large ones.
BUDGETS = (1 << 26, 1 << 13)
RADIUS, BODY_RADIUS = 0.125, 0.0625
MODELS = (None, "local", "border")
WORK = ("voxels_missing", "node_visits", "point_tests", "steps")
# Centres of the clouds: voxels of every size meet in each.
CENTRES = (1.0, 3.3, 8.0)

Floats = NDArray[np.float64]


def grid(side: int, apart: float) -> Floats:
    """Return the points (side^3, 3) [m] of a cube around the origin: many are equally far from others."""
    axis = (np.arange(side) - (side - 1) / 2) * apart
    return np.stack(np.meshgrid(axis, axis, axis), axis=-1).reshape(-1, 3)


def scan(rng: np.random.Generator, kind: str) -> Floats:
    """Return points (n, 3) [m] around `CENTRES`; the first one is the lattice's origin."""
    clouds = [grid(7, 0.25) if kind == "grid" else rng.normal(0, 0.5, (350, 3)) for _ in CENTRES]
    points = np.concatenate([cloud + at for cloud, at in zip(clouds, CENTRES, strict=True)])
    return np.rint(np.vstack([np.zeros(3), points.clip(0, 10)]) / STEP) * STEP


def body(rng: np.random.Generator) -> Floats:
    """Return scattered points and the corners of a cube (38, 3) [m]."""
    return np.vstack([grid(2, 0.5), rng.uniform(-0.4, 0.4, (30, 3))])


def poses(rng: np.random.Generator, points: Floats, count: int) -> Floats:
    """Return poses (count, 4, 4) near scan points; every other one is not turned, on multiples of 1/8 m."""
    found = np.tile(np.eye(4), (count, 1, 1))
    found[:, :3, 3] = points[rng.integers(len(points), size=count)]
    found[::2, :3, 3] = np.rint(found[::2, :3, 3] * 8) / 8
    for pose in found[1::2]:
        pose[:3, :3] = archive_cases.random_rotation(rng)
        pose[:3, 3] += rng.normal(size=3) * 0.3
    return found


def away(rng: np.random.Generator, at: Floats, far: float) -> Floats:
    """Return poses displaced by about `far` [m]."""
    found = at.copy()
    found[:, :3, 3] += rng.normal(size=(len(at), 3)) * far
    return found


def turned(rng: np.random.Generator, at: Floats) -> Floats:
    """Return poses turned anyhow."""
    found = at.copy()
    found[:, :3, :3] = [archive_cases.random_rotation(rng) for _ in at]
    return found


Ask = Callable[[Scene, dict[str, Any]], Any]


def questions(rng: np.random.Generator, points: Floats) -> tuple[Floats, dict[str, Ask]]:
    """Return poses, and each question about them as a call with options, by name."""
    at = poses(rng, points, 24)
    near, far, turn = away(rng, at, 0.5), away(rng, at, 20), turned(rng, at)
    far_turned = turned(rng, far)
    shifted = points[-12:] + np.array([0, RADIUS, 0])
    places = np.vstack([at[:, :3, 3], points[:12], shifted, rng.uniform(0, 9, (12, 3))])
    ways = np.vstack([np.tile(np.eye(3), (10, 1)), rng.normal(size=(30, 3))])
    return at, {
        "collide": lambda scene, own: scene.collide("body", at, 0.03125, **own),
        "distance": lambda scene, own: scene.distance("body", near, 2.0, **own),
        "contacts": lambda scene, own: scene.contacts("body", at, 50, 0.03125, **own),
        "clusters": lambda scene, own: scene.contacts("body", at, 7, 0.0, 0.3, **own),
        "sweep in contact": lambda scene, own: scene.sweep("body", at, near, **own),
        "sweep from far": lambda scene, own: scene.sweep("body", far, at, **own),
        "turn in contact": lambda scene, own: scene.sweep("body", at, turn, **own),
        "turn from far": lambda scene, own: scene.sweep("body", far_turned, at, **own),
        "raycast": lambda scene, own: scene.raycast(places, ways, 9.0, **own),
        "within": lambda scene, own: scene.within(places, 1.5, **own),
        "objects": lambda scene, own: scene.objects([("body", pose, 1, 0xFFFFFFFF) for pose in at], **own),
    }


def columns(answer: Cost) -> dict[str, bytes]:
    """Return the columns of an answer but those that count work."""
    return {name: getattr(answer, name).tobytes() for name in array_fields(type(answer)) if name not in WORK}


def build(folder: Path, points: Floats, size: float, **options: Any) -> archive_cases.Case:
    """Build an archive in voxels of one size [m]."""
    return archive_cases.build(folder, points, voxel=size, resolution=STEP, **{"radius": RADIUS} | options)


def judge_named(
    case: archive_cases.Case, avatar: Floats, first: Floats, found: SweepAnswers, model: Any
) -> int:
    """Assert that sweeps that start in contact name the least pair, by brute force.

    Return how many of them touch points in several voxels of the least size.
    """
    with judged_sweeps.opened(case, model=model) as data:
        radii, origin, step = judged_sweeps.radii_of(case, data, model), data.arrays.origin, data.arrays.step
    several = 0
    for i in np.flatnonzero(found.upper == 0).tolist():
        pairs = naive_sweep.touching_pairs(case.points, origin, step, radii, avatar, BODY_RADIUS, first[i])
        assert judged_sweeps.named_pair(found, i, origin, step) == min(pairs), (model, i, first[i].tolist())
        several += len({tuple(int(c * step // SIZES[0]) for c in point) for point, _ in pairs}) > 1
    return several


@pytest.mark.parametrize("kind", ["grid", "noise"])
@pytest.mark.parametrize("seed", range(sample(2, 8)))
def test_no_voxel_size_changes_an_answer(tmp_path: Path, kind: str, seed: int) -> None:
    rng = np.random.default_rng(seed)
    points, avatar = scan(rng, kind), body(rng)
    at, asked = questions(rng, points)
    expected: dict[Any, dict[str, bytes]] = {}
    for size in SIZES:
        case = build(tmp_path, points, size, models=radius_class_archives.STORED)
        for budget in BUDGETS:
            with Scene.open(case.archive, budget_bytes=budget, level_bytes=0) as scene:
                scene.add_avatar("body", avatar, BODY_RADIUS)
                for model in MODELS:
                    for name, ask in asked.items():
                        if name.startswith("turn") and budget == BUDGETS[1]:
                            continue  # the exception of NUMERICS.md N5
                        answer = ask(scene, {} if model is None else {"radius_model": model})
                        found = columns(answer)
                        same = expected.setdefault((model, name), found)
                        different = [each for each in found if found[each] != same[each]]
                        assert not different, (seed, size, budget, model, name, different)
                        if name.endswith("in contact") and size == SIZES[0] and budget == BUDGETS[0]:
                            assert judge_named(case, avatar, at, answer, model) >= 6
                assert (scene.stats().evicted > 0) == (budget == BUDGETS[1])


def test_no_voxel_size_changes_a_contact_of_many_points_at_once(tmp_path: Path) -> None:
    """A body that turns about the vertical comes down on a floor: its 81 feet touch within some nanometres."""
    rng = np.random.default_rng(0)
    axis = np.arange(48) * 0.125
    floor = np.stack([*map(np.ravel, np.meshgrid(axis, axis)), np.zeros(48 * 48)], axis=1)
    feet = grid(9, 0.125)[::9] * [1, 1, 0]
    first = np.tile(np.eye(4), (200, 1, 1))
    first[:, :2, 3] = np.rint(rng.uniform(1, 5, (200, 2)) * 8) / 8
    first[:, 2, 3] = rng.uniform(0.2, 1, 200)
    last = first.copy()
    last[:, 2, 3] -= rng.uniform(0.2, 2, 200)
    angle = rng.uniform(0, 3, 200)
    last[:, 0, 0] = last[:, 1, 1] = np.cos(angle)
    last[:, 1, 0], last[:, 0, 1] = np.sin(angle), -np.sin(angle)
    found = []
    for size in SIZES:
        with Scene.open(build(tmp_path, floor, size).archive, level_bytes=0) as scene:
            scene.add_avatar("feet", feet, BODY_RADIUS)
            answers = scene.sweep("feet", first, last)
        assert 50 < (answers.upper <= 1).sum() < 200 and (answers.lower > 0).all()
        found.append(columns(answers))
    assert found[0] == found[1] == found[2]
