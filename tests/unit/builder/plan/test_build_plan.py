"""Estimates follow from rates and a scene; a look at scans finds surface and voxels. Nothing is timed."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import synthetic_scans
from solidcloud.builder.config import BuildConfig
from solidcloud.builder.pipeline import build_archive
from solidcloud.builder.plan import scan_sample as sample
from solidcloud.builder.plan.measure_rates import room
from solidcloud.builder.plan.scan_sample import plan_build, sample_scene
from solidcloud.builder.sources.scan_files import InputFile, open_input_files
from solidcloud.schemas.errors import ScanError

ONE = BuildConfig(jobs=1)


def write_las(path: Path, xyz: np.ndarray) -> None:
    """Points on a lattice of 0.1 mm."""
    synthetic_scans.write_las(path, np.rint(xyz * 1e4).astype(np.int64), scale=1e-4)


# --- a look at scans ------------------------------------------------------------------------------------


def looked(path: Path, config: BuildConfig = ONE) -> sample.SceneStats:
    return sample_scene(open_input_files([path]), config)


def test_a_small_scan_is_seen_as_it_is(tmp_path: Path) -> None:
    xyz = room(20_000)
    write_las(tmp_path / "a.las", xyz)
    scene = looked(tmp_path / "a.las")
    expected = len(np.unique(np.floor((xyz - xyz.min(axis=0)) / 8), axis=0))
    assert (scene.points, scene.scans, scene.formats) == (20_000, 1, {"las": 20_000})
    assert scene.voxels is not None and scene.voxels[1] == pytest.approx(expected, rel=0.1)
    assert scene.input_bytes == (tmp_path / "a.las").stat().st_size
    assert scene.extent == pytest.approx(30.0, abs=0.05)


def test_a_broken_scan_stops_a_plan_as_it_stops_a_build(tmp_path: Path) -> None:
    write_las(tmp_path / "a.las", room(1000))
    (tmp_path / "b.las").write_bytes(b"LASF nothing")
    with pytest.raises(ScanError, match=r"b\.las.*--skip-bad"):
        looked(tmp_path)
    assert looked(tmp_path, replace(ONE, skip_bad=True)).points == 1000
    with pytest.raises(ScanError, match="no scan holds a point"):
        sample_scene([InputFile(tmp_path / "x", [])], ONE)


def test_bytes_and_voxels_are_those_of_a_build_within_a_half(tmp_path: Path) -> None:
    write_las(tmp_path / "a.las", room(60_000))
    plan = plan_build([tmp_path / "a.las"], ONE, tmp_path / "archive")
    built = build_archive([tmp_path / "a.las"], tmp_path / "archive", ONE)
    assert plan.points == built.points
    stored = built.bytes
    assert 1 / 1.5 < plan.archive_bytes / stored < 1.5
    assert 1 / 1.5 < plan.voxels / built.voxels < 1.5
