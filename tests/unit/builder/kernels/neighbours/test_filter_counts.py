"""Compare the kernels of the filters with all pairs in plain integers."""

import itertools
import math

import numpy as np
import pytest
from solidcloud.builder.kernels.neighbours.filter_counts import (
    _group_in_reach,
    _no_runs,
    _runs_around,
    best_of_cells,
    cell_numbers,
    count_others,
    other_scans,
)

pytestmark = pytest.mark.interpreted

EDGE = 4
# Squares of reaches whose whole steps are the cells' edge.
REACHES = [16, 17, 24]


def grid_of(positions: np.ndarray, edge: int = EDGE) -> tuple[int, int]:
    """Cells along y and z, two more than any position needs."""
    return tuple((positions[:, 1:].max(axis=0) // edge + 3).tolist())


def numbers_of(positions: np.ndarray, grid: tuple[int, int], edge: int = EDGE) -> np.ndarray:
    """The cells of positions, in numpy's integers."""
    x, y, z = (positions.astype(np.int64) // edge + 1).T
    return ((x * grid[0] + y) * grid[1] + z).astype(np.uint64)


def squares(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Squared distances of each of a from each of b."""
    return ((a[:, None].astype(np.int64) - b) ** 2).sum(axis=2)


def cloud(rng: np.random.Generator, n: int, wide: int = 18) -> np.ndarray:
    """Positions of a few cells an axis, a different number on each."""
    return rng.integers(0, [wide, wide + 5, wide - 6], (n, 3)).astype(np.int32)


@pytest.mark.parametrize("edge", [1, 2, 7, 1 << 20])
def test_cells_are_numbered_so_that_all_have_neighbours(edge: int) -> None:
    rng = np.random.default_rng(edge)
    at = rng.integers(0, 5, (60, 3)) * edge + rng.choice([0, edge - 1], (60, 3))
    grid = grid_of(at, edge)
    found = cell_numbers(at.astype(np.int32), edge, *grid)
    assert found.tolist() == numbers_of(at, grid, edge).tolist()
    # No number around a cell is another's.
    around = {
        tuple(cell + shift): int(number) + int(shift @ [grid[0] * grid[1], grid[1], 1])
        for cell, number in zip(at // edge, found, strict=True)
        for shift in np.array(list(itertools.product((-1, 0, 1), repeat=3)))
    }
    assert len(set(around.values())) == len(around) and min(around.values()) >= 0


def test_the_runs_around_a_cell_are_of_three_cells_each_its_own_first() -> None:
    rng = np.random.default_rng(1)
    at = cloud(rng, 90)
    grid = grid_of(at)
    cells = np.sort(numbers_of(at, grid))
    runs = _no_runs()
    for cell in rng.permuted(cells):
        _runs_around(cells, cell, *grid, runs)
        middles = [int(cell) + (dx * grid[0] + dy) * grid[1] for dx in (-1, 0, 1) for dy in (-1, 0, 1)]
        expected = [
            [int(np.searchsorted(cells, np.uint64(middle + by))) for by in (-1, 2)] for middle in middles
        ]
        found = np.column_stack(runs[1:]).tolist()
        assert runs[0][0] == cell and found[0] == expected[4] and sorted(found) == sorted(expected)


@pytest.mark.parametrize("reach2", REACHES)
@pytest.mark.parametrize("most", [1, 4, 1000])
def test_others_are_counted_as_every_pair_says(reach2: int, most: int) -> None:
    rng = np.random.default_rng([reach2, most])
    points = np.unique(cloud(rng, 250), axis=0)
    queries = np.concatenate([points[::3], cloud(rng, 60), points[:4], points[:4]])
    grid = grid_of(np.concatenate([points, queries]))
    points = points[np.argsort(numbers_of(points, grid), kind="stable")]
    before = rng.integers(0, 7, len(queries))
    counts = before.copy()
    cells, query_cells = numbers_of(points, grid), numbers_of(queries, grid)
    count_others(queries, query_cells, points, cells, *grid, reach2, most, counts)
    d2 = squares(queries, points)
    all_of = before + ((d2 > 0) & (d2 <= reach2)).sum(axis=1)
    assert counts.tolist() == np.where(before >= most, before, np.minimum(all_of, most)).tolist()
    assert ((d2 == reach2) | (d2 == reach2 + 1)).any()


@pytest.mark.parametrize("reach2", [EDGE**2, 3 * EDGE**2, 1 << 40])
def test_points_are_looked_for_in_all_cells_around_and_none_beyond(reach2: int) -> None:
    """One point in each of 125 cells, and a query there: what is not in a cell around counts nothing, however near."""
    points = np.array(list(itertools.product(range(5), repeat=3)), np.int32) * EDGE
    grid, counts = grid_of(points), np.zeros(125, np.int64)
    cells = numbers_of(points, grid)
    count_others(points, cells, points, cells, *grid, reach2, 99, counts)
    d2 = squares(points, points)
    around = (np.abs(points[:, None] - points).max(axis=2) <= EDGE) & (d2 > 0)
    assert counts.tolist() == (around & (d2 <= reach2)).sum(axis=1).tolist()


@pytest.mark.parametrize("reach2", REACHES)
@pytest.mark.parametrize("most", [1, 3, 12])
def test_other_scans_are_found_as_every_pair_says(reach2: int, most: int) -> None:
    rng = np.random.default_rng([reach2, most])
    points, scans = cloud(rng, 120), rng.integers(0, 9, 120)
    queries = np.concatenate([points[:50], cloud(rng, 40)])
    query_scans = np.concatenate([scans[:50], rng.integers(0, 9, 40)])
    grid = grid_of(np.concatenate([points, queries]))
    cells = numbers_of(points, grid)
    order = np.lexsort((scans, cells))
    points, scans, cells = points[order], scans[order], cells[order]
    firsts = np.flatnonzero(np.r_[True, (np.diff(cells) != 0) | (np.diff(scans) != 0)])
    counts = rng.integers(0, min(most, 2) + 1, len(queries))
    known = rng.permuted(np.tile(np.arange(12), (len(queries), 1)), axis=1)[:, :most]
    found, before = np.where(np.arange(most) < counts[:, None], known, -7), counts.copy()
    other_scans(
        queries, numbers_of(queries, grid), query_scans, points, np.append(firsts, len(points)),
        cells[firsts], scans[firsts], *grid, reach2, found, counts,
    )  # fmt: skip
    near = squares(queries, points) <= reach2
    short = 0
    for i in range(len(queries)):
        had = known[i, : before[i]].tolist()
        there = set(scans[near[i]].tolist()) - {int(query_scans[i])} - set(had)
        new = found[i, before[i] : counts[i]].tolist()
        assert found[i, : before[i]].tolist() == had and (found[i, counts[i] :] == -7).all()
        assert len(set(new)) == len(new) == min(len(there), most - before[i]) and set(new) <= there
        short += len(there) > most - before[i]
    assert short if most < 12 else not short


def test_a_group_is_judged_by_its_box_where_that_says_it() -> None:
    """The box is not that of the points: so what was looked at is told from what was not."""
    rng = np.random.default_rng(3)
    told = {"outside": 0, "inside": 0, "looked": 0}
    for _ in range(400):
        points = rng.integers(0, 12, (4, 3)).astype(np.int32)
        low, high = np.sort(rng.integers(0, 12, (2, 3)), axis=0).astype(np.int32)
        query = rng.integers(0, 12, 3)
        corners = np.array(list(itertools.product(*zip(low.tolist(), high.tolist(), strict=True))))
        inside = np.clip(query, low, high)
        least, most = int(((query - inside) ** 2).sum()), int(squares(query[None], corners).max())
        reach2 = int(rng.choice([least - 1, least, most - 1, most, 30]))
        begin, end = sorted(rng.integers(0, 5, 2).tolist())
        near = bool((squares(query[None], points[begin:end]) <= reach2).any())
        case = "outside" if least > reach2 else "inside" if most <= reach2 else "looked"
        told[case] += 1
        found = _group_in_reach(points, begin, end, low, high, *query, reach2)
        assert found == {"outside": False, "inside": True, "looked": near}[case]
    assert min(told.values()) > 50


@pytest.mark.parametrize("values", [1, 2, 4])
def test_the_best_of_a_cell_is_the_least_of_all_it_is_judged_by(values: int) -> None:
    """Of few values, so that the first columns tie; of equal points the first in the order given."""
    rng = np.random.default_rng(values)
    for n in (1, 2, 90):
        cells = rng.integers(0, 8, n).astype(np.uint64)
        away, ranks, scans = (rng.integers(0, values, n) for _ in range(3))
        intensities = rng.choice(np.array([0.5, 1.5, np.nan], np.float32), n)
        looks = rng.integers(0, values, n).astype(np.uint32)
        shuffled = rng.permutation(n)
        order = shuffled[np.argsort(cells[shuffled], kind="stable")]
        best = best_of_cells(order, cells, away, ranks.astype(np.uint64), scans, intensities, looks)

        def merit(at: int) -> tuple:
            bright = float(intensities[order[at]])  # noqa: B023
            lack = math.isnan(bright)
            i = order[at]  # noqa: B023
            return (away[i], ranks[i], scans[i], lack, 0.0 if lack else bright, looks[i], at)  # noqa: B023

        expected = [
            int(order[min(np.flatnonzero(cells[order] == cell).tolist(), key=merit)])
            for cell in np.unique(cells)
        ]
        assert best.tolist() == expected
