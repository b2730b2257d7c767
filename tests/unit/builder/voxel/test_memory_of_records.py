"""What reading a record back holds is what memory.py counts with."""

import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from solidcloud.builder.config import BuildConfig
from solidcloud.builder.edit.archive_change import _read_back, _ReadUnit
from solidcloud.builder.edit.stored_points import FindUnit, GatherUnit, find_scans, gather
from solidcloud.builder.passes.point_spacing import _own_sums, _OwnUnit
from solidcloud.builder.passes.preview import _choose
from solidcloud.builder.passes.preview import _Unit as PreviewUnit
from solidcloud.builder.passes.verify import _Unit as VerifyUnit
from solidcloud.builder.passes.verify import _verify_rows
from solidcloud.builder.pipeline import build_archive
from solidcloud.builder.run.memory_shares import RECORD_BYTES, record_bytes_a_point
from solidcloud.schemas.archive.archive import Archive
from synthetic_scans import write_ply

FEW, MANY = 100_000, 250_000
# Of all points so many are asked for the radius, or chosen for the preview, that they count as nothing.
SHARE = 1e-4
ALL = frozenset({"scan", "intensity"})
OPTIONS: dict[str, dict[str, Any]] = {
    "coordinates alone": {},
    "scan and intensity": {"keep": ALL},
    "scan, intensity and classes": {"keep": ALL, "models": frozenset({"mean", "local"})},
    "small leaf nodes": {"leaf": 4, "degree": 4},
}


def one_voxel(folder: Path, points: int, config: BuildConfig) -> Path:
    """An archive of one voxel, of two scans whose points and intensities cannot be compressed much."""
    rng = np.random.default_rng(points)
    folder.mkdir()
    for name in ("a.ply", "b.ply"):
        xyz = rng.uniform(0, 1, (points // 2, 3)) * [1, 1, 0.1]
        write_ply(folder / name, xyz, rng.uniform(0, 1, points // 2).astype(np.float32))
    build_archive([folder / "a.ply", folder / "b.ply"], folder / "hall", config)
    return folder / "hall"


def readings(folder: Path, points: int, config: BuildConfig) -> dict[str, Callable[[], object]]:
    """What reads back the only voxel of an archive, in one process."""
    with Archive(folder) as archive:
        assert len(archive.voxels) == 1
        with_scans = archive.header.scan_index
    rows = range(1)
    spool = folder.with_name("spool")
    spool.mkdir(exist_ok=True)
    gathered = GatherUnit(folder, (0,), points, spool, "old", frozenset(), None, config, 1 << 12)
    finding: dict[str, Callable[[], object]] = {
        "find": lambda: find_scans(FindUnit(folder, (0,), points, frozenset({1}))),
    }
    return (finding if with_scans else {}) | {
        "gather": lambda: gather(gathered),
        "what was built": lambda: _read_back(_ReadUnit(folder, (0,), points)),
        "radius": lambda: _own_sums(_OwnUnit(folder, rows, SHARE, points)),
        "preview": lambda: _choose(PreviewUnit(folder, rows, SHARE, points)),
        "verify": lambda: _verify_rows(VerifyUnit(folder, rows, False, None, True, points)),
    }


def held(function: Callable[[], object]) -> int:
    """Bytes that a call holds at most: numpy's arrays and Python's bytes, of which records are made.

    What zstandard and numba take by themselves is not seen: tables of a few MB, and nothing.
    """
    function()
    tracemalloc.start()
    try:
        function()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("name", OPTIONS)
def test_a_record_read_back_holds_what_is_counted_for_it(name: str, tmp_path: Path) -> None:
    config = BuildConfig(voxel=4.0, jobs=1, radius=None, **OPTIONS[name])
    peaks: dict[str, list[int]] = {}
    for points in (FEW, MANY):
        for task, call in readings(one_voxel(tmp_path / str(points), points, config), points, config).items():
            peaks.setdefault(task, []).append(held(call))
    counted = record_bytes_a_point(config)
    found = {task: (many - few) / (MANY - FEW) for task, (few, many) in peaks.items()}
    assert max(found.values()) <= counted, found
    assert max(found.values()) > counted / 2, found  # what cannot be compressed at all takes the rest
    assert all(many <= MANY * counted + RECORD_BYTES for _, many in peaks.values())


def test_one_record_is_held_at_a_time(tmp_path: Path) -> None:
    """Of several in a unit: the one before is let go before the next is read."""
    rng = np.random.default_rng(7)
    for at, name in enumerate(("a.ply", "b.ply", "c.ply")):
        write_ply(tmp_path / name, rng.uniform(0, 1, (FEW, 3)) * [1, 1, 0.1] + [1 + 4 * at, 0, 0])
    config = BuildConfig(voxel=4.0, jobs=1, keep=frozenset({"scan"}), radius=0.01)
    folder = tmp_path / "hall"
    build_archive([tmp_path], folder, config)
    with Archive(folder) as archive:
        assert archive.voxels["rows"][:, 2].tolist() == [FEW] * 3
    all_rows = range(3)
    tasks: dict[str, Callable[[range], object]] = {
        "find": lambda rows: find_scans(FindUnit(folder, tuple(rows), FEW, frozenset({7}))),
        "what was built": lambda rows: _read_back(_ReadUnit(folder, tuple(rows), FEW)),
        "preview": lambda rows: _choose(PreviewUnit(folder, rows, SHARE, FEW)),
        "verify": lambda rows: _verify_rows(VerifyUnit(folder, rows, False, None, True, FEW)),
    }
    for name, task in tasks.items():
        one = max(held(lambda row=row, task=task: task(range(row, row + 1))) for row in all_rows)
        assert held(lambda task=task: task(all_rows)) < 1.15 * one, name
