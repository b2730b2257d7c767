"""Test the figures, targets and page of a load test, computed from given frames."""

import json
from pathlib import Path

import msgspec
import numpy as np
import pytest
from matplotlib.text import Text
from picture_checks import alike_in_grey, drawn_figures, overlaps
from solidcloud.schemas.wire.answers import Verdict
from solidcloud.schemas.wire.stats import StatsAnswer
from solidcloud.server.report.common.bench_results import MET, MISSED, Part, goal_rows
from solidcloud.server.report.common.line_charts import label_ends, spread
from solidcloud.server.report.load.page import load_page, load_pictures
from solidcloud.server.report.load.runs import load_cases, verdict_check
from solidcloud.server.report.load.runs.load_cases import ECHO, Case, Ran
from solidcloud.server.report.load.runs.load_server import Memory
from solidcloud.server.report.load.users import frame_outcomes
from solidcloud.server.report.load.users.archive_voxels import Voxels
from solidcloud.server.report.load.users.frame_outcomes import ANSWERED, NOTHING, REFUSED, Frames
from solidcloud.server.report.load.users.user_traces import Trace

CLEAR, CONTACT, UNKNOWN = (int(v) for v in (Verdict.CLEAR, Verdict.CONTACT, Verdict.UNKNOWN))


def some_frames(**columns: list) -> Frames:
    """Return one frame a second of one user, sent 5 ms late and answered 10 ms later; columns replace these."""
    n = len(next(iter(columns.values())))
    due = np.arange(n, dtype=np.float64)
    made = Frames(
        np.zeros(n, np.int64), due, due + 0.005, due + 0.015, np.full(n, ANSWERED), np.full(n, CLEAR),
        np.ones(n, np.int64), np.zeros(n, np.int64), np.full(n, 1e-4), np.zeros(n), np.arange(n) * 100,
    )  # fmt: skip
    return made._replace(**{name: np.array(values) for name, values in columns.items()})


def test_figures_leave_the_first_second_out_but_not_its_faults() -> None:
    made = some_frames(
        verdict=[UNKNOWN, CLEAR, CONTACT, CLEAR, -1],
        status=[ANSWERED, ANSWERED, ANSWERED, REFUSED, NOTHING],
        misses=[7, 0, 1, 0, 0],
        hits=[0, 4, 3, 0, 0],
        done=[0.5, 1.015, 2.05, np.nan, np.nan],
    )
    f = frame_outcomes.figures(made)
    assert (f.frames, f.stalled, f.unknown, f.refused, f.unanswered) == (4, 3, 1, 1, 1)
    assert f.misses == 1 and f.hit_rate == 7 / 8 and f.without_miss == 0.5
    assert f.delays == pytest.approx([0.05] * 4)  # of 15 and 50 ms
    assert f.round_trips[-1] == pytest.approx(0.045) and f.late == pytest.approx(0.005)
    assert frame_outcomes.figures(made, warm_up=0.0).misses == 8


def test_a_run_without_answers_has_no_rates() -> None:
    f = frame_outcomes.figures(some_frames(status=[NOTHING] * 3, done=[np.nan] * 3, sent=[np.nan] * 3))
    assert (f.stalled, f.unanswered, f.misses) == (2, 3, 0)
    assert np.isnan([f.hit_rate, f.without_miss, *f.delays, f.late]).all()


def test_percentiles_are_values_that_were_measured() -> None:
    values = np.array([4.0, 1.0, np.nan, 2.0, 3.0])
    assert frame_outcomes.percentiles(values, (50.0, 99.0, 100.0)).tolist() == [3.0, 4.0, 4.0]
    assert np.isnan(frame_outcomes.percentiles(np.array([np.nan]))).all()


def test_a_frame_may_wait_for_what_another_had_loaded() -> None:
    made = some_frames(
        wait=[0.5, 0.0, 8e-3, 9e-3, np.nan], misses=[0, 0, 0, 2, 0], status=[ANSWERED] * 4 + [REFUSED]
    )
    f = frame_outcomes.figures(made)
    assert f.waits[1:].tolist() == [9e-3] * 3 and f.waited == 2 / 3 and f.without_miss == 2 / 3


