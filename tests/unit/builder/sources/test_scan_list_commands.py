"""Test `solidcloud inspect`, which writes a scan list, and `solidcloud build` of a list with broken files."""

import json
from pathlib import Path

import numpy as np
import pytest
from scan_campaign import POSE, edit_list, write_campaign
from solidcloud.builder.sources.common.scan import sha256_of
from solidcloud.builder.sources.scan_list import read_scan_list
from solidcloud.schemas.archive.archive import Archive
from solidcloud.server.cli.main import run


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return write_campaign(tmp_path / "campaign")


def test_the_command_writes_a_list_and_names_broken_files(
    folder: Path, capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(folder)
    assert run(["inspect", "."]) == 3
    out, err = capsys.readouterr()
    assert "5 scans in 4 files, 1 broken: 77 points and those of 1 scans" in out
    assert "c.e57" in err and "checksum" in err
    assert len(read_scan_list(folder / "scans.toml")) == 5
    edit_list(folder / "scans.toml", {"use": False}, 3)
    before = (folder / "scans.toml").read_bytes()
    assert run(["inspect", "a.las"]) == 0
    assert (folder / "scans.toml").read_bytes() == before and "was not changed" in capsys.readouterr().err
    assert run(["inspect", "a.las", "-o", "scans.toml"]) == 2
    assert run(["inspect", "a.las", "-o", "scans.toml", "--overwrite"]) == 0
    assert len(read_scan_list(folder / "scans.toml")) == 1
    assert run(["inspect", "nowhere"]) == 3


def test_the_command_prints_json(
    folder: Path, capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(folder)
    assert run(["inspect", "a.las", "b.ptx", "--json", "--sha256"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert [entry["count"] for entry in found] == [50, 20, 7]
    assert found[0]["sha256"] == sha256_of(folder / "a.las") and found[1]["pose"] == POSE.tolist()
    assert not (folder / "scans.toml").exists()


def test_a_build_names_every_broken_file_on_a_line_of_its_own(
    folder: Path, capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(folder)
    (folder / "e.las").write_bytes(b"LASF")
    (folder / "deep" / "d.xyz").write_text("1 2 3\n4 5\n")  # broken behind what its header says
    assert run(["build", ".", "-o", "archive", "--jobs", "1"]) == 3
    lines = [line for line in capsys.readouterr().err.splitlines() if "expected" in line]
    named = [next(name for name in ("c.e57", "d.xyz", "e.las") if name in line) for line in lines]
    assert sorted(named) == ["c.e57", "d.xyz", "e.las"]
    assert lines[0].startswith("error: ") and not (folder / "archive").exists()
    assert not [path for path in folder.iterdir() if path.name.startswith(".")]


def test_a_build_may_leave_broken_files_out(
    folder: Path, capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(folder)
    assert run(["inspect", "."]) == 3
    edit_list(folder / "scans.toml", {"crs": "EPSG:2056", "up": "y"}, 0)
    assert run(["build", "scans.toml", "-o", "archive", "--jobs", "1", "--skip-bad"]) == 0
    assert "left out" in capsys.readouterr().err
    with Archive(folder / "archive") as archive:
        header = archive.header
    assert header.points == 50 + 20 + 7 + 20 and header.unknown_everywhere
    kept = {(Path(s.path).name, s.index): s for s in header.sources}
    las, ptx, broken = kept["a.las", 0], kept["b.ptx", 0], kept["c.e57", 0]
    assert (las.crs, las.up, las.units) == ("EPSG:2056", "y", "m") and (ptx.crs, ptx.up) == ("", "z")
    assert np.array_equal(ptx.pose, POSE) and "checksum" in broken.fault
