"""Test the demonstration on a small scan: its figures are consistent, and its server stops afterwards."""

import json
import shlex
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from solidcloud.schemas.errors import ScanError, SolidcloudError
from solidcloud.server.report.walk.demo_walk import demonstrate
from solidcloud.server.report.walk.server_process import served


@pytest.fixture
def corridor(tmp_path: Path) -> Path:
    """Return a floor of 6 by 2 m with a wall across its middle."""
    x, y = np.meshgrid(np.arange(0, 6, 0.04), np.arange(0, 2, 0.04))
    floor = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    y, z = np.meshgrid(np.arange(0, 2, 0.04), np.arange(0.1, 2, 0.04))
    wall = np.column_stack([np.full(y.size, 3.0), y.ravel(), z.ravel()])
    np.savetxt(tmp_path / "corridor.xyz", np.concatenate([floor, wall]), fmt="%.4f")
    return tmp_path / "corridor.xyz"


def test_walk_through_a_wall_touches_it_there_and_nowhere_else(
    corridor: Path, tmp_path: Path, endpoint: str, capfd: pytest.CaptureFixture[str]
) -> None:
    report = demonstrate(tmp_path / "out", [corridor])
    check_commands(capfd.readouterr().out, endpoint, report["summary"])
    assert json.loads((tmp_path / "out" / "walk.json").read_text()) == report
    summary, frames = report["summary"], report["frames"]
    assert summary["frames"] == len(frames) == 1200
    verdicts = [frame["verdict"] for frame in frames]
    assert summary["contact"] == verdicts.count("contact") and summary["unknown"] == 0
    assert summary["contact"] + summary["clear"] == 1200
    touched = np.flatnonzero([verdict == "contact" for verdict in verdicts])
    # 6 m in 1,200 frames; the figure extends less than half a metre to the front and back.
    assert len(touched) > 60 and np.diff(touched).max() == 1
    assert abs(touched.mean() - 600) < 40 and np.ptp(touched) < 1.3 / 6 * 1200
    assert sum(frame["hits"] for frame in frames) == summary["hits"] > 0
    assert all(0 < frame["engine_us"] < frame["round_trip_us"] for frame in frames)
    assert (tmp_path / "out" / "walk.png").read_bytes().startswith(b"\x89PNG")


def check_commands(said: str, endpoint: str, summary: dict[str, Any]) -> None:
    """Check that the commands at the end of the demonstration work as they are printed."""
    serve, query = (line.strip() for line in said.splitlines() if line.startswith("  ") and " --" in line)
    with subprocess.Popen(
        shlex.split(f"{serve} --listen {endpoint}"), stdout=subprocess.PIPE, text=True
    ) as server:
        assert server.stdout is not None and server.stdout.readline().startswith("serving demo at")
        done = subprocess.run(
            f"{query} --connect {endpoint}", shell=True, capture_output=True, text=True, check=False
        )
        server.terminate()
    verdicts = f"1200 poses: {summary['clear']} clear, {summary['contact']} contact, 0 unknown"
    assert done.returncode == 0 and verdicts in done.stdout, done.stdout[-300:] + done.stderr


def test_demonstration_of_a_missing_scan_says_so(tmp_path: Path) -> None:
    with pytest.raises(ScanError, match="no such file"):
        demonstrate(tmp_path / "out", [tmp_path / "nowhere.las"])


def test_server_that_cannot_start_is_an_error(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SolidcloudError, match="exit code 3"), served(tmp_path, "hall"):
        pass
    assert "no archive here" in capfd.readouterr().err
