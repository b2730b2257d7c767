"""`sweep` against brute force at sampled poses, whatever the scan, the avatar, the motion, the tree and the order."""

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import archive_cases
import judged_sweeps
import numpy as np
import synthetic_scans
from hypothesis import given, settings
from hypothesis import strategies as st
from sample_sizes import sample
from solidcloud.schemas.wire.answers import Verdict
from solidcloud.server.avatars.avatar_model import make_avatar
from solidcloud.server.queries.collide import collide


@settings(max_examples=sample(6, 35), deadline=None, derandomize=True)
@given(
    seed=st.integers(0, 2**32 - 1),
    kind=st.sampled_from(judged_sweeps.CLOUDS),
    step=st.sampled_from([1e-5, 1e-4, archive_cases.BINARY_STEP, 1e-2]),
    far=st.sampled_from([0.0, 5e5, 6.4e6]),
    way=st.sampled_from([0.0, 1e-3, 0.1, 2.0]),
    turn=st.sampled_from([0.0, 1e-6, 0.1, np.pi]),
    tolerance=st.sampled_from([1e-6, 1e-6, 1e-3]),
    margin=st.sampled_from([0.0, 0.02]),
    tree=st.fixed_dictionaries(
        {"degree": st.sampled_from([2, 8]), "leaf": st.sampled_from([1, 32]), "with_slab": st.booleans()}
    ),
)
def test_no_sampled_pose_contradicts_the_answer(
    seed: int,
    kind: str,
    step: float,
    far: float,
    way: float,
    turn: float,
    tolerance: float,
    margin: float,
    tree: dict[str, Any],
) -> None:
    rng = np.random.default_rng(seed)
    points = synthetic_scans.make_scan(kind, seed, 120) + far
    avatar, radius = rng.uniform(-0.2, 0.2, (9, 3)), float(rng.choice([0, 1e-3, 0.03]))
    near = float(rng.choice([0.05, 0.3]))
    first, last = judged_sweeps.motions(rng, points, avatar, 8, near, way, turn)
    with TemporaryDirectory() as folder:
        case = archive_cases.build(
            Path(folder), points, resolution=step, radius=float(rng.choice([0, 0.01])), **tree
        )
        with judged_sweeps.opened(case) as data:
            answers = judged_sweeps.ask(data, avatar, radius, first, last, margin=margin, tolerance=tolerance)
            judged_sweeps.judge(
                case, data, avatar, radius, first, last, answers, margin=margin, tolerance=tolerance
            )
            back = judged_sweeps.ask(data, avatar, radius, first, first, margin=margin)
            model = make_avatar(avatar, radius)
            assert back.verdict.tolist() == collide(data, model, first, margin).verdict.tolist()
    assert (answers.verdict != Verdict.UNKNOWN).all() or kind == "duplicates" or radius + margin < 2e-3


@settings(max_examples=sample(3, 10), deadline=None, derandomize=True)
@given(
    seed=st.integers(0, 2**32 - 1),
    kind=st.sampled_from(judged_sweeps.CLOUDS),
    turn=st.sampled_from([0.0, 0.3, 2.0]),
)
def test_no_tree_voxel_or_order_changes_an_answer(seed: int, kind: str, turn: float) -> None:
    """To the last bit, and the witness with it."""
    rng = np.random.default_rng(seed)
    points, avatar = synthetic_scans.make_scan(kind, seed, 300), rng.uniform(-0.2, 0.2, (60, 3))
    first, last = judged_sweeps.motions(rng, points, avatar, 40, 0.4, 0.5, turn)
    expected: list[Any] | None = None
    with TemporaryDirectory() as folder:
        for options in (
            {"voxel": 4.0},
            {"voxel": 0.25, "degree": 2, "leaf": 1},
            {"voxel": 0.9, "degree": 16, "leaf": 32, "cell_points": 10, "with_slab": False},
        ):
            case = archive_cases.build(Path(folder), rng.permutation(points), resolution=1e-3, **options)
            with judged_sweeps.opened(case) as data:
                answers = judged_sweeps.ask(data, rng.permutation(avatar), 0.01, first, last)
            found = [answers.verdict, answers.lower, answers.upper, answers.exact, answers.outside]
            found += [answers.witness_avatar, answers.witness_cloud]
            # As text: NaN is like itself.
            if expected is None:
                expected = [str(column.tolist()) for column in found]
            assert [str(column.tolist()) for column in found] == expected


@settings(max_examples=sample(3, 8), deadline=None, derandomize=True)
@given(seed=st.integers(0, 2**32 - 1), turn=st.sampled_from([0.0, 0.5]))
def test_far_from_the_origin_is_as_at_the_origin(seed: int, turn: float) -> None:
    """The way between exactly shifted poses rounds differently, by 10^-9 m at 5 * 10^6 m: no more may differ."""
    rng = np.random.default_rng(seed)
    shift = np.array([5e5, 5.6e6, 100.0])
    points = np.rint(synthetic_scans.make_scan("corner", seed, 300) * 2.0**20) * 2.0**-20
    avatar = rng.uniform(-0.2, 0.2, (30, 3))
    first, last = judged_sweeps.motions(rng, points, avatar, 40, 0.3, 0.3, turn)
    for poses in (first, last):
        poses[:, :3, 3] = np.rint(poses[:, :3, 3] * 2.0**20) * 2.0**-20
    moved = first.copy(), last.copy()
    for poses in moved:
        poses[:, :3, 3] += shift
    with TemporaryDirectory() as folder:
        found = []
        for place, (a, b) in ((points, (first, last)), (points + shift, moved)):
            case = archive_cases.build(Path(folder), place, resolution=archive_cases.BINARY_STEP)
            with judged_sweeps.opened(case) as data:
                found.append(judged_sweeps.ask(data, avatar, 0.01, a, b))
    one, other = found
    assert one.verdict.tolist() == other.verdict.tolist()
    touches = one.verdict == Verdict.CONTACT
    assert 5 < touches.sum() < 40
    for bound in ("lower", "upper"):
        assert np.abs(getattr(one, bound)[touches] - getattr(other, bound)[touches]).max() < 1e-5


def test_a_few_motions_of_every_sort(tmp_path: Path, rng: np.random.Generator) -> None:
    case = archive_cases.build(tmp_path, synthetic_scans.make_scan("corner", 11, 60), radius=0.05)
    avatar = rng.uniform(-0.2, 0.2, (5, 3))
    verdicts = []
    with judged_sweeps.opened(case) as data:
        for way, turn in ((0.3, 0.0), (0.0, 1.0), (0.3, 0.5)):
            first, last = judged_sweeps.motions(rng, case.points, avatar, 5, 0.5, way, turn)
            answers = judged_sweeps.ask(data, avatar, 0.05, first, last)
            judged_sweeps.judge(case, data, avatar, 0.05, first, last, answers, samples=20)
            verdicts += answers.verdict.tolist()
    assert {int(Verdict.CLEAR), int(Verdict.CONTACT)} <= set(verdicts)
