"""Compare the hierarchies of many cells made in one call with those of each cell."""

import itertools

import numpy as np
import pytest
from solidcloud.builder.config import BuildConfig
from solidcloud.builder.kernels.trees.build_tree import DIRECTIONS, EXTREMES
from solidcloud.builder.voxel.point_hierarchy import build_hierarchy
from solidcloud.builder.voxel.voxel_octree import CellTrees, block_points, build_trees, leaf_runs, take_cells
from synthetic_scans import make_steps

pytestmark = pytest.mark.interpreted

CONFIG = BuildConfig(leaf=8, degree=3)
LOW = np.array([[0, 0, 0], [1024, 0, 2048], [65536, 131072, 0], [7, 7, 7]])
LOG2 = np.array([10, 10, 16, 0], np.uint8)


def cells(with_slab: bool = True) -> tuple[list[np.ndarray], CellTrees]:
    """The points of four cells, from their corners, and their trees."""
    points = [
        make_steps("noise", 1, 70, 1024),
        make_steps("plane", 2, 9, 1024),
        make_steps("corner", 3, 100, 65536),
        np.zeros((20, 3), np.int64),
    ]
    local = np.concatenate([p + low for p, low in zip(points, LOW, strict=True)]).astype(np.int32)
    starts = np.cumsum([0, *map(len, points)])
    config = BuildConfig(leaf=8, degree=3, with_slab=with_slab)
    return points, build_trees(local, starts[:-1], LOG2, config)


@pytest.mark.parametrize("with_slab", [True, False])
def test_cells_have_the_trees_of_their_points(with_slab: bool) -> None:
    points, trees = cells(with_slab)
    assert np.array_equal(trees.low, LOW)
    for cell, own in enumerate(points):
        expected = build_hierarchy(own.astype(np.int32), leaf=8, degree=3, with_slab=with_slab)
        a, b = trees.starts[cell : cell + 2]
        of = slice(*trees.rows[cell : cell + 2])
        assert np.array_equal(trees.xyz[:, a:b].T, expected.points)
        assert np.array_equal(trees.rank[a:b] - a, expected.tree.order)
        columns = (*expected.bounds, expected.tree.count, expected.axis, expected.block_low)
        for found, column in zip(trees.nodes, columns, strict=True):
            assert found[of].tolist() == column.tolist()


def test_extremes_and_spreads_are_those_of_the_points() -> None:
    points, trees = cells()
    for cell, own in enumerate(points):
        there = own + LOW[cell]
        assert trees.extremes.shape[1:] == (EXTREMES, 3)
        for d, direction in enumerate(DIRECTIONS):
            for side, edge in enumerate((np.min, np.max)):
                found = trees.extremes[cell, 2 * d + side]
                assert found @ direction == edge(there @ direction)
                assert (there == found).all(axis=1).any()
        off = there - there.mean(axis=0)
        expected = [len(own), *there.mean(axis=0), *(off.T @ off)[np.triu_indices(3)]]
        assert np.allclose(trees.spreads[cell], expected, rtol=1e-9, atol=1e-6)


def test_extremes_are_along_the_axes_and_the_diagonals_of_a_cube() -> None:
    """Each line once, whichever way it points."""
    lines = [line for line in itertools.product((-1, 0, 1), repeat=3) if sum(map(abs, line)) in (1, 3)]
    both_ways = [tuple(way * v for v in line) for line in DIRECTIONS.tolist() for way in (-1, 1)]
    assert sorted(both_ways) == sorted(lines)


def test_cells_are_taken_in_another_order() -> None:
    points, trees = cells()
    order = np.array([2, 0, 3, 1])
    taken = take_cells(trees, order)
    assert np.array_equal(taken.low, LOW[order])
    assert np.diff(taken.starts).tolist() == [len(points[cell]) for cell in order]
    for at, cell in enumerate(order):
        was, now = (slice(*t.starts[i : i + 2]) for t, i in ((trees, cell), (taken, at)))
        assert np.array_equal(taken.xyz[:, now], trees.xyz[:, was])
        assert np.array_equal(taken.rank[now], trees.rank[was])
        was, now = (slice(*t.rows[i : i + 2]) for t, i in ((trees, cell), (taken, at)))
        for a, b in zip(taken.nodes, trees.nodes, strict=True):
            assert np.array_equal(a[now], b[was])
    # From the corners of their blocks the points are what they were.
    first, count, axis = leaf_runs(taken, 8)
    assert count.sum() == len(taken.rank) and first[0] == 0 and (np.diff(first) == count[:-1]).all()
    block = block_points(taken, 8)
    leaf_of_cell = -(-np.diff(taken.starts) // 8)
    rows = np.concatenate([np.arange(b - n, b) for b, n in zip(taken.rows[1:], leaf_of_cell, strict=True)])
    low = np.repeat(taken.nodes.block_low[rows], count, axis=0)
    assert np.array_equal(block + low, taken.xyz.T)
    for a, n, k in zip(first, count, axis, strict=True):
        assert (np.diff(block[a : a + n, k].astype(int)) >= 0).all() and not block[a : a + n].min(
            axis=0
        ).any()
