"""The mean closest-point distance equals brute force: duplicates, voxel borders, far points, samples, avatars."""

import math
from pathlib import Path

import numpy as np
import pytest
import solidcloud.builder.pipeline as pipeline
from scans import make_scan, make_steps, write_xyz
from solidcloud.builder.config import BuildConfig
from solidcloud.builder.kernels.nearest import FAR, SearchTree, box_distance2, closest_other
from solidcloud.builder.octree import VoxelPoints, build_voxel
from solidcloud.builder.pipeline import build_archive
from solidcloud.builder.radius import (
    SUM_UNITS,
    build_local,
    mean_closest_distance,
    mean_of_squares,
    sample_mask,
    search_tree,
    voxel_points,
)
from solidcloud.schemas.archive import Archive
from solidcloud.schemas.index import Header
from solidcloud.schemas.voxel import check_voxel

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


@pytest.mark.parametrize("kind", ["plane", "corner", "pillar", "noise", "duplicates"])
@pytest.mark.parametrize("voxel", [0.3, 8.0])
def test_the_archives_radius_equals_brute_force(kind: str, voxel: float, tmp_path: Path) -> None:
    lattice = lattice_of(kind)
    header = built_header(tmp_path, lattice, voxel=voxel)
    distinct, closest = brute_distances(lattice)
    assert header.radius == pytest.approx(closest.mean() * STEP / 2, abs=SUM_ROUNDING)
    assert header.radius_sample == len(distinct)
    assert header.radius_error == 0
    assert header.radius_model == "mean"


def test_neighbours_are_found_across_voxel_borders(tmp_path: Path) -> None:
    # Pairs 2 steps apart on either side of each border of a voxel of 100 steps; partners far inside theirs.
    pairs = [[100 * i - 1 + 2 * side, 50, 50] for i in range(1, 6) for side in (0, 1)]
    lattice = np.array([[0, 0, 0], *pairs])
    header = built_header(tmp_path, lattice, voxel=0.1)
    assert header.radius == pytest.approx(brute_distances(lattice)[1].mean() * STEP / 2, abs=SUM_ROUNDING)


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
    chosen = sample_mask(distinct, 100 / len(lattice))
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


@pytest.mark.interpreted
def test_a_sample_is_about_its_share_and_grows_with_it() -> None:
    lattice = np.random.default_rng(1).integers(-(2**40), 2**40, (20_000, 3))
    small, large = sample_mask(lattice, 0.1), sample_mask(lattice, 0.5)
    assert abs(small.mean() - 0.1) < 0.01
    assert abs(large.mean() - 0.5) < 0.02
    assert not (small & ~large).any()
    assert sample_mask(lattice, 1.0).all()
    assert np.array_equal(sample_mask(lattice[::-1], 0.1)[::-1], small)


def test_sums_give_mean_and_standard_error() -> None:
    values = [0.25, 0.5, 1.0, 4.0]
    units = [int(v * SUM_UNITS) for v in values]
    found = mean_of_squares(sum(units), sum(u * u for u in units), 4, everything=False)
    assert found.mean == np.mean(values)
    assert found.error == pytest.approx(np.std(values, ddof=1) / 2)
    assert mean_of_squares(sum(units), 0, 4, everything=True).error == 0
    assert mean_of_squares(0, 0, 0, everything=True) == (0, 0, 0)
    assert mean_of_squares(units[0], units[0] ** 2, 1, everything=False).error == 0


def voxel_tree(kind: str, steps: int) -> tuple[SearchTree, np.ndarray]:
    """A voxel's search tree, and its points as they were given."""
    points = make_steps(kind, 2, 200, steps)
    config = BuildConfig(cell_points=40, leaf=8, degree=3)
    voxel = build_voxel(1, VoxelPoints(points), steps, config)
    return search_tree(voxel, check_voxel(voxel, steps)), points.astype(np.int64)


@pytest.mark.interpreted
@pytest.mark.parametrize("kind", ["plane", "noise", "duplicates"])
@pytest.mark.parametrize("steps", [1000, 200_000])
def test_closest_other_equals_brute_force(kind: str, steps: int) -> None:
    tree, points = voxel_tree(kind, steps)
    rng = np.random.default_rng(3)
    queries = np.concatenate([np.unique(points, axis=0)[:60], rng.integers(-steps, 2 * steps, (30, 3))])
    best = np.full(len(queries), FAR)
    closest_other(tree, queries, best)
    d2 = ((queries[:, None] - points) ** 2).sum(axis=2)
    assert np.array_equal(best, np.where(d2 > 0, d2, FAR).min(axis=1))
    # What is known before is never raised, and keeps what is farther out.
    known = best // 2
    closest_other(tree, queries, known)
    assert np.array_equal(known, best // 2)


@pytest.mark.interpreted
def test_points_of_a_voxel_come_back_in_stored_order() -> None:
    points = make_steps("corner", 2, 200, 1000)
    voxel = build_voxel(
        1, VoxelPoints(points, points[:, 2].astype(np.uint16)), 1000, BuildConfig(cell_points=20)
    )
    found = voxel_points(voxel, check_voxel(voxel, 1000))
    assert sorted(found.tolist()) == sorted(points.tolist())
    assert np.array_equal(found[:, 2], voxel.scan_index)


@pytest.mark.interpreted
def test_box_distance_is_to_the_nearest_corner_edge_or_face() -> None:
    low, high = np.array([0, 0, 0]), np.array([10, 20, 30])
    queries = np.array([[5, 5, 5], [0, 20, 30], [-3, 5, 5], [13, 24, 5], [-1, -2, 32]])
    out = np.empty(len(queries), np.int64)
    box_distance2(queries, low, high, out)
    assert out.tolist() == [0, 0, 9, 25, 9]


@pytest.mark.interpreted
@pytest.mark.parametrize("kind", ["plane", "pillar", "noise", "duplicates"])
def test_an_avatars_mean_equals_brute_force(kind: str) -> None:
    points = make_scan(kind, 8, 200) - 1.0
    local = build_local(points, leaf=8, degree=4)
    distinct = np.unique(points, axis=0)
    apart = np.sqrt(((distinct[:, None] - distinct) ** 2).sum(axis=2)) + np.where(
        np.eye(len(distinct)), np.inf, 0
    )
    # A point and its neighbour are each less than sqrt(3) steps from their lattice points.
    assert abs(mean_closest_distance(local) - apart.min(axis=1).mean()) <= 2 * math.sqrt(3) * local.step
    world = local.low + local.hierarchy.points * local.step
    assert (world <= points[local.hierarchy.tree.order]).all()
    assert (points[local.hierarchy.tree.order] - world < 2 * local.step).all()


@pytest.mark.interpreted
@pytest.mark.parametrize("points", [[[1.0, 2, 3]], [[1.0, 2, 3]] * 50])
def test_an_avatar_of_one_distinct_point_has_no_mean(points: list[list[float]]) -> None:
    assert mean_closest_distance(build_local(np.array(points), leaf=32, degree=8)) == 0


@pytest.mark.parametrize("extent", [1e-9, 1.0, 4.0, 4.1, 1e9])
def test_an_avatar_of_any_extent_fits_its_lattice(extent: float) -> None:
    points = np.array([[0.0, 0, 0], [extent, 0, 0], [0, extent / 3, 0]])
    local = build_local(points, leaf=2, degree=2)
    assert 0 <= local.hierarchy.points.min() <= local.hierarchy.points.max() <= 1 << 23
    assert math.log2(local.step).is_integer()
