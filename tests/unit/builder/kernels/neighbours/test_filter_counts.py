"""Compare the kernels of the filters with all pairs in plain integers."""

import numpy as np
import pytest
from solidcloud.builder.kernels.neighbours.filter_counts import (
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
