"""Test the figures with which `build` and `info` end: area, spacing, voxel size, what to look at."""

import json
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from solidcloud.builder.config import BuildConfig
from solidcloud.builder.passes.archive_summary import ArchiveSummary, summarize_archive
from solidcloud.builder.pipeline import build_archive
from solidcloud.schemas.archive.archive import Archive
from solidcloud.server.cli.main import run


def grid(width: float, depth: float, spacing: float) -> NDArray[np.float64]:
    """Return points (n, 3) of a floor with its upper side at 0 [m]."""
    x, y = np.meshgrid(np.arange(0, width, spacing), np.arange(0, depth, spacing))
    return np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)]) + spacing / 2


def write_xyz(path: Path, points: NDArray[np.float64]) -> Path:
    np.savetxt(path, points, fmt="%.4f")
    return path


def summary_of(folder: Path, points: NDArray[np.float64], **options: float) -> ArchiveSummary:
    scan = write_xyz(folder / "scan.xyz", points)
    build_archive([scan], folder / "archive", BuildConfig(jobs=1, overwrite=True, **options))
    with Archive(folder / "archive") as archive:
        return summarize_archive(archive)


def test_area_spacing_and_bytes_of_a_floor(tmp_path: Path) -> None:
    points = grid(12.0, 8.0, 0.05)
    found = summary_of(tmp_path, points)
    assert found.points == len(points) == 38_400
    assert found.area == pytest.approx(96.0, rel=0.1) and "cubes of" in found.area_from
    assert found.spacing == pytest.approx(0.05, rel=0.01) and found.radius == pytest.approx(0.025, rel=0.01)
    assert found.radius_from == "half the mean spacing"
    assert (found.voxel, found.voxel_from, found.voxels) == (8.0, "the default", 2)
    assert found.points_a_voxel == 19_200 and found.densest == 160 * 160
    folder = tmp_path / "archive"
    size = sum(path.stat().st_size for path in (folder / "index.h5", *(folder / "shards").iterdir()))
    assert found.bytes_a_point == pytest.approx(size / len(points))
    assert found.look_at[0].startswith("place and size: ") and "ParaView" in found.look_at[0]


def test_build_and_info_end_with_the_same_lines(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    scan = write_xyz(tmp_path / "scan.xyz", grid(3.0, 2.0, 0.05))
    archive = str(tmp_path / "hall")
    build = ["build", str(scan), "-o", archive, "--jobs", "1"]
    assert run(build) == 0
    built = capsys.readouterr().out
    assert run(["info", archive]) == 0
    shown = capsys.readouterr().out
    assert built.split("\n\n")[-1] == shown.split("\n\n")[-1] and built.count("\n\n") == 1
    names = [line.split("  ")[0] for line in shown.split("\n\n")[-1].splitlines() if line[0] != " "]
    assert names == [
        "points",
        "area",
        "spacing",
        "radius",
        "voxel size",
        "leaf cells",
        "bytes a point",
        "if it looks wrong",
    ]
    assert run(["info", archive, "--json"]) == 0
    described = json.loads(capsys.readouterr().out)["summary"]
    assert run([*build, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["summary"] == described
    assert described["points"] == 2400 and isinstance(described["look_at"], list)


def test_a_damaged_shard_does_not_hide_the_other_figures(
    tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    summary_of(tmp_path, grid(3.0, 2.0, 0.05))
    (shard,) = (tmp_path / "archive" / "shards").iterdir()
    damaged = bytearray(shard.read_bytes())
    damaged[len(damaged) // 3 : len(damaged) // 3 * 2] = bytes(len(damaged) // 3)
    shard.write_bytes(bytes(damaged))
    assert run(["info", str(tmp_path / "archive")]) == 0
    assert "area               unknown (not estimated: " in capsys.readouterr().out
