"""A stop flag ends a request wherever it is: what was not looked at is unknown, nothing is wrong, nothing is kept."""

import os
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import archive_cases
import contact_cases
import numpy as np
import pytest
import stopped_queries
import synthetic_scans
from solidcloud.server.avatars.avatar_model import make_avatar
from solidcloud.server.kernels.collide import coarse_clearance, collide_poses
from solidcloud.server.kernels.core import scene_arrays as stopping
from solidcloud.server.kernels.nearest import best_first_search
from solidcloud.server.queries.context.query_budget import EXACT, QueryBudget
from solidcloud.server.queries.context.query_context import with_stop
from solidcloud.server.queries.objects import find_pairs
from solidcloud.server.queries.sweep import sweep
from solidcloud.server.residency.voxel_cache import VoxelCache
from solidcloud.server.runtime.stop_flag import NO_STOP, StopFlag, StoppedError
from stopped_queries import CLEAR, CONTACT, UNKNOWN, Asked

INTERPRETED = os.environ.get("NUMBA_DISABLE_JIT") == "1"
WHY = "the test says so"


def effort_of(stop: StopFlag) -> QueryBudget:
    return EXACT._replace(stop=stop)


def stopped_already(reason: str) -> StopFlag:
    stop = StopFlag()
    stop.set(reason)
    return stop


def assert_nothing_held(residency: VoxelCache) -> None:
    residency.check()
    assert not residency._states.pins and not residency._waiting_requests and not residency._states.loading


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
    middle = (data.broad.scene_low + data.broad.scene_high) // 2
    pose[0, :3, 3] = data.arrays.origin + data.arrays.step * middle
    for stop in (NO_STOP, stopped_already(WHY)):
        found = sweep(with_stop(data, stop), ball, pose, pose, budget=effort_of(stop))
        assert found.outside.tolist() == [False]
    assert found.lower.tolist() == [0.0] and found.verdict.tolist() == [UNKNOWN]


@pytest.mark.interpreted
def test_noise_of_scans_is_not_exact_where_it_was_stopped(asked: Asked) -> None:
    assert stopped_queries.gaps(asked, EXACT).exact
    with pytest.raises(StoppedError):
        stopped_queries.gaps(asked, effort_of(stopped_already(WHY)))


@pytest.mark.interpreted
def test_a_flag_is_of_one_request_alone(asked: Asked) -> None:
    stop = stopped_already(WHY)
    with pytest.raises(RuntimeError, match="all requests"):
        NO_STOP.set(WHY)
    assert with_stop(asked.data, NO_STOP) is asked.data
    stopped = with_stop(asked.data, stop)
    assert stopped.arrays.stop is stop.flag and asked.data.arrays.stop is NO_STOP.flag
    assert with_stop(stopped, NO_STOP).arrays.stop is NO_STOP.flag
    stop.set("another reason")
    assert stop.reason == WHY


