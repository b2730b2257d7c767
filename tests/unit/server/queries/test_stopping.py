"""A stop flag ends a request wherever it is: what was not looked at is unknown, nothing is wrong, nothing is kept."""

import threading
from pathlib import Path
from typing import Any

import archive_cases
import contact_cases
import numpy as np
import pytest
import stopped_queries
import synthetic_scans
from solidcloud.schemas.archive.units import UNITS_PER_METRE
from solidcloud.schemas.wire.answers import Verdict
from solidcloud.server.avatars.avatar_model import make_avatar
from solidcloud.server.queries import sweep as sweep_module
from solidcloud.server.queries.query_inputs import EXACT, QueryBudget, with_stop
from solidcloud.server.queries.sweep import sweep
from solidcloud.server.residency.voxel_cache import VoxelCache
from solidcloud.server.runtime.stop_flag import NO_STOP, StopFlag, StoppedError
from stopped_queries import UNKNOWN, Asked

WHY = "the test says so"


def effort_of(stop: StopFlag) -> QueryBudget:
    return EXACT._replace(stop=stop)


def stopped_already(reason: str) -> StopFlag:
    stop = StopFlag()
    stop.set(reason)
    return stop


def assert_nothing_held(residency: VoxelCache) -> None:
    residency.check()
    assert not residency._pins and not residency._waiting_requests and not residency._loading


@pytest.fixture
def asked(tmp_path: Path, rng: np.random.Generator) -> Asked:
    """Some points in several voxels, none resident; poses near them."""
    case = contact_cases.open_case(tmp_path, synthetic_scans.make_scan("noise", 2, 120), rng, scan_count=2)
    avatar = make_avatar(rng.uniform(0, synthetic_scans.SIZE, (40, 3)), 0.02)
    return Asked(case.data, avatar, archive_cases.near_poses(rng, case.points, avatar.points, 4, 0.08))


@pytest.mark.interpreted
@pytest.mark.parametrize("question", stopped_queries.QUESTIONS)
@pytest.mark.parametrize("resident", [False, True])
def test_a_flag_set_before_leaves_all_unknown(asked: Asked, question: str, resident: bool) -> None:
    ask = stopped_queries.QUESTIONS[question]
    if resident:
        ask(asked, EXACT)
    found = ask(asked, effort_of(stopped_already(WHY)))
    assert (found.verdict == UNKNOWN).all()
    assert found.stopped == WHY
    assert_nothing_held(asked.data.residency)
    again = ask(asked, EXACT)
    assert again.stopped == "" and (again.verdict != UNKNOWN).all()


@pytest.mark.interpreted
def test_pairs_of_stopped_objects_that_could_touch_are_listed_as_unknown(asked: Asked) -> None:
    found = stopped_queries.QUESTIONS["objects"](asked, effort_of(stopped_already(WHY)))
    whole = stopped_queries.QUESTIONS["objects"](asked, EXACT)
    assert found.pairs_tested == 0 < len(found.pairs) == whole.pairs_tested
    assert {*map(tuple, whole.pairs.tolist())} <= {*map(tuple, found.pairs.tolist())}
    assert (found.pair_verdict == UNKNOWN).all()


@pytest.mark.interpreted
def test_a_stopped_motion_inside_is_not_said_to_leave(asked: Asked) -> None:
    data, ball, pose = asked.data, make_avatar([[0.0, 0, 0]], 0.001), np.eye(4)[None]
    middle = data.tree.scene.mean(axis=0)
    pose[0, :3, 3] = data.arrays.origin + data.arrays.step * middle
    for stop in (NO_STOP, stopped_already(WHY)):
        found = sweep(with_stop(data, stop), ball, pose, pose, budget=effort_of(stop))
        assert found.outside.tolist() == [False]
    assert found.lower.tolist() == [0.0] and found.verdict.tolist() == [UNKNOWN]


