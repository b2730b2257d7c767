"""Hard case of tolerances and budgets; a test's number is its row in NUMERICS.md."""

from pathlib import Path

import archive_cases
import numpy as np
import pytest
import synthetic_scans
from solidcloud.schemas.wire.answers import Verdict
from solidcloud.server.queries.context.anytime_search import collide_bounded, distance_bounded
from solidcloud.server.queries.context.query_budget import NO_LIMIT, QueryBudget
from solidcloud.server.scene import Scene

CLEAR, CONTACT, UNKNOWN = Verdict


@pytest.mark.case(
    30,
    "a verdict decided under a budget of visits stays under every larger one; none contradicts the judge's",
)
def test_case_30_a_budget_takes_nothing_back(tmp_path: Path, rng: np.random.Generator) -> None:
    case = archive_cases.build(tmp_path, synthetic_scans.make_scan("corner", 7, 300), voxel=0.7, leaf=4)
    avatar = rng.uniform(-0.2, 0.2, (30, 3))
    poses = archive_cases.near_poses(rng, case.points, avatar, 25, 0.3)
    truth = case.judge(avatar, 0.01, poses)
    known = np.full(len(poses), UNKNOWN)
    with Scene.open(case.archive) as scene:
        scene.add_avatar("avatar", avatar, 0.01)
        data, model = scene._data, scene.avatar("avatar", "")
        told = []
        for visits in (0, 3, 10, 30, 100, 300, NO_LIMIT - 1):
            verdict = collide_bounded(data, model, poses, 0.0, QueryBudget(visits=visits)).verdict
            assert (verdict[known != UNKNOWN] == known[known != UNKNOWN]).all()
            assert not truth[verdict == CLEAR].any() and truth[verdict == CONTACT].all()
            known = verdict
            told.append(int((verdict != UNKNOWN).sum()))
    assert told[0] < told[-1] == len(poses) and told == sorted(told) and truth.any() and not truth.all()


@pytest.mark.case(30, "contact is reported early by no more than the tolerance, and flagged as not exact")
def test_case_30_early_by_at_most_the_tolerance(tmp_path: Path) -> None:
    # One point, one ball of 0.25 m: contact begins at a distance of exactly 0.25 m, and early at 0.25 m + 1/8 m.
    case = archive_cases.build(tmp_path, np.zeros((1, 3)), radius=0.0, resolution=archive_cases.BINARY_STEP)
    unit = 2.0**-26
    away = np.array([0.25, 0.25 + unit, 0.375 - unit, 0.375, 0.375 + unit, 0.5])
    poses = np.array([archive_cases.pose_of(np.eye(3), np.array([0.0, 0.0, z])) for z in away])
    with Scene.open(case.archive) as scene:
        scene.add_avatar("ball", np.zeros((1, 3)), 0.25)
        data, model = scene._data, scene.avatar("ball", "")
        answers = collide_bounded(data, model, poses, 0.0, QueryBudget(tolerance=0.125))
        near = distance_bounded(data, model, poses, 1.0, QueryBudget(tolerance=0.125))
    assert answers.verdict[0] == CONTACT
    # Whether it is called early is the engine's choice; not after the tolerance, and said not to be exact.
    assert not (answers.exact & (answers.verdict == CONTACT))[1:].any()
    assert (answers.verdict[4:] == CLEAR).all() and answers.exact[4:].all()
    assert (answers.verdict != UNKNOWN).all()
    assert (near.lower <= away - 0.25).all() and (near.upper >= away - 0.25).all()
    assert (near.upper - near.lower <= 0.125 + 1e-7).all()


@pytest.mark.case(30, "what is not loaded when the time is over is unknown, never clear")
def test_case_30_what_is_not_resident_by_the_deadline_is_unknown(tmp_path: Path) -> None:
    case = archive_cases.build(tmp_path, np.array([[0.0, 0, 0], [2.0, 0, 0]]), voxel=1.0, resolution=1e-3)
    places = [(0.5, 0, 0), (1.5, 0, 0), (1.0, 5.0, 0)]
    poses = np.array([archive_cases.pose_of(np.eye(3), np.array(place)) for place in places])
    with Scene.open(case.archive) as scene:
        scene.add_avatar("ball", np.zeros((1, 3)), 0.1)
        data, model = scene._data, scene.avatar("ball", "")
        over = QueryBudget(deadline=0.0)
        answers = collide_bounded(data, model, poses, 0.4, over)
        assert answers.verdict.tolist() == [UNKNOWN, UNKNOWN, CLEAR] and answers.misses == 2
        # Named, for they are being loaded now: who asks again may find them.
        assert answers.voxels_missing.tolist() == [1, 2, 0], "by their cells, as nothing is proved yet"
        assert sorted(answers.late) == data.broad.keys.tolist()
        near = distance_bounded(data, model, poses, 1.0, over)
        # Where in their cells the points are is known as soon as the voxels, which are being loaded, were read.
        assert not near.exact[:2].any() and near.exact[2] and (near.lower[:2] <= 0.39).all()
        assert ((near.verdict == CLEAR) == (near.lower > 0)).all() and near.verdict[2] == CLEAR
        later = collide_bounded(data, model, poses, 0.4, QueryBudget(deadline=1e12))
        assert later.verdict.tolist() == [CONTACT, CONTACT, CLEAR] and later.exact.all()
        again = collide_bounded(data, model, poses, 0.4, over)
        assert again.voxels_missing.tolist() == [0, 0, 0], "resident now, though there is no time to look"
        assert again.verdict.tolist() == [UNKNOWN, UNKNOWN, CLEAR]
        near = distance_bounded(data, model, poses, 1.0, over)
        # By now the index is proved to be right that 0.39 m are free: box to box, radii of 0.1 and 0.01 m taken off.
        assert not near.exact[:2].any() and (near.lower[:2] <= 0.39).all() and (near.lower[:2] > 0.38).all()
        assert (near.verdict == CLEAR).all()
        scene.residency.check()
