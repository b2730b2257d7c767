"""An archive of six small scans, in several voxels with several cells each."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
from solidcloud.builder.config import BuildConfig
from solidcloud.builder.pipeline import build_archive
from solidcloud.schemas.archive.archive import Archive
from solidcloud.schemas.archive.archive_writer import write_index
from synthetic_scans import WITH_POINTS, make_scan, write_xyz

# Archive of format version 3, with unused voxels in its shards.
LATER = Path(__file__).resolve().parents[1] / "golden" / "archive-3"
ORIGIN = np.array([512345.678901, 5612345.123456, -7.25])


def dataset() -> list[tuple[np.ndarray, np.ndarray]]:
    """Return six georeferenced scans: points (n, 3) [m] and intensities (n,).

    Some heights are negative.
    """
    scans = []
    for seed, kind in enumerate(WITH_POINTS):
        xyz = make_scan(kind, seed, 200) + ORIGIN
        scans.append((xyz, np.random.default_rng(seed).uniform(0, 4096, len(xyz)).astype(np.float32)))
    return scans


def build_six(folder: Path) -> Path:
    """Build the archive of `dataset` below `folder`, with both optional columns; return its folder."""
    files = [write_xyz(folder / f"{i}.xyz", *scan) for i, scan in enumerate(dataset())]
    config = BuildConfig(
        voxel=0.9, cell_points=60, leaf=16, degree=4, keep=frozenset({"scan", "intensity"}), jobs=1
    )
    build_archive(files, folder / "archive", config)
    return folder / "archive"


def rows_of(xyz: np.ndarray, *columns: np.ndarray) -> np.ndarray:
    """Return rows (n, 3 + c) float64 in a sorted order."""
    rows = np.column_stack([xyz, *columns])
    return rows[np.lexsort(rows.T)]


def rewrite_index(folder: Path, change: Callable[[np.ndarray], None]) -> None:
    """Write an index of changed rows, with a valid checksum."""
    with Archive(folder) as archive:
        header, voxels = archive.header, archive.voxels.copy()
        shards = [(p.name, p.stat().st_size) for p in map(archive.shard_path, range(archive.shard_count()))]
    change(voxels)
    write_index(folder, header, voxels, shards)
