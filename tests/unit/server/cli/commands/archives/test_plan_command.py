"""Test `solidcloud plan` from its command line: its output and its errors."""

import json
from pathlib import Path

import numpy as np
import pytest
from solidcloud.server.cli.commands.archives.plan_command import time_text
from solidcloud.server.cli.main import run
from synthetic_scans import write_las


def test_a_number_of_points_is_planned_for(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["plan", "--points", "1e9", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["points"] == 10**9 and found["scans"] == 714
    assert found["spool_bytes"] == 12 * 10**9
    assert 2e9 < found["archive_bytes"] < 6e9
    assert sum(found["stages"].values()) == pytest.approx(found["seconds"])


def test_what_binds_is_said_with_what_to_do(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["plan", "--points", "1_000_000_000_000", "--memory", "1GB", "--density", "330"]) == 0
    # Lines are wrapped at the width of the terminal.
    out = " ".join(capsys.readouterr().out.split())
    assert "1,000,000,000,000 of 714,286 scans, 330 per square metre" in out
    assert "BINDS index, held by build and server" in out and "give a larger --voxel" in out
    assert (
        "rests on builds of made façades" in out
        and "assumed 330 points a square metre of surface (given)" in out
    )


def test_scans_are_planned_for_and_left_alone(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rng = np.random.default_rng(1)
    write_las(tmp_path / "a.las", rng.integers(0, 20_000, (5000, 3)))
    assert run(["plan", str(tmp_path), "-o", str(tmp_path / "x" / "archive"), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert (found["points"], found["scans"], found["lattice_step"]) == (5000, 1, 0.001)
    assert [path.name for path in tmp_path.iterdir()] == ["a.las"]


@pytest.mark.parametrize(
    ("arguments", "code", "said"),
    [
        ([], 2, "expected either scans or --points"),
        (["--points", "many"], 2, "--points 'many': expected a number"),
        (["--points", "0"], 2, "--points '0': expected a number"),
        (["--points", "1e9", "somewhere"], 2, "expected either scans or --points"),
        (["somewhere", "--density", "3"], 2, "--density and --scans need --points"),
        (["--points", "1e9", "--density", "0"], 2, "--density 0.0: expected a positive number"),
        (["--points", "1e9", "--voxel", "-1"], 2, "--voxel -1.0"),
        (["no-such-folder"], 3, "no-such-folder"),
    ],
)
def test_what_cannot_be_planned_is_refused(
    arguments: list[str], code: int, said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["plan", *arguments]) == code
    assert said in capsys.readouterr().err


@pytest.mark.parametrize(
    ("seconds", "text"),
    [
        (0.04, "0.0 s"),
        (9.94, "9.9 s"),
        (119, "119 s"),
        (130, "2.2 min"),
        (3 * 3600, "3.0 h"),
        (1e6, "11.6 days"),
    ],
)
def test_times_are_for_people(seconds: float, text: str) -> None:
    assert time_text(seconds) == text