def test_frames_of_processes_become_those_of_one_in_order(tmp_path: Path) -> None:
    first = some_frames(user=[0, 0, 0])
    second = some_frames(user=[1, 1, 1])._replace(due=np.array([0.5, 1.0, 9.0]))
    frame_outcomes.save(tmp_path / "a.npz", first, pose=np.zeros((3, 4, 4)))
    back, more = frame_outcomes.load(tmp_path / "a.npz")
    assert more["pose"].shape == (3, 4, 4)
    both = frame_outcomes.merged([second, back])
    assert both.due.tolist() == [0.0, 0.5, 1.0, 1.0, 2.0, 9.0] and both.user.tolist() == [0, 1, 0, 1, 0, 1]


def test_bytes_over_time_are_the_most_of_each_piece() -> None:
    made = some_frames(resident_bytes=[5, 9, 7, 1], done=[0.0, 1.0, 3.0, 4.0])
    at, most = frame_outcomes.bytes_over_time(made, 2)
    assert at.tolist() == [1.0, 3.0] and most.tolist() == [9.0, 7.0]
    assert len(frame_outcomes.bytes_over_time(made._replace(status=np.zeros(4, int)))[0]) == 0


def test_wrong_is_what_is_said_and_not_true() -> None:
    made = some_frames(verdict=[CLEAR, CONTACT, UNKNOWN, CLEAR, CONTACT], status=[ANSWERED] * 4 + [REFUSED])
    assert verdict_check.wrong(made, np.array([CLEAR, CLEAR, CONTACT, CONTACT, CLEAR])).tolist() == [1, 3]


def ran(case: Case, made: Frames, **more: object) -> Ran:
    rss = (np.array([0.0, 1.0]), np.array([1e8, 2e8]))
    plain: dict = {"budget": 50 << 20, "wrong": 0, "speed": 1.5, "empty": 100 << 20, "peak": 250 << 20}
    plain |= {"memory": Memory(), "resident": frame_outcomes.bytes_over_time(made), "rss": rss, **more}
    return Ran(case, figures=frame_outcomes.figures(made), **plain)


STEADY = Case("kinds", "stroll", 8, 0.1, None)


CALM = some_frames(user=[0] * 9)


def verdicts(runs: list[Ran]) -> dict[str, str]:
    part = Part("kinds")
    load_cases.add_goals(part, runs)
    return {row["key"]: row["verdict"] for row in goal_rows([part], load_cases.NOTES)}


def test_goals_are_met_by_a_calm_run_and_missed_by_what_breaks_them() -> None:
    assert verdicts([ran(STEADY, CALM)]) == {"stalled": MET, "wait": MET, "misses": MET, "right": MET}
    late = CALM._replace(done=CALM.done + np.array([0] * 8 + [0.1]))
    slow = CALM._replace(wait=np.array([0.0] * 8 + [5e-3]))
    missed = CALM._replace(misses=np.array([0] * 8 + [1]))
    assert verdicts([ran(STEADY, late)])["stalled"] == MISSED
    assert verdicts([ran(STEADY, slow)])["wait"] == MISSED
    assert verdicts([ran(STEADY, missed)])["misses"] == MISSED
    assert verdicts([ran(STEADY, CALM, wrong=1)])["right"] == MISSED


def test_goals_of_steady_users_are_those_of_the_default_policy() -> None:
    late = CALM._replace(done=CALM.done + 0.1)
    named = [ran(Case("kinds", "stroll", 8, 0.1, policy), late if policy == "lru" else CALM)
             for policy in ("lru", "lru+prefetch")]  # fmt: skip
    assert verdicts(named)["stalled"] == MET
    assert verdicts(named[:1])["stalled"] == MISSED


def test_what_the_server_says_it_loaded_in_vain_is_a_goal() -> None:
    stats = StatsAnswer(scene="load", prefetched_bytes=100, wasted_bytes=30, prefetched=4, wasted=1)
    assert verdicts([ran(STEADY, CALM, stats=stats)])["vain"] == MET
    worse = msgspec.structs.replace(stats, wasted_bytes=31)
    assert verdicts([ran(STEADY, CALM, stats=worse)])["vain"] == MISSED
    none = msgspec.structs.replace(stats, prefetched_bytes=0, wasted_bytes=0)
    assert "vain" not in verdicts([ran(STEADY, CALM, stats=none)])


