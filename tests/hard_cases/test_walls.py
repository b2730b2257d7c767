"""Hard cases of motions against thin walls; a test's number is its row in NUMERICS.md."""

from pathlib import Path

import archive_cases
import judged_sweeps
import naive_sweep
import numpy as np
import pytest
from sample_sizes import sample
from solidcloud.schemas.wire.answers import Verdict
from solidcloud.server.avatars.avatar_model import make_avatar
from solidcloud.server.queries.collide import collide
from sweep_poses import at, turn_z, wall

POINT = np.zeros((1, 3))


@pytest.mark.case(
    26,
    "500 motions of 20 to 200 m through a wall of one layer, half rotating: none missed; poses 1 m apart miss many",
)
def test_case_26_no_thin_wall_is_missed(tmp_path: Path, rng: np.random.Generator) -> None:
    """500 walls, each one layer of points, crossed by 20 to 200 m in one motion, with and without turns.

    Poses 1 m apart, and that is what stepping has, miss many of them.
    """
    case = archive_cases.build(tmp_path, wall(1.0, 0.02), radius=0.011, voxel=1.0)
    body, radius = rng.uniform(-0.05, 0.05, (20, 3)), 0.01
    count = sample(60, 500)
    first, last = np.empty((2, count, 4, 4))
    stepped = 0
    for i in range(count):
        way = rng.normal(size=3) * [1, 0.2, 0.2]
        way *= rng.uniform(10, 100) / np.linalg.norm(way)
        through = np.array([0, *rng.uniform(-0.35, 0.35, 2)])
        start = archive_cases.random_rotation(rng)
        # Half of them turn about the middle of the way.
        first[i] = archive_cases.pose_of(start, through - way)
        last[i] = archive_cases.pose_of(start if i % 2 else turn_z(rng.uniform(-1, 1)) @ start, through + way)
        if not i % 2:
            middle = naive_sweep.pose_at(first[i], last[i], 0.5)[:3, 3]
            for pose in (first[i], last[i]):
                pose[:3, 3] += through - middle
    with judged_sweeps.opened(case) as data:
        answers = judged_sweeps.ask(data, body, radius, first, last)
        model = make_avatar(body, radius)
        for i in range(count):
            steps = np.linspace(0, 1, int(np.linalg.norm(last[i] - first[i])) + 1)
            poses = np.array([naive_sweep.pose_at(first[i], last[i], t) for t in steps])
            stepped += (collide(data, model, poses).verdict == Verdict.CONTACT).any()
        some = slice(0, count, 25)
        part = judged_sweeps.ask(data, body, radius, first[some], last[some])
        judged_sweeps.judge(case, data, body, radius, first[some], last[some], part, samples=40)
    assert (answers.verdict == Verdict.CONTACT).all()
    assert answers.exact.mean() > 0.98
    assert stepped < count * 0.6


@pytest.mark.case(
    26, "400 motions of 1 cm to 10 km through a wall 1 mm thick, straight and rotating: none missed"
)
@pytest.mark.parametrize("length", [0.01, 1.0, 100.0, 10_000.0])
def test_case_26_a_wall_of_a_millimetre_is_met_on_any_way(
    tmp_path: Path, rng: np.random.Generator, length: float
) -> None:
    # Spheres of 1 mm, 0.7 mm apart: no hole among them, and nothing behind them.
    case = archive_cases.build(tmp_path, wall(0.03, 0.0007), radius=0.0005, resolution=1e-5)
    count = sample(30, 100)
    way = rng.normal(size=(count, 3)) * [1, 0.3, 0.3]
    way *= length * np.sign(way[:, :1]) / np.linalg.norm(way, axis=1)[:, None]
    part = rng.uniform(0.2, 0.8, (count, 1))  # of the way is before the wall
    through = np.concatenate([np.zeros((count, 1)), rng.uniform(-0.01, 0.01, (count, 2))], axis=1)
    first, last = np.tile(np.eye(4), (2, count, 1, 1))
    first[:, :3, 3], last[:, :3, 3] = through - part * way, through + (1 - part) * way
    for i in range(0, count, 2):
        last[i, :3, :3] = turn_z(rng.uniform(-3, 3))
        # A turn bends the way of the body's origin: put the place it passes at that fraction where the wall is.
        middle = naive_sweep.pose_at(first[i], last[i], float(part[i, 0]))[:3, 3]
        first[i, :3, 3] += through[i] - middle
        last[i, :3, 3] += through[i] - middle
    with judged_sweeps.opened(case) as data:
        answers = judged_sweeps.ask(data, POINT, 0.0001, first, last)
        some = slice(0, count, 10)
        part_of = judged_sweeps.ask(data, POINT, 0.0001, first[some], last[some])
        judged_sweeps.judge(case, data, POINT, 0.0001, first[some], last[some], part_of, samples=20)
    assert (answers.verdict == Verdict.CONTACT).all()
    assert answers.exact.mean() > 0.98


@pytest.mark.case(
    26,
    "motion along a wall at 1 cm to 1 µm, rotating and rolling: the judge's answers in a bounded number of steps",
)
def test_case_26_along_a_wall_and_round_in_place(tmp_path: Path, rng: np.random.Generator) -> None:
    """A centimetre, or a micrometre, from a wall all the way: no crawling, and no claim too many."""
    case = archive_cases.build(
        tmp_path,
        wall(4.0, 0.05),
        radius=0.03,
        voxel=2.0,
        resolution=archive_cases.BINARY_STEP,
    )
    count = sample(24, 60)
    angle = np.arange(count) * np.pi / (count // 2)
    ring = np.stack([np.cos(angle), np.sin(angle), np.zeros(count)], axis=1) * 0.3
    samples = sample(20, 60)
    gaps = {1e-2: 40, 1e-4: 200, 1e-6: 600}
    with judged_sweeps.opened(case) as data:
        for gap, most in gaps.items():
            first, last = at(0.33 + gap, -1.0), at(0.33 + gap, 1.0)
            straight = judged_sweeps.ask(data, ring, 0.0, first, last)
            last[0, :3, :3] = turn_z(-3.0)
            rolling = judged_sweeps.ask(data, ring, 0.0, first, last)
            last[0, :3, 3], last[0, :3, :3] = first[0, :3, 3], turn_z(3.0)
            turning = judged_sweeps.ask(data, ring, 0.0, first, last)
            assert straight.verdict[0] == Verdict.CLEAR and straight.steps[0] <= 4
            assert turning.verdict[0] == Verdict.CLEAR and turning.steps[0] <= most, turning.steps
            judged_sweeps.judge(case, data, ring, 0.0, first, last, turning, samples=samples)
            # Its axis is not the ring's: it swings into the wall.
            assert rolling.verdict[0] == Verdict.CONTACT and rolling.steps[0] <= most
            last[0, :3, 3], last[0, :3, :3] = [0.33 + gap, 1.0, 0.0], turn_z(-3.0)
            judged_sweeps.judge(case, data, ring, 0.0, first, last, rolling, samples=samples)
