"""Levels of detail as a reader finds them: their name, their cover radii, and when there is none."""

import shutil
from fractions import Fraction
from pathlib import Path

import archive_cases
import numpy as np
import pytest
import synthetic_scans
from forged_archives import Columns, forge
from solidcloud.schemas.archive.archive import Archive
from solidcloud.schemas.archive.level import (
    COVER_RADII,
    LEVEL_FOLDER,
    NODE_CLASS,
    cover_units,
    level_id,
    open_level,
    squared_covers,
)
from solidcloud.schemas.archive.radius_model import RADIUS_CLASSES
from solidcloud.schemas.errors import CorruptError, FormatError


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An archive with a level."""
    folder = tmp_path_factory.mktemp("level")
    return archive_cases.build(folder, synthetic_scans.make_scan("noise", 3, 2000)).archive


@pytest.fixture
def archive(made: Path, tmp_path: Path) -> Path:
    """A copy of it, to be changed."""
    return shutil.copytree(made, tmp_path / "archive")


@pytest.mark.parametrize("step", [1e-6, 1e-4, 2.0**-10, 0.001, 0.3, 7.0])
def test_no_point_at_a_cover_radius_is_farther_than_its_units(step: float) -> None:
    """Squared steps are the greatest within the radius, and units include the rounding of both ends."""
    for radius, square, units in zip(COVER_RADII, squared_covers(step).tolist(), cover_units(), strict=False):
        exact = Fraction(radius, 1_000_000) / Fraction(repr(step))
        assert square <= exact**2 < square + 1
        assert Fraction(int(units) - 2) >= Fraction(radius, 1_000_000) * 2**26
    assert (np.diff(cover_units()[:NODE_CLASS]) > 0).all()
    assert len(cover_units()) == RADIUS_CLASSES and not cover_units()[NODE_CLASS:].any()


def test_the_level_of_an_archive_is_opened(archive: Path) -> None:
    with Archive(archive) as opened:
        level = open_level(opened)
        assert level is not None
        with level:
            assert level.header.archive_id == level_id(opened.header) != opened.header.archive_id
            assert level.voxels["key"].tolist() == opened.voxels["key"].tolist()
            assert 0 < level.header.points < opened.header.points / 8


def test_without_a_level_there_is_none(archive: Path) -> None:
    shutil.rmtree(archive / LEVEL_FOLDER)
    with Archive(archive) as opened:
        assert open_level(opened) is None


def test_a_level_of_another_archive_is_none(archive: Path, tmp_path: Path) -> None:
    other = archive_cases.build(tmp_path, synthetic_scans.make_scan("pillar", 4, 2000)).archive
    shutil.rmtree(archive / LEVEL_FOLDER)
    shutil.copytree(other / LEVEL_FOLDER, archive / LEVEL_FOLDER)
    with Archive(archive) as opened:
        assert open_level(opened) is None


def test_a_level_without_a_voxel_is_refused(archive: Path) -> None:
    """It would say that nothing is where that voxel is."""

    def drop(columns: Columns) -> None:
        voxels = columns["voxels"]
        gone, kept = voxels[0], voxels[1:]
        assert len(kept)
        columns["voxels"] = kept
        columns["points"][0] = columns["source_count"][0] = columns["points"][0] - gone["rows"][2]
        from solidcloud.schemas.archive.voxel_grid import voxel_coordinates

        base = voxel_coordinates(kept["key"]) * int(columns["voxel_steps"][0])
        columns["bounds"][0] = (base + kept["low"]).min(axis=0)
        columns["bounds"][1] = (base + kept["high"]).max(axis=0)
        counts = columns["radius_counts"]
        left = int(gone["rows"][2])
        for number in np.flatnonzero(counts):
            taken = min(left, int(counts[number]))
            counts[number] -= taken
            left -= taken

    forge(archive / LEVEL_FOLDER, drop)
    with Archive(archive) as opened, pytest.raises(FormatError, match="does not describe the voxels"):
        open_level(opened)


def test_a_damaged_level_is_an_error_that_names_it(archive: Path) -> None:
    index = archive / LEVEL_FOLDER / "index.h5"
    index.write_bytes(index.read_bytes()[:500])
    with Archive(archive) as opened, pytest.raises((FormatError, CorruptError), match=r"level/index\.h5"):
        open_level(opened)
