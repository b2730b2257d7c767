"""An archive's mean closest-point distance is that of brute force: duplicates, voxel borders, far points, samples."""

import math
from pathlib import Path

import numpy as np
import pytest
import solidcloud.builder.pipeline as pipeline
from solidcloud.builder.config import BuildConfig
from solidcloud.builder.kernels.points.voxel_records import point_hash
from solidcloud.builder.passes.point_spacing import SUM_UNITS, archive_mean
from solidcloud.builder.pipeline import build_archive
from solidcloud.schemas.archive.archive import Archive
from solidcloud.schemas.archive.index import Header
from synthetic_scans import make_steps, write_xyz

STEP = 0.001

# Distances are summed as integers of 2^-32 m, so each is off by half of that at most; a radius by half of that again.
SUM_ROUNDING = 0.25 / SUM_UNITS + 1e-15


def brute_distances(lattice: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distinct points (n, 3), and the distance [steps] of each to the closest other one."""
    distinct = np.unique(lattice, axis=0)
    closest = np.empty(len(distinct))
    for i, point in enumerate(distinct):
        d2 = ((distinct - point) ** 2).sum(axis=1)
        d2[i] = np.iinfo(np.int64).max
        closest[i] = math.sqrt(d2.min())
    return distinct, closest


def built_header(folder: Path, lattice: np.ndarray, **options: object) -> Header:
    """The header of the archive of lattice points (n, 3), the least coordinate on each axis 0."""
    write_xyz(folder / "a.xyz", lattice * STEP)
    config = BuildConfig(
        **{"resolution": STEP, "jobs": 1, "cell_points": 40, "leaf": 8, "overwrite": True, **options}
    )
    build_archive([folder / "a.xyz"], folder / "archive", config)
    with Archive(folder / "archive") as archive:
        return archive.header


def lattice_of(kind: str, count: int = 300) -> np.ndarray:
    """A scan as lattice integers with the least coordinate of each axis 0."""
    steps = make_steps(kind, 6, count, 2000).astype(np.int64)
    return steps - steps.min(axis=0)


@pytest.mark.parametrize("kind", ["corner", "duplicates"])
@pytest.mark.parametrize("voxel", [0.3, 8.0])
def test_the_archives_radius_equals_brute_force(kind: str, voxel: float, tmp_path: Path) -> None:
    lattice = lattice_of(kind)
    header = built_header(tmp_path, lattice, voxel=voxel)
    distinct, closest = brute_distances(lattice)
    assert header.radius == pytest.approx(closest.mean() * STEP / 2, abs=SUM_ROUNDING)
    assert header.radius_sample == len(distinct)
    assert header.radius_error == 0
    assert header.radius_model == "mean"


def test_far_isolated_points_find_their_neighbour(tmp_path: Path) -> None:
    lattice = np.concatenate(
        [lattice_of("plane", 60), [[50_000, 0, 0], [50_000, 900_000, 7], [0, 0, 4_000_000]]]
    )
    for voxel in (2.0, 8.0):
        header = built_header(tmp_path, lattice, voxel=voxel)
        assert header.radius == pytest.approx(brute_distances(lattice)[1].mean() * STEP / 2, abs=SUM_ROUNDING)


def test_a_sample_depends_on_coordinates_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pipeline, "RADIUS_SAMPLE", 100)
    lattice = lattice_of("corner", 400)
    distinct, closest = brute_distances(lattice)
    limit = int(100 / len(lattice) * 2.0**64)
    chosen = np.array([int(point_hash(*point)) < limit for point in distinct])
    assert 60 < chosen.sum() < 140
    found = set()
    for voxel in (0.3, 0.7, 8.0):
        header = built_header(tmp_path, lattice, voxel=voxel)
        assert header.radius_sample == chosen.sum()
        assert header.radius == pytest.approx(closest[chosen].mean() * STEP / 2, abs=SUM_ROUNDING)
        error = closest[chosen].std(ddof=1) / math.sqrt(chosen.sum()) * STEP / 2
        assert header.radius_error == pytest.approx(error, rel=1e-6)
        found.add((header.radius, header.radius_error))
    assert len(found) == 1


@pytest.mark.parametrize("lattice", [[[1, 2, 3]], [[1, 2, 3]] * 70])
def test_a_single_place_has_no_closest_other(lattice: list[list[int]], tmp_path: Path) -> None:
    built_header(tmp_path, np.array(lattice), radius=0.5)
    assert archive_mean(tmp_path / "archive", 10**6) == (0.0, 0.0, 0)
