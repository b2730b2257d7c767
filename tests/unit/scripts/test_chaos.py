"""Test the checks of scripts/chaos: unknown is never wrong, and every kind of wrong answer is found."""

import json
import time
from pathlib import Path
from types import SimpleNamespace

import archive_cases
import numpy as np
import pytest
from chaos_cases import scoreboard as b
from chaos_cases.answer_check import judge
from chaos_cases.chaos_report import Limits, _violations
from chaos_cases.fixtures import AVATARS, ask, judge_claims, make_pool
from chaos_cases.server_restarts import QuietPoint, ServerRuns
from msgspec.structs import replace
from rogue_cases.rogue_attacks import zeros
from solidcloud.schemas.wire.answers import (
    CollideAnswers,
    ContactsAnswers,
    DistanceAnswers,
    Verdict,
    WithinAnswers,
)
from solidcloud.schemas.wire.encoding import decode_answer, encode
from solidcloud.schemas.wire.motion_messages import Moved
from solidcloud.schemas.wire.question_table import check_answers, make_unknown
from solidcloud.schemas.wire.requests import CollideRequest, WithinRequest


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory):
    """Open a floor in this process."""
    from solidcloud.server.scene import Scene

    x, y = np.meshgrid(np.arange(-2, 2, 0.1), np.arange(-2, 2, 0.1))
    points = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    case = archive_cases.build(tmp_path_factory.mktemp("floor"), points, voxel=1.0, resolution=1e-3)
    with Scene.open(case.archive) as scene:
        yield scene, points


def test_every_question_is_right_by_its_own_truth(scene, rng) -> None:
    opened, points = scene
    pool = make_pool((opened, opened), 18, points, rng)
    assert {request.op for request in pool} >= {"collide", "contacts", "path", "move", "objects"}
    assert set(AVATARS) <= {"figure", "ball"}
    for request in pool:
        got = ask(opened, request.op, request.arguments, request.parameters)
        found = judge(got, request.truths)
        assert not found.faults and found.right and not found.false_clear, request.op


def collided(*verdicts: Verdict) -> CollideAnswers:
    k = len(verdicts)
    none = np.zeros(k, np.uint32)
    return CollideAnswers(np.array(verdicts, np.uint8), np.zeros(k, bool), none, none, none)


def test_a_false_clear_is_told_from_a_false_contact() -> None:
    truth = collided(Verdict.CONTACT, Verdict.CLEAR, Verdict.CONTACT)
    found = judge(collided(Verdict.CLEAR, Verdict.CONTACT, Verdict.UNKNOWN), [truth])
    assert (len(found.faults), found.false_clear, found.right, found.unknown) == (2, 1, 0, 1)
    assert not judge(make_unknown(CollideAnswers, 3, bounded=False), [truth]).faults


def test_an_answer_may_be_that_of_any_generation_that_may_be_served() -> None:
    old, new = collided(Verdict.CLEAR), collided(Verdict.CONTACT)
    assert not judge(old, [old, new]).faults and not judge(new, [old, new]).faults
    assert judge(old, [new]).false_clear == 1


def test_figures_and_bounds_are_compared(scene) -> None:
    opened, _ = scene
    opened.add_avatar("judged", np.zeros((1, 3)), 0.05)
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[:, :3, 3] = [[0.02, 0.03, 0.3], [0.0, 0.0, 0.4]]
    truth = opened.distance("judged", poses, 1.0)
    assert isinstance(truth, DistanceAnswers) and not judge(truth, [truth]).faults
    one_bit = truth.signed_distance.copy()
    one_bit[1] = np.nextafter(one_bit[1], 9)
    assert "row 1: signed_distance" in judge(replace(truth, signed_distance=one_bit), [truth]).faults[0]
    never = np.zeros(2, bool)
    loose = replace(
        truth, exact=never, lower=truth.lower - 0.1, upper=truth.upper + 0.1, signed_distance=one_bit
    )
    assert not judge(loose, [truth]).faults
    wrong = replace(loose, upper=truth.signed_distance - 0.01)
    assert "is not within" in judge(wrong, [truth]).faults[0]


