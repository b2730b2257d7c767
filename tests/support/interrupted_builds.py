"""A small interrupted build of two scans, and the files that it leaves."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import solidcloud.builder.build_limits as build_limits
import solidcloud.builder.passes.survey_pass as survey
import solidcloud.builder.pipeline as pipeline
from solidcloud.builder.config import BuildConfig
from solidcloud.builder.pipeline import BuildSummary, build_archive
from solidcloud.builder.resume.kept_work import building_folder
from synthetic_scans import make_scan, write_las, write_xyz


def build(target: Path, scans: list[Path], **options: Any) -> BuildSummary:
    """Build in this process."""
    given = {"voxel": 0.9, "cell_points": 60, "leaf": 16, "degree": 4, "jobs": 1, "radius": 0.001, **options}
    return build_archive(scans, target, BuildConfig(**given))


def content(archive: Path) -> dict[str, bytes]:
    """Return every file of an archive."""
    return {str(p.relative_to(archive)): p.read_bytes() for p in sorted(archive.rglob("*")) if p.is_file()}


def done_folder(target: Path) -> Path:
    """Return the folder with the finished work of an interrupted build."""
    (folder,) = (path for path in building_folder(target).iterdir() if path.is_dir())
    return folder


def two_scans(folder: Path, monkeypatch: pytest.MonkeyPatch) -> list[Path]:
    """Write two scans, one of which is read in three ranges; they become two shards."""
    monkeypatch.setattr(survey, "RANGE_POINTS", (100, 100))
    monkeypatch.setattr(build_limits, "SHARD_POINTS", 1000)
    raw = np.random.default_rng(2).integers(-1500, 1500, (250, 3))
    write_las(folder / "a.las", raw)
    write_xyz(folder / "b.xyz", make_scan("plane", 3, 150))
    return [folder / "a.las", folder / "b.xyz"]


def interrupted(target: Path, scans: list[Path], monkeypatch: pytest.MonkeyPatch, **options: Any) -> None:
    """Interrupt a build with Ctrl-C just before its shards."""
    with monkeypatch.context() as patch:
        patch.setattr(pipeline, "build_shards", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
        with pytest.raises(KeyboardInterrupt):
            build(target, scans, **options)
    assert (building_folder(target) / "build.json").exists()