@pytest.mark.interpreted
@pytest.mark.parametrize("gap", [0.0, 0.005])
def test_a_stop_after_a_contact_leaves_its_row_as_it_is(
    tmp_path: Path, rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch, gap: float
) -> None:
    """A contact within the tolerance of the beginning is exact, so `outside` must be right too.

    gap: of the avatar from a point at the boundary of the scene [m].
    """
    case = contact_cases.open_case(tmp_path, synthetic_scans.make_scan("noise", 2, 120), rng, scan_count=2)
    data, ball, stop = case.data, make_avatar([[0.0, 0, 0]], 0.001), StopFlag()
    begin, end = np.eye(4)[None], np.eye(4)[None]
    end[0, :3, 3] = begin[0, :3, 3] = case.points[case.points[:, 0].argmin()]
    begin[0, 0, 3] -= 0.001 + data.radius_units / UNITS_PER_METRE + gap if gap else 0.0
    known = sweep(data, ball, begin, end, tolerance=0.02)
    assert known.outside.tolist() == known.exact.tolist() == [True]
    stop_at_the_end(stop, monkeypatch)
    found = sweep(with_stop(data, stop), ball, begin, end, tolerance=0.02, budget=effort_of(stop))
    assert found.verdict.tolist() == known.verdict.tolist() == [Verdict.CONTACT]
    assert found.lower.tolist() == [0.0] and found.upper.tolist() == known.upper.tolist()
    assert found.outside.tolist() == found.exact.tolist() == [True]


def stop_at_the_end(stop: StopFlag, monkeypatch: pytest.MonkeyPatch) -> None:
    """Set the flag when a sweep has found its contacts."""
    find = sweep_module.find_unknown_regions

    def find_later(*arguments: Any) -> None:
        stop.set(WHY)
        find(*arguments)

    monkeypatch.setattr(sweep_module, "find_unknown_regions", find_later)


@pytest.mark.interpreted
def test_a_stop_after_a_contact_at_the_end_leaves_its_row_as_it_is(
    tmp_path: Path, rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    points = np.array([[0.25, 0.0, 0.0], [0.5, 0.25, 0.25], [0.75, 0.5, 0.0]])
    case = contact_cases.open_case(tmp_path, points, rng, scan_count=1, resolution=2.0**-10, radius=2.0**-6)
    ball, stop, begin, end = make_avatar([[0.0, 0, 0]], 2.0**-6), StopFlag(), np.eye(4)[None], np.eye(4)[None]
    end[0, :3, 3] = case.points[case.points[:, 0].argmin()]
    end[0, 0, 3] -= case.data.radius_units / UNITS_PER_METRE + 2.0**-6
    begin[0, :3, 3] = end[0, :3, 3] - [2.0**-8, 0.0, 0.0]
    known = sweep(case.data, ball, begin, end, tolerance=0.02)
    assert known.outside.tolist() == known.exact.tolist() == [True]
    stop_at_the_end(stop, monkeypatch)
    found = sweep(with_stop(case.data, stop), ball, begin, end, tolerance=0.02, budget=effort_of(stop))
    assert found.verdict.tolist() == known.verdict.tolist() == [Verdict.CONTACT]
    assert found.outside.tolist() == found.exact.tolist() == [True]


@pytest.mark.interpreted
def test_noise_of_scans_is_not_exact_where_it_was_stopped(asked: Asked) -> None:
    assert stopped_queries.gaps(asked, EXACT).exact
    with pytest.raises(StoppedError):
        stopped_queries.gaps(asked, effort_of(stopped_already(WHY)))


# --- in the middle of a kernel -----------------------------------------------------------------------------


@pytest.mark.interpreted
def test_a_stop_ends_a_wait_for_loads(asked: Asked, monkeypatch: pytest.MonkeyPatch) -> None:
    residency = asked.data.residency
    begun, go, load = threading.Event(), threading.Event(), residency._store.load

    def slow(*what: Any) -> Any:
        begun.set()
        assert go.wait(60.0)
        return load(*what)

    monkeypatch.setattr(residency._store, "load", slow)
    rows = [0]
    loader = threading.Thread(target=lambda: residency.release(rows) if residency.acquire(rows) else None)
    loader.start()
    try:
        assert begun.wait(60.0)
        stop = StopFlag()
        threading.Timer(0.1, stop.set, [WHY]).start()
        with residency.hold(rows, stop=stop) as held:
            assert held.late == (0,)
    finally:
        go.set()
        loader.join()
    assert_nothing_held(residency)