def test_lists_of_contacts_are_compared(scene) -> None:
    opened, _ = scene
    opened.add_avatar("listed", np.zeros((1, 3)), 0.05)
    truth = opened.contacts("listed", np.eye(4)[None], margin=0.3)
    assert isinstance(truth, ContactsAnswers) and truth.pairs_found[0] > 3
    shifted = truth.cloud_point.copy()
    shifted[2, 0] += 1e-9
    (fault,) = judge(replace(truth, cloud_point=shifted), [truth]).faults
    assert "cloud_point" in fault


def test_a_frame_that_is_not_simulated_whole_says_nothing() -> None:
    pose = np.eye(4)[None]
    truth = Moved(pose=pose, simulated=["stop"])
    elsewhere = pose + 1e-9
    assert judge(Moved(pose=elsewhere, simulated=["stop"]), [truth]).faults
    assert not judge(Moved(pose=elsewhere, simulated=["stop"], skipped=["slide"]), [truth]).faults
    assert judge(Moved(pose=pose, verdict=2), [truth]).unknown == 1
    assert not judge(Moved(pose=elsewhere, simulated=["stop"], unknown=True), [truth]).faults


def test_a_frame_said_to_be_clear_with_something_unknown_is_judged_by_where_it_ends(scene, tmp_path) -> None:
    _, points = scene
    for name in ("first", "second"):
        archive_cases.build(tmp_path, points, voxel=1.0, resolution=1e-3).archive.rename(tmp_path / name)
    above, on = np.eye(4)[None], np.eye(4)[None]
    above[0, 2, 3] = 1.0
    claims = [{"avatar": "ball", "pose": pose.tolist(), "served": 3} for pose in (above, on, above)]
    lines = [json.dumps(claim) for claim in claims]
    (tmp_path / "claims-0.jsonl").write_text("\n".join([*lines, lines[0][:40]]))
    assert judge_claims(tmp_path) == (3, 1)


def test_an_answer_of_another_length_is_wrong() -> None:
    assert judge(collided(Verdict.CLEAR), [collided(Verdict.CLEAR, Verdict.CLEAR)]).faults


def test_the_scoreboard_is_one_for_all(tmp_path: Path) -> None:
    driver = b.Scoreboard(tmp_path / "board", 3)
    client = b.Scoreboard(tmp_path / "board")
    driver.driver[b.UP] = 1
    assert client.now() == b.ServerState(True, 0)
    client.client(2)[b.WRONG] += 4
    assert driver.totals()["wrong"] == 4


@pytest.mark.parametrize(
    ("request_", "kind"),
    [
        (CollideRequest("al", np.tile(np.eye(4), (5, 1, 1))), CollideAnswers),
        (WithinRequest(np.zeros((5, 3)), 0.1), WithinAnswers),
    ],
)
def test_a_lie_is_an_answer_that_a_client_would_take(request_, kind) -> None:
    operation = "collide" if kind is CollideAnswers else "within"
    payload = SimpleNamespace(to_bytes=lambda: encode(request_))
    query = SimpleNamespace(key_expr=f"solidcloud/1/scene/hall/me/{operation}", payload=payload)
    answers = decode_answer(kind, zeros(query))
    check_answers(answers, 5)
    assert (answers.verdict == Verdict.CLEAR).all()


def test_a_client_is_still_once_all_its_ids_are(tmp_path: Path) -> None:
    board = b.Scoreboard(tmp_path / "board", 1)
    row = board.client(0)
    row[b.IDLE] = 1  # of a process that was killed
    still = b.IdleFlags(row, 6)
    seen = [row[b.IDLE]]
    for number in (*range(5), 0):
        still.set(number, True)
        seen.append(row[b.IDLE])
    assert not any(seen)
    still.set(5, True)
    assert row[b.IDLE]
    still.set(3, False)
    assert not row[b.IDLE]


