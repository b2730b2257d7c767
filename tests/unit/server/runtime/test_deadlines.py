"""A deadline: what it left open is given up at once, no load is begun after it, and nothing is clear wrongly."""

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import archive_cases
import contact_cases
import numpy as np
import pytest
import synthetic_scans
from numpy.typing import NDArray
from solidcloud.schemas.wire.answers import Verdict
from solidcloud.server.avatars.avatar_model import make_avatar
from solidcloud.server.queries.collide import collide
from solidcloud.server.queries.contacts import contacts
from solidcloud.server.queries.distance import distance
from solidcloud.server.queries.query_inputs import QueryBudget, SceneData, make_budget
from solidcloud.server.queries.sweep import sweep

pytestmark = pytest.mark.interpreted
CLEAR, CONTACT, UNKNOWN = Verdict
FAR = archive_cases.pose_of(np.eye(3), np.array([99.0, 0, 0]))

QUESTIONS: dict[str, Callable[..., Any]] = {
    "collide": lambda data, avatar, poses, budget: collide(data, avatar, poses, 0.0, budget),
    "distance": lambda data, avatar, poses, budget: distance(data, avatar, poses, 0.1, budget),
    "contacts": lambda data, avatar, poses, budget: contacts(data, avatar, poses, budget=budget),
    "sweep": lambda data, avatar, poses, budget: sweep(
        data, avatar, poses, poses, tolerance=1e-6, budget=budget
    ),
}


@pytest.fixture
def case(tmp_path: Path, rng: np.random.Generator) -> contact_cases.ScanCase:
    """A cube of noise in eight voxels and more, none resident."""
    return contact_cases.open_case(tmp_path, synthetic_scans.make_scan("noise", 2, 800), rng, scan_count=1)


def near(case: contact_cases.ScanCase, rng: np.random.Generator) -> tuple[Any, NDArray[np.float64]]:
    """An avatar that reaches several voxels, and poses of which the last is out of all reach."""
    avatar = make_avatar(rng.uniform(0, synthetic_scans.SIZE, (8, 3)), 0.1)
    return avatar, np.concatenate(
        [archive_cases.near_poses(rng, case.points, avatar.points, 5, 0.05), FAR[None]]
    )


@pytest.mark.parametrize("question", ["collide", "distance"])
def test_what_is_not_resident_when_the_time_is_up_is_counted(
    case: contact_cases.ScanCase, rng: np.random.Generator, question: str
) -> None:
    avatar, poses = near(case, rng)
    late = QUESTIONS[question](case.data, avatar, poses, QueryBudget(deadline=0.0))
    assert (late.voxels_missing[:-1] > 1).all() and late.voxels_missing[-1] == 0
    assert late.verdict.tolist() == [UNKNOWN] * 5 + [CLEAR]
    assert case.data.residency.resident == 0


@pytest.mark.parametrize("question", QUESTIONS)
def test_no_load_is_begun_once_the_time_for_loads_is_up(
    case: contact_cases.ScanCase, rng: np.random.Generator, question: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The first load ends when the whole time is up."""
    avatar, poses = near(case, rng)
    exact = QUESTIONS[question](contact_cases.tight(case, 64 << 20).data, avatar, poses, QueryBudget())
    data: SceneData = case.data
    budget = make_budget(budget_ms=300)
    load, begun = case.store.load, []

    def slow(row: int, *where: Any) -> Any:
        begun.append(row)
        while not budget.stop:
            time.sleep(0.01)
        return load(row, *where)

    monkeypatch.setattr(case.store, "load", slow)
    found = QUESTIONS[question](data, avatar, poses, budget)
    assert len(begun) == 1 and data.residency.resident == 1
    data.residency.check()
    assert found.verdict[-1] == CLEAR and (found.verdict[:-1] != CLEAR).all()
    assert (found.verdict == UNKNOWN).any()
    assert (exact.verdict[found.verdict == CONTACT] == CONTACT).all()
