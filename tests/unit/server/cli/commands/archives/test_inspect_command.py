"""Test `solidcloud inspect --stray`: its text, its JSON, lists, and broken scans."""

import json
from pathlib import Path

import numpy as np
import pytest
import synthetic_scans
from scan_campaign import edit_list
from solidcloud.builder.sources.scan_list import read_scan_list
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


def test_json_has_the_same_fields(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    clean, dusty = json.loads(said(capsys, "a.ply", "b.ply", "--stray", "--json"))
    assert clean["stray"] == {
        "points": 0, "share": 0.0, "groups": 0, "largest": None, "outliers": None, "left_out": 0,
        "lost": 0, "moving": None,
    }  # fmt: skip
    assert dusty["stray"] == {
        "points": 3, "share": 3 / 628, "groups": 2, "largest": {"points": 2, "place": [0.55, 0.55, 1.05]},
        "outliers": "0.1,2", "left_out": 3, "lost": 0, "moving": "0.1,1",
    }  # fmt: skip
    (plain,) = json.loads(said(capsys, "b.ply", "--json"))
    assert plain["stray"] is None


def test_a_list_is_read_as_edited(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    said(capsys, "a.ply", "b.ply")
    edit_list(folder / "scans.toml", {"units": "mm"}, 1)
    before = (folder / "scans.toml").read_bytes()
    assert "no points hang" in said(capsys, "scans.toml", "--stray")
    assert (folder / "scans.toml").read_bytes() == before
    edit_list(folder / "scans.toml", {"scale": 1000.0}, 1)
    assert "b.ply: 3 points" in said(capsys, "scans.toml", "--stray")
    edit_list(folder / "scans.toml", {"use": False}, 1)
    assert "no points hang" in said(capsys, "scans.toml", "--stray", "-o", "more.toml")
    entries = read_scan_list(folder / "more.toml")
    assert [(entry.units, entry.scale, entry.use) for entry in entries] == [
        ("m", 1.0, True),
        ("mm", 1000.0, False),
    ]
    edit_list(folder / "scans.toml", {"index": 3}, 0)
    assert run(["inspect", "scans.toml", "--stray"]) == 3
    assert "holds 1 scans, expected one of index 3" in capsys.readouterr().err
    assert run(["inspect", "scans.toml", "b.ply"]) == 2
    assert "named twice" in capsys.readouterr().err


def test_a_scan_that_breaks_behind_its_header_is_named(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (folder / "c.xyz").write_text("0 0 0\n" * 200 + "1 2\n")
    assert run(["inspect", "a.ply", "c.xyz", "-o", "plain.toml"]) == 0
    assert run(["inspect", "a.ply", "b.ply", "c.xyz", "--stray"]) == 3
    printed = capsys.readouterr()
    assert "c.xyz" in printed.err and "b.ply: 3 points" in printed.out
    assert [bool(entry.fault) for entry in read_scan_list(folder / "scans.toml")] == [False, False, True]