def violations(threads: list[dict[str, int]], files: list[dict[str, int]]) -> list[str]:
    """Return the violations of a run whose last server process had these figures at quiet points."""
    quiet = [QuietPoint(1, 0.0, {"odd": 7}, {"odd": 7}, 0, 0, False)]  # of an earlier process
    quiet += [QuietPoint(2, 0.0, *held, 0, 0, False) for held in zip(threads, files, strict=True)]
    report = dict.fromkeys(
        ("wrong", "of them in contact", "clear_away", "errors", "tracebacks in the server's log",
         "seconds from serving to right, of each client", "MB a minute, last server, after two minutes")
    ) | {"stuck": [], "right": 1}  # fmt: skip
    return _violations(report, SimpleNamespace(died=[], stops=[], quiet=quiet, number=2), Limits())


def pools(*counts: int) -> list[dict[str, int]]:
    """Return threads at quiet points: this many of zenoh's pool, and some of ours."""
    return [{"worker-0": 1, "chaos-parts": 2, "app-0": 1, f"rx-{i}": n - 1} for i, n in enumerate(counts)]


def test_threads_of_ours_must_be_as_many_at_each_quiet_point_but_the_first() -> None:
    none: list[dict[str, int]] = [{}] * 4
    assert not violations([{"reload": 3}, {"reload": 1}, {"reload": 1}, {"reload": 1}], none)
    for more in ({"reload": 1, "chaos-parts": 1}, {"reload": 2}, {}):
        (found,) = violations([{"reload": 1}, {"reload": 1}, more, {"reload": 1}], none)
        assert found.startswith("threads named") and "a constant number expected" in found


def test_the_pool_of_zenoh_may_come_and_go_but_not_grow() -> None:
    assert not violations(pools(1, 9, 4, 7, 11, 3, 11), [{}] * 7)
    assert not violations(pools(5, 9), [{}] * 2)
    (found,) = violations(pools(1, 9, 4, 7, 3, 12, 3), [{}] * 7)
    assert "zenoh's pool at quiet points: [9, 4, 7, 3, 12, 3]" in found


def test_shards_may_be_opened_later_once_each_and_other_files_not() -> None:
    base = {"socket": 5, "index.h5": 1}
    lazy = [base, base, base | {"0-000000.h5": 1}, base | {"1-000003.h5": 1}]
    assert not violations([{}] * 4, lazy)
    (found,) = violations([{}] * 4, [*lazy[:3], base | {"0-000000.h5": 2}])
    assert "'0-000000.h5' at quiet points: open [0, 1, 2] times, at most once" in found
    for changed in ({"socket": 6}, {"index.h5": 2}, {"0-000000.h5.tmp": 1}):
        (found,) = violations([{}] * 4, [*lazy[:3], base | changed])
        assert found.startswith("files named") and "a constant number expected" in found


def test_a_generation_that_was_served_while_a_question_was_under_way_is_remembered(tmp_path: Path) -> None:
    driver = b.Scoreboard(tmp_path / "board", 1)
    client = b.Scoreboard(tmp_path / "board")
    driver.serve(1)
    asked = time.monotonic()
    for generations in (3, 2, 3, 1):  # to the other generation and back while a client is frozen
        driver.serve(generations)
    assert client.served_since(asked) == 3
    assert client.served_since(time.monotonic()) == 1


def test_memory_is_judged_at_calm_quiet_points_of_the_last_life() -> None:
    def quiet(life: int, minutes: float, megabytes: float, calm: bool, of_files: float = 0.0) -> QuietPoint:
        return QuietPoint(life, 60 * minutes, {}, {}, int(megabytes * 1e6), int(of_files * 1e6), calm)

    server_runs = SimpleNamespace(number=2, quiet=[quiet(1, 0, 900, True), quiet(2, 1, 300, True)])
    assert ServerRuns.slope(server_runs) is None, "one point has no slope"
    server_runs.quiet += [
        quiet(2, 2, 500, False),
        quiet(2, 3, 340, True, of_files=36),
        quiet(2, 5, 308, True),
    ]
    assert ServerRuns.slope(server_runs) == pytest.approx((2.0, 4.0))
