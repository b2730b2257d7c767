"""Test `solidcloud inspect --stray`: its text, its JSON, lists, and broken scans."""

from pathlib import Path

import numpy as np
import pytest
import synthetic_scans
from solidcloud.server.cli.main import run

DUST = np.array([[0.5, 0.5, 1.0], [0.52, 0.52, 1.0], [0.2, 0.8, 0.5]])


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a folder with a floor, a floor with dust above it, and a scan far away, and work in it."""
    along = np.arange(0.0, 1.0, 0.04)
    floor = np.stack(np.meshgrid(along, along, [0.02]), axis=-1).reshape(-1, 3)
    synthetic_scans.write_ply(tmp_path / "a.ply", floor)
    synthetic_scans.write_ply(tmp_path / "b.ply", np.concatenate([floor, DUST]))
    monkeypatch.chdir(tmp_path)
    return tmp_path


def said(capsys: pytest.CaptureFixture[str], *arguments: str, code: int = 0) -> str:
    """Run inspect; return what it prints."""
    capsys.readouterr()
    assert run(["inspect", *arguments]) == code
    return capsys.readouterr().out


def test_a_scan_with_hanging_points_has_a_line(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert said(capsys, "a.ply", "b.ply", "--stray").splitlines()[-2:] == [
        "b.ply: 3 points (0.0048 of all) hang in the air above floors, in 2 groups; the largest, of 2, at "
        "0.55 0.55 1.05",
        "solidcloud build: --outliers 0.1,2 leaves out at least 3 of 3; --moving 0.1,1 leaves out what only "
        "one of the overlapping scans saw",
    ]
    assert said(capsys, "a.ply", "--stray").splitlines()[-1] == "no points hang in the air above floors"
    assert "hang" not in said(capsys, "a.ply", "b.ply")
