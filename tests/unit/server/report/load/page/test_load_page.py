"""Test the figures, targets and page of a load test, computed from given frames."""

from pathlib import Path

import numpy as np
import pytest
from solidcloud.schemas.wire.answers import Verdict
from solidcloud.server.report.common.bench_results import MET, MISSED, Part, goal_rows
from solidcloud.server.report.load.page import load_page, load_pictures
from solidcloud.server.report.load.runs import load_cases, verdict_check
from solidcloud.server.report.load.runs.load_cases import ECHO, Case, Ran
from solidcloud.server.report.load.runs.load_server import Memory
from solidcloud.server.report.load.users import frame_outcomes
from solidcloud.server.report.load.users.archive_voxels import Voxels
from solidcloud.server.report.load.users.frame_outcomes import ANSWERED, NOTHING, REFUSED, Frames

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
