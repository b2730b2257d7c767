"""Hard case of tolerances and budgets; a test's number is its row in NUMERICS.md."""

from pathlib import Path

import archive_cases
import numpy as np
import pytest
from solidcloud.schemas.wire.answers import Verdict
from solidcloud.server.queries.collide import collide
from solidcloud.server.queries.distance import distance
from solidcloud.server.queries.query_inputs import QueryBudget
from solidcloud.server.scene import Scene

CLEAR, CONTACT, UNKNOWN = Verdict


@pytest.mark.case(30, "contact is reported early by no more than the tolerance, and flagged as not exact")
def test_case_30_early_by_at_most_the_tolerance(tmp_path: Path) -> None:
    # One point, one ball of 0.25 m: contact begins at a distance of exactly 0.25 m, and early at 0.25 m + 1/8 m.
    case = archive_cases.build(tmp_path, np.zeros((1, 3)), radius=0.0, resolution=archive_cases.BINARY_STEP)
    unit = 2.0**-26
    away = np.array([0.25, 0.25 + unit, 0.375 - unit, 0.375, 0.375 + unit, 0.5])
    poses = np.array([archive_cases.pose_of(np.eye(3), np.array([0.0, 0.0, z])) for z in away])
    with Scene.open(case.archive) as scene:
        scene.add_avatar("ball", np.zeros((1, 3)), 0.25)
        answers = scene.collide("ball", poses, tolerance=0.125)
        near = scene.distance("ball", poses, 1.0, tolerance=0.125)
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
    over = QueryBudget(deadline=0.0)  # the time for loads is up, that for searching is not
    with Scene.open(case.archive, level_bytes=0) as fresh:  # no level of detail, which would know
        fresh.add_avatar("ball", np.zeros((1, 3)), 0.1)
        near = distance(fresh._data, fresh.avatar("ball", ""), poses, 1.0, over)
        assert not near.exact[:2].any() and near.exact[2] and (near.lower[:2] <= 0.39).all()
        assert ((near.verdict == CLEAR) == (near.lower > 0)).all() and near.verdict[2] == CLEAR
    with Scene.open(case.archive, level_bytes=0) as scene:
        scene.add_avatar("ball", np.zeros((1, 3)), 0.1)
        data, model = scene._data, scene.avatar("ball", "")
        answers = collide(data, model, poses, 0.4, over)
        assert answers.verdict.tolist() == [UNKNOWN, UNKNOWN, CLEAR]
        # Named, for they are being loaded now: who asks again may find them.
        assert answers.voxels_missing.tolist() == [1, 1, 0]
        assert sorted(answers.late) == data.keys.tolist()
        later = scene.collide("ball", poses, 0.4, budget_ms=1e9)
        assert later.verdict.tolist() == [CONTACT, CONTACT, CLEAR] and later.stopped == ""
        again = scene.collide("ball", poses, 0.4, budget_ms=0)
        assert again.voxels_missing.tolist() == [0, 0, 0], "resident now, though there is no time to look"
        assert again.verdict.tolist() == [UNKNOWN, UNKNOWN, CLEAR] and again.stopped == ""
        near = scene.distance("ball", poses, 1.0, budget_ms=0)
        assert not near.exact[:2].any() and (near.lower[:2] <= 0.39).all() and near.exact[2]
        scene.residency.check()
