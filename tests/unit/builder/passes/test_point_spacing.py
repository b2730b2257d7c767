"""An archive's mean closest-point distance is that of brute force: duplicates, voxel borders, far points, samples."""

import math
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import solidcloud.builder.passes.point_spacing as spacing
import solidcloud.builder.pipeline as pipeline
import solidcloud.builder.run.executor as executor_module
from solidcloud.builder.config import BuildConfig
from solidcloud.builder.kernels.neighbours.nearest_points import FAR, make_box_tree
from solidcloud.builder.kernels.points.voxel_records import point_hash
from solidcloud.builder.passes.point_spacing import (
    SUM_UNITS,
    PendingPoints,
    Sums,
    archive_mean,
    mean_of_squares,
    refine_closest,
    sums_of,
)
from solidcloud.builder.pipeline import build_archive
from solidcloud.builder.run.executor import Progress, Silent
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


class InTurn:
    """An executor of three jobs that are one, the last unit first; it counts what it is given."""

    jobs = 3

    def __init__(self) -> None:
        self.given: list[int] = []

    def map(
        self,
        function: Callable[[Any], Any],
        units: Sequence[Any],
        progress: Progress,
        size: Callable[[Any], int],
    ) -> Iterator[Any]:
        self.given.append(len(units))
        results = [function(unit) for unit in reversed(units)]
        for unit, result in zip(units, reversed(results), strict=True):
            progress.advance(size(unit))
            yield result


@pytest.mark.parametrize("sample", [10**6, 150])
def test_units_of_any_size_in_any_order_give_the_same_bits(
    sample: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    lattice = np.concatenate([lattice_of("corner", 400), [[9000, 0, 0]]])
    header = built_header(tmp_path, lattice, voxel=0.3)
    folder = tmp_path / "archive"
    expected = archive_mean(folder, sample)
    if sample > 401:
        assert expected.mean / 2 == header.radius and expected.sample == header.radius_sample
    monkeypatch.setattr(executor_module, "_MIN_POINTS", 1)
    advanced: list[int] = []

    class Counting(Silent):
        def advance(self, amount: int) -> None:
            advanced.append(amount)

    for batch in (1 << 17, 7):
        monkeypatch.setattr(spacing, "_BATCH", batch)
        executor = InTurn()
        assert archive_mean(folder, sample, executor, Counting()) == expected  # type: ignore[arg-type]
        assert executor.given[0] > 10 and max(executor.given[1:]) > (3 if batch > 7 else 1)
    assert sum(advanced) == 2 * 401


def test_each_voxel_is_opened_twice_where_neighbours_are_near(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """However many neighbours a voxel has: what is asked of it is asked together."""
    grid = np.stack(np.meshgrid(*[np.arange(12)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    built_header(tmp_path, grid * 50 + np.arange(len(grid))[:, None] % 7, voxel=0.2)
    opened: list[int] = []
    real = Archive.open_voxel

    def counting(self: Archive, row: int, **columns: Any) -> Any:
        opened.append(row)
        return real(self, row, **columns)

    monkeypatch.setattr(Archive, "open_voxel", counting)
    archive_mean(tmp_path / "archive", 10**6)
    times = np.bincount(opened)
    assert len(times) == 27 and times.max() == 2 and times.min() == 2


@pytest.mark.interpreted
def test_points_are_settled_nearest_boxes_first_until_none_can_be_nearer() -> None:
    """Boxes that hold one point, their low corner, which need not be near: in Python's integers."""
    rng = np.random.default_rng(8)
    low = rng.integers(-2000, 2000, (60, 3))
    high = low + rng.integers(0, 900, (60, 3))
    low[7] = high[7] = [1 << 40, 0, 0]
    own = np.arange(60) % 50
    queries = low[own] + rng.integers(0, 5, (60, 3))
    best = np.where(rng.random(60) < 0.5, FAR, rng.integers(1, 4_000_000, 60))
    asked: set[tuple[int, int]] = set()

    def ask(rows: np.ndarray, starts: np.ndarray, lattice: np.ndarray, known: np.ndarray) -> np.ndarray:
        assert (np.diff(rows) > 0).all() and starts[-1] == len(lattice) == len(known)
        target = np.repeat(rows, np.diff(starts))
        for row, point in zip(target.tolist(), lattice.tolist(), strict=True):
            pair = (row, queries.tolist().index(point))
            assert pair not in asked and own[pair[1]] != row
            asked.add(pair)
        return np.minimum(known, ((lattice - low[target]) ** 2).sum(axis=1))

    expected = best.tolist()
    for i, point in enumerate(queries.tolist()):
        for row in set(range(60)) - {int(own[i])}:
            d2 = sum((a - b) ** 2 for a, b in zip(point, low[row].tolist(), strict=True))
            expected[i] = min(expected[i], d2 if d2 < FAR else int(FAR))
    left = PendingPoints(queries, own, best)
    refine_closest(left, make_box_tree(low, high), ask)
    assert left.best.tolist() == expected
    assert expected[7] == FAR and len(asked) < 60 * 30


@pytest.mark.interpreted
def test_sums_are_exact_however_long_distances_are() -> None:
    rng = np.random.default_rng(9)
    best = np.concatenate([rng.integers(1, 1 << 20, 1000), rng.integers(1, int(FAR), 30), [FAR, FAR]])
    for some in (best, best[:1000], best[:1], best[-2:], best[:0]):
        for step in (1e-6, 0.0001, 1.0):
            each = [round(math.sqrt(d) * (step * SUM_UNITS)) for d in some.tolist() if d < FAR]
            assert sums_of(some, step) == Sums(sum(each), sum(d * d for d in each), len(each))


@pytest.mark.parametrize("lattice", [[[1, 2, 3]], [[1, 2, 3]] * 70])
def test_a_single_place_has_no_closest_other(lattice: list[list[int]], tmp_path: Path) -> None:
    built_header(tmp_path, np.array(lattice), radius=0.5)
    assert archive_mean(tmp_path / "archive", 10**6) == (0.0, 0.0, 0)


def test_sums_give_mean_and_standard_error() -> None:
    values = [0.25, 0.5, 1.0, 4.0]
    units = [int(v * SUM_UNITS) for v in values]
    found = mean_of_squares(sum(units), sum(u * u for u in units), 4, everything=False)
    assert found.mean == np.mean(values)
    assert found.error == pytest.approx(np.std(values, ddof=1) / 2)
    assert mean_of_squares(sum(units), 0, 4, everything=True).error == 0
    assert mean_of_squares(0, 0, 0, everything=True) == (0, 0, 0)
    assert mean_of_squares(units[0], units[0] ** 2, 1, everything=False).error == 0
