"""Test `info` about scanners, coordinate systems, units and the densest voxel; notes of `validate`."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from solidcloud.builder.config import BuildConfig
from solidcloud.builder.pipeline import build_archive
from solidcloud.schemas.archive.archive import Archive
from solidcloud.schemas.archive.archive_writer import write_index
from solidcloud.server.cli.main import run
from solidcloud.server.residency.voxel_store import VoxelStore
from synthetic_scans import make_scan, write_xyz

WKT = 'PROJCS["UTM",\n  UNIT["metre",1]]'


@pytest.fixture
def archive(tmp_path: Path) -> Path:
    """Build an archive of three scans: one with a pose and a coordinate system, one in feet, one plain."""
    for i in range(3):
        write_xyz(tmp_path / f"{i}.xyz", make_scan("noise", i, 100 + 200 * i) + np.array([3.0 * i, 0, 0]))
    build_archive([tmp_path / f"{i}.xyz" for i in range(3)], tmp_path / "a", BuildConfig(voxel=3.0, jobs=1))
    with Archive(tmp_path / "a") as opened:
        header, rows = opened.header, opened.voxels
        shards = [
            (opened.shard_path(n).name, opened.shard_path(n).stat().st_size)
            for n in range(opened.shard_count())
        ]
    posed = np.eye(4)
    posed[:3, 3] = [1.5, -2.25, 100.0]
    sources = list(header.sources)
    sources[0] = replace(sources[0], pose=posed, crs=WKT)
    sources[1] = replace(sources[1], units="ft", up="y")
    write_index(tmp_path / "a", replace(header, sources=tuple(sources)), rows, shards)
    return tmp_path / "a"


def test_info_says_it_in_json(archive: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["info", str(archive), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["scans"] == [
        {"number": 0, "scanner": [1.5, -2.25, 100.0], "crs": WKT},
        {"number": 1, "units": "ft", "up": "y"},
    ]
    store = VoxelStore(archive)
    rows = store.archive.voxels["rows"][:, 2]
    densest = int(np.argmax(rows))
    assert found["densest"] == {
        "voxel": store.archive.coordinates[densest].tolist(),
        "points": int(rows.max()),
        "resident_bytes": int(store.sizes[densest]),
    }
    store.close()
    preview = archive / "preview.vtkhdf"
    assert found["preview"] == preview.stat().st_size > 1000
    preview.unlink()
    assert run(["info", str(archive), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["preview"] is None


def test_info_says_it_in_words(archive: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["info", str(archive)]) == 0
    words = " ".join(capsys.readouterr().out.split())
    for said in (
        "scanner at 1.500 -2.250 100.000 m",
        "read as ft, y up",
        'PROJCS["UTM", UNIT["metre",1]] (1 of the scans)',
        "densest voxel (",
        "preview preview.vtkhdf for ParaView",
    ):
        assert said in words


@pytest.mark.parametrize("jobs", ["1", "2"])
def test_validate_runs_in_as_many_jobs_as_asked_and_notes_strangers(
    jobs: str, archive: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (archive / "shards" / "mine.txt").write_text("notes")
    assert run(["validate", str(archive), "--jobs", jobs, "--deep"]) == 0
    out = capsys.readouterr().out
    assert "900 points, 0 faults" in out and "note: " in out and "mine.txt" in out
