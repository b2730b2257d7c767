"""Test that normals estimated when an archive is built are those of the definition."""

import os
from pathlib import Path

import naive_normals
import numpy as np
import pytest
import small_builds
import synthetic_scans
from numpy.typing import NDArray
from solidcloud.builder.kernels.neighbours.nearest_neighbours import BLOCK
from solidcloud.builder.passes.verify import verify_archive
from solidcloud.builder.voxel.point_normals import voxel_normals
from solidcloud.builder.voxel.record_points import voxel_points
from solidcloud.schemas.archive.archive import Archive
from solidcloud.schemas.archive.normal_reach import squared_reach
from solidcloud.schemas.kernels.normal_codes import NO_NORMAL, normal_code

pytestmark = pytest.mark.interpreted

INTERPRETED = os.environ.get("NUMBA_DISABLE_JIT") == "1"
STEPS = 5000


def sums_of(points: NDArray[np.int64], at: NDArray[np.int64], square: int) -> NDArray[np.int64]:
    """What `normal_code` is told, in Python's integers."""
    away = naive_normals.neighbours(points, at, square).astype(object)
    x, y, z = away.T
    return np.array(
        [len(away), *(c.sum() for c in (x, y, z, x * x, y * y, z * z, y * z, z * x, x * y))], np.int64
    )


@pytest.mark.parametrize("kind", ["corner", "duplicates", "one point"])
@pytest.mark.parametrize("reach", [300, 20_000])
def test_codes_are_those_of_the_definition(kind: str, reach: int) -> None:
    local = synthetic_scans.make_steps(kind, 4, 10 * BLOCK + 3, STEPS)
    expected = [
        int(normal_code(sums_of(local.astype(np.int64), at, reach**2))) for at in local.astype(np.int64)
    ]
    found = voxel_normals(local, reach**2)
    assert found.dtype == np.uint16
    assert found.tolist() == expected
    if kind in ("plane", "corner") and reach == 900:
        assert np.count_nonzero(found != NO_NORMAL) > len(local) / 2


# --- archives ---------------------------------------------------------------------------------------------

POINTS = synthetic_scans.make_scan("corner", 8, 150 if INTERPRETED else 300)


def build(folder: Path, points: NDArray[np.float64] = POINTS, name: str = "scan", **options: object) -> Path:
    """An archive of one scan with normals, small voxels."""
    scan = synthetic_scans.write_ply(folder / f"{name}.ply", points)
    options = {"keep": frozenset({"scan", "normal"}), "normal_reach": 0.3, "resolution": 1e-4, **options}
    target = folder / f"{name}.scd"
    small_builds.build([scan], target, **options)
    return target


def stored(archive: Path) -> dict[tuple[int, ...], int]:
    """The code stored for each lattice point."""
    found: dict[tuple[int, ...], int] = {}
    with Archive(archive) as opened:
        for row in range(len(opened.voxels)):
            voxel, links = opened.read_voxel(row)
            assert voxel.normal is not None
            corner = opened.coordinates[row] * opened.header.lattice.voxel_steps
            for place, code in zip(
                (voxel_points(voxel, links) + corner).tolist(), voxel.normal.tolist(), strict=True
            ):
                assert found.setdefault(tuple(place), code) == code
    return found


def expected(archive: Path) -> dict[tuple[int, ...], int]:
    """The code that each lattice point must have, by its voxel's points, in Python's integers."""
    found: dict[tuple[int, ...], int] = {}
    with Archive(archive) as opened:
        header = opened.header
        square = squared_reach(header.normal_reach, header.lattice.step, header.points)
        for row in range(len(opened.voxels)):
            points = voxel_points(*opened.read_voxel(row))
            corner = opened.coordinates[row] * header.lattice.voxel_steps
            for at in points:
                found[tuple((at + corner).tolist())] = int(normal_code(sums_of(points, at, square)))
    return found


@pytest.mark.parametrize("options", [{}, {"models": frozenset({"mean", "local"})}, {"cells": "balanced"}])
def test_an_archive_has_the_normals_of_its_points(tmp_path: Path, options: dict[str, object]) -> None:
    archive = build(tmp_path, **options)
    codes = stored(archive)
    assert codes == expected(archive)
    assert sum(code != NO_NORMAL for code in codes.values()) > len(POINTS) / 3
    with Archive(archive) as opened:
        assert opened.header.format_version == 4
        assert opened.header.normal_reach == opened.header.options["normal_reach"] == 0.3
        assert opened.header.scan_index and opened.header.radius_class == ("models" in options)
    report = verify_archive(archive, deep=True, exact=True)
    assert report.faults == ()
