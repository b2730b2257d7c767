"""Test that results about files of any name are printed and written."""

import csv
from pathlib import Path

import pytest
from solidcloud.server.report.common.bench_results import Goal, Part, show, write
from solidcloud.server.report.load.page.load_page import write_page

CASE = "[scan] [/data/hall] \x1b[31m\udcff"
SHOWN = r"[scan] [/data/hall] \x1b[31m\udcff"


def test_results_show_names_as_they_are(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Issue 35: `[scan]` was lost, and `[/data/hall]` ended a load test with an error of rich."""
    part = Part("walks", remarks=[CASE], wrong=[CASE], missing=[CASE], error=CASE)
    part.goals.append(Goal("key", "walks", CASE, 1.0, 2.0, "ms"))
    part.add(CASE, "ours", "time", 1.5, "ms")
    write([part], {}, {}, tmp_path / "load.json")
    write_page([part], {}, [("picture " + CASE, b"")], CASE, tmp_path / "load.html")
    show([part], {})
    said = capsys.readouterr().out
    assert said.count(SHOWN) == 6
    (row,) = csv.DictReader((tmp_path / "load.csv").read_text("utf-8").splitlines())
    assert row["case"] == SHOWN
    page = (tmp_path / "load.html").read_text("utf-8")
    assert page.count(SHOWN) == 9
    assert "\x1b" not in page