def test_a_report_holds_no_figure_that_is_no_number() -> None:
    nothing = CALM._replace(status=np.zeros(9, int), done=CALM.done * np.nan, wait=CALM.wait * np.nan)
    stats = StatsAnswer(scene="load", keys=[1, 2])
    part, made = Part("kinds"), ran(STEADY, nothing, speed=np.nan, stats=stats)
    load_cases.add_figures(part, made)
    load_cases.add_goals(part, [made])
    assert all(np.isfinite(f.value) for f in part.figures)
    text = json.dumps(load_cases.summary(made), allow_nan=False)
    assert json.loads(text)["figures"]["unanswered"] == 9 and json.loads(text)["stats"]["keys"] is None
    assert {row["verdict"] for row in goal_rows([part], load_cases.NOTES) if row["key"] == "misses"} == {
        "not measured"
    }


def test_memory_is_that_beyond_the_empty_process_and_the_budget() -> None:
    hard = Case("kinds", "teleport", 8, 0.1, None)
    assert verdicts([ran(hard, CALM)])["memory"] == MET  # 250 - 100 - 50
    assert verdicts([ran(hard, CALM, peak=301 << 20)])["memory"] == MISSED


def test_round_trips_of_the_crowd_are_held_against_the_echo_of_as_many() -> None:
    own, echo = Case("users", "stroll", 64, 1.1, None), Case("users", "stroll", 64, 1.1, ECHO)
    few = Case("users", "stroll", 8, 1.1, None)
    slower = CALM._replace(done=CALM.due + 0.025)
    assert verdicts([ran(own, CALM), ran(echo, CALM), ran(few, slower)])["echo"] == MET
    assert verdicts([ran(own, slower), ran(echo, CALM)])["echo"] == MISSED
    assert "echo" not in verdicts([ran(own, CALM)])


def test_the_knee_is_the_fewest_users_for_whom_frames_stall() -> None:
    runs = [ran(Case("users", "stroll", n, 1.1, None), CALM) for n in (8, 16)]
    assert load_cases.knee(runs) == {load_cases.AS_SERVED: None}
    late = CALM._replace(done=CALM.done + 1.0)
    runs += [ran(Case("users", "stroll", n, 1.1, None), late) for n in (64, 32)]
    assert load_cases.knee(runs) == {load_cases.AS_SERVED: 32}


def test_the_speed_of_users_is_over_the_floor_and_of_no_one_who_jumps() -> None:
    pose = np.tile(np.eye(4), (91, 1, 1))
    pose[:, 0, 3] = np.arange(91) * 0.1
    walked = Trace(np.zeros(91, np.int64), np.arange(91) / 30, pose)
    assert load_cases.mean_speed(walked) == pytest.approx(3.0)
    pose[45:, 0, 3] += 100.0
    assert np.isnan(load_cases.mean_speed(walked))


def test_the_page_holds_goals_figures_and_pictures_and_needs_no_other_file(tmp_path: Path) -> None:
    keys = np.array([3, 8, 9], np.uint64)
    low = np.column_stack([np.arange(3) * 10.0, np.zeros(3), np.zeros(3)])
    voxels = Voxels(keys, np.stack([low, low + 1.0], axis=1), np.full(3, 10), 0.01)
    shown = ran(STEADY, CALM, strip=[(0.5, keys[:1]), (1.5, keys[1:])])
    runs = [shown, ran(Case("kinds", "run", 8, 0.1, None), CALM, speed=5.0)]
    crowd = [ran(Case("users", "stroll", n, 1.1, side), CALM) for n in (8, 64) for side in (None, ECHO)]
    part = Part("kinds")
    for one in runs:
        load_cases.add_figures(part, one)
    load_cases.add_goals(part, runs)
    made = [
        ("hits", load_pictures.hit_rate(runs)),
        ("stalls", load_pictures.stalls(runs)),
        ("trips", load_pictures.round_trips(crowd)),
        ("bytes", load_pictures.bytes_over_time(runs)),
        ("strip", load_pictures.film_strip(shown, voxels)),
    ]
    assert all(picture.startswith(b"\x89PNG") for _, picture in made)
    target = tmp_path / "out" / "load.html"
    load_page.write_page([part], load_cases.NOTES, made, "a <town>", target)
    text = target.read_text()
    assert text.count("data:image/png;base64,") == 5 and "a &lt;town&gt;" in text
    assert "stroll, 8 users" in text and "frames stalled" in text and 'src="http' not in text


