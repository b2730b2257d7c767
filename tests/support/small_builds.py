"""Builds in this process with small voxels and cells, and six scans to build."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from solidcloud.builder.config import BuildConfig
from solidcloud.builder.pipeline import BuildSummary, build_archive
from synthetic_scans import WITH_POINTS, make_scan, write_xyz


def build(paths: Sequence[Path], target: Path, **options: object) -> BuildSummary:
    """Build in this process, by default with small voxels and cells."""
    config = BuildConfig(**{"voxel": 0.9, "cell_points": 60, "leaf": 16, "degree": 4, "jobs": 1, **options})
    return build_archive(paths, target, config)


def content(archive: Path) -> dict[str, bytes]:
    """Return every file of an archive."""
    return {str(p.relative_to(archive)): p.read_bytes() for p in sorted(archive.rglob("*")) if p.is_file()}


def six_files(tmp_path: Path) -> list[Path]:
    """Write six scans as text."""
    folder = tmp_path / "scans"
    folder.mkdir()
    return [
        write_xyz(folder / f"{kind.replace(' ', '_')}.xyz", make_scan(kind, i, 150) - 0.7,
                  np.random.default_rng(i).uniform(0, 9, 1 if kind == "one point" else 150).astype(np.float32))
        for i, kind in enumerate(WITH_POINTS)
    ]  # fmt: skip
