"""What reading a record back holds is what memory.py counts with."""

import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scans import write_ply
from solidcloud.builder.config import BuildConfig
from solidcloud.builder.memory import RECORD_BYTES, record_bytes_a_point
from solidcloud.builder.pipeline import build_archive
from solidcloud.builder.preview import _choose
from solidcloud.builder.preview import _Unit as PreviewUnit
from solidcloud.builder.spacing import _own_sums, _OwnUnit
from solidcloud.builder.verify import _Unit as VerifyUnit
from solidcloud.builder.verify import _verify_rows
from solidcloud.schemas.archive import Archive

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


def readings(folder: Path, points: int) -> dict[str, Callable[[], object]]:
    """What reads back the only voxel of an archive, in one process."""
    with Archive(folder) as archive:
        assert len(archive.voxels) == 1
    rows = range(1)
    return {
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
        for task, call in readings(one_voxel(tmp_path / str(points), points, config), points).items():
            peaks.setdefault(task, []).append(held(call))
    counted = record_bytes_a_point(config)
    found = {task: (many - few) / (MANY - FEW) for task, (few, many) in peaks.items()}
    assert max(found.values()) <= counted, found
    assert max(found.values()) > counted / 2, found  # what cannot be compressed at all takes the rest
    assert all(many <= MANY * counted + RECORD_BYTES for _, many in peaks.values())