@pytest.mark.interpreted
@pytest.mark.skipif(not INTERPRETED, reason="the looks of compiled kernels cannot be counted")
@pytest.mark.parametrize("question", stopped_queries.QUESTIONS)
def test_whichever_look_finds_the_flag_set_nothing_is_wrong(
    asked: Asked, question: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    ask = stopped_queries.QUESTIONS[question]
    truth, looks = ask(asked, EXACT), 0
    assert (truth.verdict != UNKNOWN).all()
    stop, at = StopFlag(), 0

    def look(flag: Any) -> Any:
        nonlocal looks
        looks += 1
        if looks == at:
            stop.set(WHY)
        return flag[0] != 0

    for module in (best_first_search, coarse_clearance):
        monkeypatch.setattr(module, "ROWS_AT_ONCE", 1)
    usual = stopping.stopped
    for name, module in list(sys.modules.items()):
        if name.startswith("solidcloud.server.kernels.") and getattr(module, "stopped", None) is usual:
            monkeypatch.setattr(module, "stopped", look)
    assert look is collide_poses.stopped
    ended = False
    while not ended:
        at = at + 1 if at < 12 else int(at * 1.3)
        stop, looks = StopFlag(), 0
        found = ask(asked, effort_of(stop))
        ended = looks < at
        assert found.stopped == ("" if ended else WHY)
        stopped_queries.assert_not_wrong(found, truth)
        assert_nothing_held(asked.data.residency)
    assert at > 5


# --- in the middle of a kernel -----------------------------------------------------------------------------

# Points of the scan and of the avatar, in the same cube of a metre; their spheres are so small that none touch.
MANY = 20_000
# How many poses, rays, points and objects make a request of many seconds.
LONG: dict[str, int] = {
    "collide": 20_000,
    "collide bounded": 20_000,
    "collide timed": 20_000,
    "distance": 20_000,
    "distance bounded": 20_000,
    "contacts": 400,
    "sweep": 1_000,
    "raycast": 300_000,
    "within": 300_000,
    "objects": 1_000,
}
# Of these so few are asked about undisturbed.
FEW = 3


@pytest.fixture(scope="module")
def crowded(tmp_path_factory: pytest.TempPathFactory) -> Callable[[int], Asked]:
    """Of so many poses, a request about an avatar of MANY points in the middle of as many, all resident."""
    rng = np.random.default_rng(3)
    folder = tmp_path_factory.mktemp("crowded")
    case = contact_cases.open_case(
        folder, rng.uniform(0, 1, (MANY, 3)), rng, scan_count=1, radius=1e-5, voxel=2.0, resolution=1e-6
    )
    model = make_avatar(rng.uniform(-0.5, 0.5, (MANY, 3)), 1e-6)

    def make(count: int) -> Asked:
        poses = np.tile(np.eye(4), (count, 1, 1))
        poses[:, :3, 3] = 0.5 + np.random.default_rng(5).uniform(-0.1, 0.1, (count, 3))
        angle = 0.5 * np.arange(count)
        poses[:, 0, 0], poses[:, 1, 1] = np.cos(angle), np.cos(angle)
        poses[:, 0, 1], poses[:, 1, 0] = -np.sin(angle), np.sin(angle)
        return Asked(case.data, model, poses, reach=0.1)

    return make


@pytest.mark.skipif(INTERPRETED, reason="to build the avatar takes too long")
@pytest.mark.parametrize("question", LONG)
def test_a_flag_set_meanwhile_ends_a_kernel_soon(crowded: Callable[[int], Asked], question: str) -> None:
    ask = stopped_queries.QUESTIONS[question]
    truth = ask(crowded(FEW), EXACT)
    asked, stop, when = crowded(LONG[question]), StopFlag(), []

    def end() -> None:
        when.append(time.process_time())
        stop.set(WHY)

    timer = threading.Timer(0.2, end)
    timer.start()
    try:
        found = ask(asked, effort_of(stop))
        ended = time.process_time()
    finally:
        timer.cancel()
    assert found.stopped == WHY, "the request was over before the flag was set: make it longer"
    assert ended - when[0] < 2.0
    assert found.verdict[-1] == UNKNOWN
    few = found.verdict[: len(truth)]
    assert ((few == truth.verdict) | (few == UNKNOWN)).all()
    if question not in ("contacts", "sweep", "raycast", "within"):
        assert not (found.verdict == CONTACT).any()
    assert_nothing_held(asked.data.residency)


@pytest.mark.skipif(INTERPRETED, reason="to build the avatar takes too long")
def test_a_budget_ends_a_kernel_that_does_not_look_at_the_clock(crowded: Callable[[int], Asked]) -> None:
    from solidcloud.server.queries.context.query_budget import make_budget

    asked = crowded(1)._replace(margin=1.0)
    begin = time.process_time()
    found = stopped_queries.QUESTIONS["contacts"](asked, make_budget(budget_ms=50.0))
    assert time.process_time() - begin < 2.0
    assert not found.exact.any()
    # All of a sweep's motions are one kernel call here.
    long = crowded(2_000)
    begin = time.process_time()
    found = stopped_queries.QUESTIONS["sweep"](long, make_budget(budget_ms=50.0))
    assert time.process_time() - begin < 2.0
    assert found.verdict[-1] == UNKNOWN


@pytest.mark.interpreted
def test_pairs_of_objects_are_those_of_a_sort_by_two_keys(asked: Asked) -> None:
    from solidcloud.server.queries.objects import _check

    n = len(asked.poses)
    both = np.full(n, 0xFFFFFFFF, np.uint32)
    placing = _check(asked.data, [asked.avatar] * n, asked.poses, both, both, 0.5)
    pairs, _ = find_pairs(placing, asked.data.arrays.origin)
    assert pairs.tolist() == sorted(pairs.tolist()) and (pairs[:, 0] < pairs[:, 1]).all()


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


@pytest.mark.interpreted
def test_a_clear_pose_is_said_to_be_clear_before_the_stop(asked: Asked) -> None:
    far = np.tile(np.eye(4), (2, 1, 1))
    far[:, 0, 3] = 500.0
    assert (
        stopped_queries.QUESTIONS["collide"](asked._replace(poses=far), effort_of(StopFlag())).verdict
        == CLEAR
    ).all()
