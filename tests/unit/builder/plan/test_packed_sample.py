"""Bytes a point, by packing some blocks of points as a build packs them."""

from pathlib import Path

import numpy as np
import plan_kinds
import pytest
import synthetic_scans
from solidcloud.builder.config import BuildConfig
from solidcloud.builder.pipeline import build_archive
from solidcloud.builder.plan import packed_sample
from solidcloud.builder.plan import scan_sample as sample
from solidcloud.builder.plan.build_plan import GUESSED_WITHIN, MEASURED_WITHIN
from solidcloud.builder.plan.scan_sample import plan_build

POINTS = 60_000
ONE = BuildConfig(jobs=1)


def archive_bytes(folder: Path) -> int:
    return sum(path.stat().st_size for path in (folder / "index.h5", *(folder / "shards").iterdir()))


@pytest.mark.parametrize("kind", plan_kinds.KINDS)
def test_bytes_are_those_of_a_build_within_15_percent(
    kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All points packed; some blocks, of scans read whole; some blocks, of scans read in part."""
    (folder := tmp_path / kind).mkdir()
    plan_kinds.KINDS[kind](folder, POINTS)
    build_archive([folder], tmp_path / "hall", ONE)
    found = archive_bytes(tmp_path / "hall")
    whole = plan_build([folder], ONE, tmp_path)
    assert whole.archive_bytes == pytest.approx(found, rel=0.05)
    assert whole.archive_within == MEASURED_WITHIN
    monkeypatch.setattr(packed_sample, "ALL_POINTS", 0)
    monkeypatch.setattr(packed_sample, "BLOCK_POINTS", 2500)
    blocks = plan_build([folder], ONE, tmp_path)
    assert blocks.archive_bytes == pytest.approx(found, rel=MEASURED_WITHIN - 1)
    assert blocks.voxels == whole.voxels
    monkeypatch.setattr(packed_sample, "_share", lambda *_: 0.5)
    part = plan_build([folder], ONE, tmp_path)
    assert any("of all were read" in line for line in part.assumed)
    assert 1 / 1.3 < part.archive_bytes / found < 1.3


def test_columns_that_are_kept_are_packed_too(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    light = rng.integers(0, 1 << 16, 20_000).astype(np.uint16)
    synthetic_scans.write_las(tmp_path / "a.las", rng.integers(0, 8000, (20_000, 3)), intensity=light)
    config = BuildConfig(jobs=1, keep=frozenset({"intensity", "scan"}))
    build_archive([tmp_path / "a.las"], tmp_path / "hall", config)
    plan = plan_build([tmp_path / "a.las"], config, tmp_path)
    assert plan.archive_bytes == pytest.approx(archive_bytes(tmp_path / "hall"), rel=0.05)
    assert plan.archive_bytes > 1.2 * plan_build([tmp_path / "a.las"], ONE, tmp_path).archive_bytes


def test_a_quick_look_packs_nothing_and_says_a_range(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    synthetic_scans.write_las(tmp_path / "a.las", np.random.default_rng(1).integers(0, 8000, (5000, 3)))
    monkeypatch.setattr(sample, "packed_sample", lambda *_: pytest.fail("packed"))
    plan = plan_build([tmp_path / "a.las"], ONE, tmp_path, quick=True)
    assert plan.archive_within == GUESSED_WITHIN and not any("packed" in line for line in plan.assumed)


def test_a_cube_with_too_many_points_is_halved_around_its_point(monkeypatch: pytest.MonkeyPatch) -> None:
    lattice = packed_sample.Lattice((0.0, 0.0, 0.0), 1.0, 64)
    cubes = packed_sample._Cubes(np.array([[5.0, 5.0, 5.0]]), lattice, 6)
    local = np.random.default_rng(1).integers(0, 64, (4000, 3)).astype(np.int32)
    found = packed_sample._NOTHING._replace(
        slot=np.zeros(4000, np.int64),
        local=local,
        scan=np.zeros(4000, np.uint16),
        intensity=np.zeros(4000, np.float32),
    )
    cropped = cubes.cropped(found, 100)
    edge = 1 << int(cubes.chosen[0, 4])
    low = np.array([5, 5, 5]) // edge * edge
    inside = ((local >= low) & (local < low + edge)).all(axis=1)
    assert np.array_equal(cropped.local, local[inside]) and 0 < len(cropped.local) <= 100


def test_two_scans_of_other_offsets_share_no_step(tmp_path: Path) -> None:
    raw = np.random.default_rng(1).integers(0, 8000, (3000, 3))
    synthetic_scans.write_las(tmp_path / "a.las", raw)
    synthetic_scans.write_las(tmp_path / "b.las", raw, offset=(0.0004, 0.0, 0.0))
    assert plan_build([tmp_path], ONE, tmp_path).lattice_step == 1e-4
    assert plan_build([tmp_path / "a.las"], ONE, tmp_path).lattice_step == 1e-3
