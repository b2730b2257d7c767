"""The second pass: every point quantised once, in runs of any size, in the order that plain sorting gives."""

import zlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from solidcloud.builder.config import BuildConfig
from solidcloud.builder.passes.spool_pass import Spooled, SpoolUnit, spool_range
from solidcloud.builder.sources.common.scan import Scan, ScanBlock
from solidcloud.builder.spool.run_files import spool_dtype
from solidcloud.builder.spool.spool import Spool
from solidcloud.schemas.archive.voxel_grid import Lattice, make_lattice, voxel_keys
from solidcloud.schemas.errors import ScanError
from synthetic_scans import make_scan
from written_runs import write_run


class Listed(Scan):
    """A scan of points in memory, in blocks of a size of its own."""

    def __init__(self, xyz: np.ndarray, size: int = 50, intensity: np.ndarray | None = None) -> None:
        super().__init__(Path("listed.xyz"), "text")
        self.xyz, self.size = xyz, size
        self.intensity = np.arange(len(xyz), dtype=np.float32) if intensity is None else intensity

    def _read(self, block_points: int) -> Iterator[ScanBlock]:
        for start in range(0, len(self.xyz), self.size):
            part = slice(start, start + self.size)
            yield ScanBlock(self.xyz[part], self.intensity[part])


def spooled(
    folder: Path,
    scan: Scan,
    count: int,
    lattice: Lattice,
    run_points: int = 10_000,
    keep: frozenset[str] = frozenset(),
) -> tuple[Spooled, Spool]:
    """Spool a scan."""
    folder.mkdir(exist_ok=True)
    config = BuildConfig(keep=keep)
    dtype = spool_dtype(config)
    unit = SpoolUnit(scan, 3, 0, None, count, lattice, config, dtype, folder, "unit", run_points)
    return spool_range(unit), Spool(folder, dtype, lattice)


@pytest.mark.interpreted
@pytest.mark.parametrize("run_points", [1, 100, 10_000])
@pytest.mark.parametrize("keep", [frozenset(), frozenset({"scan", "intensity"})])
def test_every_point_is_spooled_once_whatever_the_runs(
    run_points: int, keep: frozenset[str], tmp_path: Path
) -> None:
    xyz = make_scan("corner", 2, 410)[: 41 if run_points == 1 else 410] + np.array([5e5, -1, 0])
    lattice = make_lattice(xyz.min(axis=0), 0.001, 0.5)
    result, spool = spooled(tmp_path / "s", Listed(xyz), len(xyz), lattice, run_points, keep)
    assert len(result.runs) == {1: 41, 100: 5, 10_000: 1}[run_points]
    steps = lattice.to_lattice(xyz)
    found, intensity = [], []
    for key in spool.keys.tolist():
        for rows in spool.rows(key):
            assert rows["local"].min() >= 0
            assert rows["local"].max() < lattice.voxel_steps
            found.append(rows["local"] + np.array(_coordinate(key)) * lattice.voxel_steps)
            if keep:
                assert (rows["scan_index"] == 3).all()
                intensity.append(rows["intensity"])
    assert sorted(np.concatenate(found).tolist()) == sorted(steps.tolist())
    if keep:
        assert np.array_equal(np.concatenate(found), steps[np.concatenate(intensity).astype(int)])
    assert result.moved_max == np.abs(lattice.to_world(steps) - xyz).max()


def _coordinate(key: int) -> list[int]:
    """Voxel coordinates of a key, bit by bit."""
    return [sum((key >> (3 * b + a) & 1) << b for b in range(21)) - (1 << 20) for a in range(3)]


@pytest.mark.parametrize("keep", [frozenset(), frozenset({"scan", "intensity"})])
@pytest.mark.parametrize("voxel", [0.002, 2097.152])
def test_a_run_is_what_sorting_all_columns_gives(voxel: float, keep: frozenset[str], tmp_path: Path) -> None:
    rng = np.random.default_rng(4)
    xyz = rng.integers(-12, 12, (4000, 3)) * 0.001 * np.array([1, 1, 0.05])
    values = np.array([0.0, -0.0, 1.5, -3, np.nan, -np.nan, np.inf, -np.inf], np.float32)
    scan = Listed(xyz, 700, rng.choice(values, len(xyz)))
    lattice = make_lattice((0.0005, 0, 0), 0.001, voxel)
    result, _ = spooled(tmp_path / "s", scan, len(xyz), lattice, keep=keep)
    steps = lattice.to_lattice(xyz)
    rows = np.zeros(len(xyz), spool_dtype(BuildConfig(keep=keep)))
    rows["local"] = steps % lattice.voxel_steps
    if keep:
        rows["scan_index"] = 3
        rows["intensity"] = np.where(np.isnan(scan.intensity), np.float32(np.nan), scan.intensity + 0)
    (tmp_path / "judge").mkdir()
    write_run(tmp_path / "judge" / "a.run", voxel_keys(steps // lattice.voxel_steps), rows)
    (name,) = result.runs
    sums = []
    for suffix in (".run", ".keys"):
        found = (tmp_path / "s" / name).with_suffix(suffix).read_bytes()
        assert found == (tmp_path / "judge" / "a").with_suffix(suffix).read_bytes()
        sums += [len(found), zlib.crc32(found)]
    assert result.runs[name] == sums
    assert sums[0] == len(xyz) * rows.dtype.itemsize


@pytest.mark.interpreted
def test_the_content_sum_names_the_points_and_not_their_order(tmp_path: Path) -> None:
    xyz = make_scan("noise", 2, 300)
    lattice = make_lattice((0, 0, 0), 0.001, 0.5)
    sums = set()
    for number, points in enumerate((xyz, xyz[::-1].copy(), np.roll(xyz, 77, axis=0))):
        result, _ = spooled(tmp_path / "s", Listed(points, 40 + number), 300, lattice, 100)
        sums.add(tuple(result.content))
    assert len(sums) == 1
    moved = xyz.copy()
    moved[7, 1] += 0.001
    other = spooled(tmp_path / "s", Listed(moved), 300, lattice, 100)[0].content
    assert all(a != b for a, b in zip(other, next(iter(sums)), strict=True))


@pytest.mark.parametrize("count", [299, 301])
def test_a_scan_that_changes_between_the_passes_is_refused(count: int, tmp_path: Path) -> None:
    lattice = make_lattice((0, 0, 0), 0.001, 8.0)
    with pytest.raises(ScanError, match=f"300 points, expected {count} as surveyed"):
        spooled(tmp_path / "s", Listed(make_scan("noise", 2, 300), 300), count, lattice, 100)