def test_a_run_that_is_wrong_is_said() -> None:
    part = Part("kinds")
    load_cases.add_figures(part, ran(STEADY, CALM, wrong=2, faults=["busy", "busy"]))
    assert (
        len(part.wrong) == 1 and "2 verdicts" in part.wrong[0] and sum("busy" in r for r in part.remarks) == 1
    )


def test_the_page_of_a_running_test_says_so_and_reloads_itself(tmp_path: Path) -> None:
    target = tmp_path / "load.html"
    state = load_page.PageState("kinds: stroll, 8 users", 3, 14, 130.0)
    load_page.write_page([Part("kinds")], {}, [], "a hall", target, state)
    text = target.read_text()
    assert (
        "running: kinds: stroll, 8 users (3 of 14 runs, 2 min so far)" in text
        and 'http-equiv="refresh"' in text
    )
    load_page.write_page([Part("kinds")], {}, [], "a hall", target, state._replace(now="", done=14))
    assert "running" not in target.read_text() and "refresh" not in target.read_text()


def test_labels_keep_their_order_and_a_distance() -> None:
    heights = np.array([0.5, 0.52, 0.51, 0.9, 0.1])
    found = spread(heights, 0.06)
    assert np.argsort(found).tolist() == np.argsort(heights).tolist()
    assert (np.diff(np.sort(found)) >= 0.06 - 1e-6).all()
    assert found[3:].tolist() == [0.9, 0.1], "nothing is near them"
    assert spread(np.full(4, 0.5), 0.1) == pytest.approx([0.35, 0.45, 0.55, 0.65], abs=0.01)


def overlapping(axes) -> list[tuple[str, str]]:
    """Return pairs of texts that overlap in a drawn picture."""
    figure = axes.figure
    figure.canvas.draw()
    boxes = [(text.get_text(), Text.get_window_extent(text)) for text in axes.texts]  # without its line
    return [(a, b) for k, (a, one) in enumerate(boxes) for b, other in boxes[k + 1 :] if one.overlaps(other)]


def test_no_texts_overlap_and_no_legend_entries_look_alike() -> None:
    kinds = [
        ran(Case("kinds", kind, 8, 0.1, policy), CALM) for kind in ("stroll", "run") for policy in ("a", "b")
    ]
    budgets = [
        ran(Case("budgets", kind, 8, share, policy), CALM)
        for kind in ("stroll", "tour", "teleport") for policy in ("lru+prefetch", "lru") for share in (0.1, 0.4)
    ]  # fmt: skip
    speeds = [
        ran(Case("speeds", "stroll", 8, 0.1, policy, speed), CALM, speed=speed)
        for policy in ("lru+prefetch", "lru") for speed in (1.5, 5.0)
    ]  # fmt: skip
    crowd = [ran(Case("users", "stroll", n, 1.1, side), CALM) for n in (8, 64) for side in (None, ECHO)]
    with drawn_figures() as figures:
        load_pictures.hit_rate(budgets)
        load_pictures.stalls(speeds)
        load_pictures.round_trips(crowd)
        load_pictures.bytes_over_time(kinds)
    assert [overlaps(figure) for figure in figures] == [[]] * 4
    assert [alike_in_grey(figure) for figure in figures] == [[]] * 4


def test_names_of_lines_stand_beside_the_axes_without_overlap() -> None:
    figure, axes = load_pictures._axes("title")
    ends = []
    for k, level in enumerate((1.0, 1.02, 1.05, 30.0, 33.0)):
        axes.plot([0, 1], [level, level])
        ends.append((1.0, level, f"line {k}", "#000000"))
    axes.set_yscale("log")
    load_pictures._settle(axes)
    label_ends(axes, ends, load_pictures.LABEL_FONT)
    assert len(axes.texts) == 5 and overlapping(axes) == []
    right = axes.get_window_extent().x1
    assert all(Text.get_window_extent(text).x0 > right for text in axes.texts)
    load_pictures.png(figure)
