"""Test the course of a load test without a server: budgets first, the page after every run, own walks."""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from solidcloud.builder.config import BuildConfig
from solidcloud.builder.pipeline import build_archive
from solidcloud.builder.run.executor import Silent
from solidcloud.server.cli.main import run
from solidcloud.server.report.load import load_test
from solidcloud.server.report.load.load_test import LoadOptions, run_load_test
from solidcloud.server.report.load.runs import load_run, load_server
from solidcloud.server.report.load.runs.load_run import Outcome
from solidcloud.server.report.load.users import frame_outcomes
from solidcloud.server.report.load.users.frame_outcomes import ANSWERED
from solidcloud.server.report.load.users.user_traces import Trace


@pytest.fixture(scope="module")
def hall(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the archive of a floor of 16 m by 8 m, in eight voxels."""
    folder = tmp_path_factory.mktemp("hall")
    x, y = np.meshgrid(np.arange(0, 16, 0.1), np.arange(0, 8, 0.1))
    np.savetxt(folder / "hall.xyz", np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)]), fmt="%.3f")
    build_archive([folder / "hall.xyz"], folder / "hall", BuildConfig(jobs=1, voxel=4.0))
    return folder / "hall"


class Server:
    """Stand-in for server and users: all frames are answered in 10 ms, with the true verdicts."""

    def __init__(self, out: Path) -> None:
        self.page, self.budgets, self.pages = out / "load.html", list[int](), list[str]()
        self.traces = list[Trace]()

    @contextmanager
    def serving(self, *_: Any) -> Iterator[None]:
        yield

    def run(self, setup: load_run.Setup, trace: Trace, budget: int, *_: Any) -> Outcome:
        self.pages.append(self.page.read_text())
        self.budgets.append(budget)
        self.traces.append(trace)
        frames = frame_outcomes.empty(trace.user, trace.time + 5.0)
        frames.sent[:], frames.done[:] = frames.due, frames.due + 0.01
        frames.status[:], frames.verdict[:] = ANSWERED, 2
        return Outcome(trace, frames, 5.0)


@pytest.fixture
def server(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Server:
    made = Server(tmp_path / "out")
    monkeypatch.setattr(load_server, "serving", made.serving)
    monkeypatch.setattr(load_run, "run", made.run)
    monkeypatch.setattr(load_test, "draw_pictures", lambda *_: [])
    return made


def options(**changed: Any) -> LoadOptions:
    usual: dict[str, Any] = {"users": 2, "seconds": 2.0, "policies": ("lru",), "sections": ("kinds",)}
    return LoadOptions(**{**usual, **changed})


def test_the_page_is_up_to_date_after_every_run(hall: Path, tmp_path: Path, server: Server) -> None:
    report = run_load_test(hall, options(kinds=("stroll", "turn", "teleport")), tmp_path / "out", Silent())
    assert not report.failed and len(report.parts) == 1 and len(server.pages) == 3
    for number, page in enumerate(server.pages):
        assert f"{number} of 3 runs" in page and 'http-equiv="refresh"' in page
        kind = ("stroll", "turn", "teleport")[number]
        assert f"running: kinds: {kind}, 2 users" in page
    assert "<td>stroll, 2 users" in server.pages[1] and "<td>stroll, 2 users" not in server.pages[0]
    last = (tmp_path / "out" / "load.html").read_text()
    assert "running" not in last and "refresh" not in last and last.count("<td>teleport, 2 users") >= 1
    found = json.loads((tmp_path / "out" / "load.json").read_text())
    assert len(found["runs"]) == 3 and found["archive"]["points"] == 12_800
    assert (tmp_path / "out" / "load.csv").exists()


def test_a_budget_that_is_too_small_is_refused_before_anything_runs(
    hall: Path, tmp_path: Path, server: Server, capsys: pytest.CaptureFixture
) -> None:
    for option, value in (("--budget", "0.01"), ("--budgets", "0.5,0.01")):
        assert run(["loadtest", str(hall), "-o", str(tmp_path / "out"), option, value]) == 2
        said = capsys.readouterr().err
        assert f"error: {option} 0.01: the largest voxel takes" in said and "give at least" in said
    assert server.budgets == [] and not (tmp_path / "out" / "load.html").exists()


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (["--only", "kinds,cars"], "--only: cars: expected some of start, kinds"),
        (["--kinds", "fly"], "--kinds: fly: expected some of stroll"),
        (["--speeds", "a"], "--speeds 'a': expected positive numbers"),
        (["--walk", "none.csv"], "none.csv: No such file"),
    ],
)
def test_wrong_options_are_named(
    hall: Path, tmp_path: Path, server: Server, capsys: pytest.CaptureFixture, given: list[str], said: str
) -> None:
    assert run(["loadtest", str(hall), "-o", str(tmp_path / "out"), *given]) in (2, 3)
    assert said in capsys.readouterr().err and server.budgets == []


def test_own_walks_take_the_place_of_made_ones(hall: Path, tmp_path: Path, server: Server) -> None:
    walk = tmp_path / "walk.csv"
    rows = "".join(f"{k / 30},{k / 20},4,0.1,1,0,0,0\n" for k in range(60))
    walk.write_text("t,x,y,z,qw,qx,qy,qz\n" + rows)
    report = run_load_test(
        hall, options(walks=(walk,), sections=("kinds", "speeds", "budgets")), tmp_path / "out", Silent()
    )
    assert [part.section for part in report.parts] == ["kinds", "budgets"]
    assert len(server.traces) >= 3 and report.about["options"]["kinds"] == ["walk"]
    first = server.traces[0]
    assert set(first.user.tolist()) == {0, 1} and (first.pose[:, 1, 3] == 4.0).all()


def test_a_run_that_fails_leaves_the_others(
    hall: Path, tmp_path: Path, server: Server, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(setup: load_run.Setup, trace: Trace, *more: Any) -> Outcome:
        if len(server.pages) == 1 and not (tmp_path / "failed").exists():
            (tmp_path / "failed").touch()
            raise load_server.ServerError("a process of users ended")
        return server.run(setup, trace, *more)

    monkeypatch.setattr(load_run, "run", fails)
    report = run_load_test(hall, options(kinds=("stroll", "turn", "crowd")), tmp_path / "out", Silent())
    assert len(report.about["runs"]) == 2 and report.failed
    assert (report.parts[0].error or "").startswith("1 of 3 runs failed: turn, 2 users")
    (missing,) = report.parts[0].missing
    assert missing.startswith("turn, 2 users") and missing.endswith("a process of users ended")
