"""Test that the result is of one generation, or an error, where an archive is replaced while it is read."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import synthetic_scans
from solidcloud.builder.config import BuildConfig
from solidcloud.builder.edit.edit_archive import add_scans
from solidcloud.builder.export import export_archive as export_module
from solidcloud.builder.export.export_archive import export_archive
from solidcloud.builder.passes import verify as verify_module
from solidcloud.builder.passes.verify import verify_archive
from solidcloud.builder.pipeline import build_archive
from solidcloud.schemas.errors import SolidcloudError


@pytest.fixture
def archive(tmp_path: Path) -> Path:
    """A small one."""
    path = tmp_path / "a.xyz"
    synthetic_scans.write_xyz(path, np.random.default_rng(1).uniform(0, 2, (300, 3)).round(3))
    build_archive([path], tmp_path / "hall", BuildConfig(voxel=1.0, resolution=1e-3, jobs=1))
    return tmp_path / "hall"


@pytest.fixture
def add(tmp_path: Path, archive: Path) -> Callable[[], None]:
    """Adds points to it that touch every voxel."""
    path = tmp_path / "b.xyz"
    synthetic_scans.write_xyz(path, np.random.default_rng(2).uniform(0, 2, (300, 3)).round(3))
    return lambda: print(add_scans(archive, [path], jobs=1))


def during(monkeypatch: pytest.MonkeyPatch, module: Any, name: str, what: Callable[[], None]) -> None:
    """Have something done just before a function of a module."""
    work = getattr(module, name)

    def after(*given: Any) -> Any:
        what()
        return work(*given)

    monkeypatch.setattr(module, name, after)


def test_what_is_checked_of_two_generations_is_an_error(
    archive: Path, add: Callable[[], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        during(patch, verify_module, "_verify_rows", add)
        with pytest.raises(SolidcloudError, match="changed while it was read, generation 0 and then 1: give"):
            verify_archive(archive)
    report = verify_archive(archive)
    assert not report.faults and report.points == 600


@pytest.mark.parametrize("name", ["_survey_points", "_write_points"])
def test_an_export_is_of_the_generation_it_began_with(
    archive: Path, add: Callable[[], None], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    """Its files are open from the first on, and stay readable when they are deleted."""
    export_archive(archive, tmp_path / "before.ply")
    with monkeypatch.context() as patch:
        during(patch, export_module, name, add)
        assert export_archive(archive, tmp_path / "while.ply").points == 300
    assert (tmp_path / "while.ply").read_bytes() == (tmp_path / "before.ply").read_bytes()
    assert export_archive(archive, tmp_path / "after.ply").points == 600
