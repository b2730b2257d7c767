"""Compare the hierarchies of many cells made in one call with those of each cell; test the top's bounds."""

import itertools

import numpy as np
import pytest
from solidcloud.builder.config import BuildConfig
from solidcloud.builder.kernels.trees.build_tree import (
    DIRECTIONS,
    EXTREMES,
    _join_extremes,
    _stored_center,
    copy_runs,
    enlarge_bounds,
    leaf_rows,
)
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


def grown(
    points: list[np.ndarray], low: np.ndarray, boxes: np.ndarray, center: np.ndarray, normal: np.ndarray,
    unit: int, reach2: int, slab: list[int],
) -> tuple[int, list[int]]:  # fmt: skip
    """What `enlarge_bounds` makes of one node's bounds over some cells with these points, from their corners."""
    starts = np.cumsum([0, *map(len, points)])
    xyz = np.concatenate(points).T.astype(np.uint16)
    new_reach2, new_slab = np.array([reach2]), np.array([slab])
    above = np.zeros((1, len(points)), np.int64)
    enlarge_bounds(xyz, starts, low, boxes, above, center[None], normal[None], unit, new_reach2, new_slab)
    return int(new_reach2[0]), new_slab[0].tolist()


def bounds(points: np.ndarray, about: np.ndarray, normal: np.ndarray) -> tuple[int, int, int]:
    """The greatest squared distance of points from a place, least and greatest extent along a normal."""
    apart = (points - about).astype(object)
    along = (apart * normal.astype(object)).sum(axis=1)
    return max((apart * apart).sum(axis=1)), min(along), max(along)


@pytest.mark.parametrize("unit", [1, 4])
def test_a_bound_grows_by_the_points_of_the_cells_whose_box_leaves_it(unit: int) -> None:
    """Of many nodes, their bounds about as far as the box, or a step to either side of it."""
    rng = np.random.default_rng(unit)
    looked = [0, 0]
    for _ in range(300):
        low, center = rng.integers(0, 3000, (1, 3)), rng.integers(0, 3000 // unit, 3)
        normal = rng.integers(-127, 128, 3) * (rng.random(3) < 0.7)
        points = rng.integers(0, 1000, (5, 3))
        # The box is not that of the points: so what was looked into is told from what was not.
        edges = np.sort(rng.integers(0, 4000, (2, 3)), axis=0)
        corners = np.array(list(itertools.product(*edges.T)))
        far2, least, most = bounds(corners, center * unit, normal)
        reach2 = far2 + int(rng.integers(-1, 2))
        slab = [least + int(rng.integers(-1, 2)), most + int(rng.integers(-1, 2))]
        of_points = bounds(points + low, center * unit, normal)
        expected = max(reach2, of_points[0]) if far2 > reach2 else reach2
        wide = slab
        if least < slab[0] or most > slab[1]:
            wide = [min(slab[0], of_points[1]), max(slab[1], of_points[2])]
        found = grown([points], low, edges[None], center, normal, unit, reach2, slab)
        assert found == (expected, wide)
        looked = [looked[0] + (expected != reach2), looked[1] + (wide != slab)]
    assert min(looked) > 20


def test_cells_of_one_point_are_held_to_the_step() -> None:
    """The box of one point is the point: a bound that it leaves by one step grows by that step."""
    point, about = np.array([[10, 20, 30]]), np.array([4, 4, 4])
    place, normal = point + 100, np.array([1, 0, -1])
    reach2, least, most = bounds(place, about, normal)
    box = np.stack([place, place], axis=1)
    low = np.array([[100, 100, 100]])
    for short in ((1, 0, 0), (0, 1, 0), (0, 0, 1), (0, 0, 0)):
        before = reach2 - short[0], [least + short[1], most - short[2]]
        if short[1] or short[2]:
            before[1][1 if short[1] else 0] = most + 5 if short[1] else least - 5
        after = grown([point], low, box, about, normal, 1, *before)
        assert after == (reach2, [min(before[1][0], least), max(before[1][1], most)])


def test_each_levels_node_above_a_cell_grows() -> None:
    points = np.array([[1, 2, 3], [50, 1, 9], [7, 7, 60000]], np.int64)
    low = np.array([[0, 0, 0], [70000, 0, 0], [0, 70000, 0]])
    place = points + low
    above = np.array([[0, 0, 0], [1, 2, 1]])
    center = np.array([[500, 0, 0], [0, 1, 0], [9, 9, 9]])
    normal = np.array([[1, 2, 3], [0, 0, 127], [1, -1, 0]])
    reach2, slab = np.zeros(3, np.int64), np.zeros((3, 2), np.int64)
    boxes = np.stack([place, place], axis=1)
    xyz = points.T.astype(np.uint16)
    enlarge_bounds(xyz, np.arange(4), low, boxes, above, center, normal, 1, reach2, slab)
    for node in range(3):
        own = bounds(place[(above == node).any(axis=0)], center[node], normal[node])
        assert (reach2[node], *slab[node]) == (own[0], min(own[1], 0), max(own[2], 0))


def test_a_stored_centre_is_the_nearest_there_is() -> None:
    center = np.empty(3, np.int64)
    for guess, unit, expected in (
        ([0.0, 0.4, 0.6], 1, [0, 0, 1]),
        ([-3.0, 99.7, 1000.0], 1, [0, 100, 100]),
        ([5.9, 6.1, 404.0], 4, [1, 2, 100]),
    ):
        _stored_center(np.array(guess), unit, 100, center)
        assert center.tolist() == expected


@pytest.mark.parametrize(("first", "count"), [(0, 1), (2, 1), (1, 4), (0, 6)])
def test_the_extremes_of_many_are_the_first_of_those_that_reach_farthest(first: int, count: int) -> None:
    """Points on a few places, so that many tie. What is least of a row is not asked whether it is greatest."""
    rng = np.random.default_rng([first, count])
    extremes = rng.integers(-2, 3, (6, EXTREMES, 3)).astype(np.int32)
    found = np.full((EXTREMES, 3), 99, np.int32)
    _join_extremes(extremes, first, count, found)
    for d, direction in enumerate(DIRECTIONS):
        least, most = (extremes[first : first + count, 2 * d + side] for side in range(2))
        assert found[2 * d].tolist() == least[(least @ direction).argmin()].tolist()
        assert found[2 * d + 1].tolist() == most[(most @ direction).argmax()].tolist()


def test_points_are_written_from_the_corners_of_their_leaf_nodes() -> None:
    """Cells of one to three leaf nodes among rows of inner ones, the rows after the last cell's among them."""
    rng = np.random.default_rng(4)
    count = np.array([3, 2, 1, 9, 4, 4, 4, 9, 5, 9], np.uint8)
    first_leaf, leaves = np.array([0, 4, 8]), [3, 3, 1]
    block_low = rng.integers(0, 50, (10, 3)).astype(np.uint16)
    held = [int(count[a : a + n].sum()) for a, n in zip(first_leaf, leaves, strict=True)]
    starts = np.cumsum([0, *held])
    nodes = np.concatenate(
        [np.repeat(np.arange(a, a + n), count[a : a + n]) for a, n in zip(first_leaf, leaves, strict=True)]
    )
    xyz = (rng.integers(0, 9, (starts[-1], 3)) + block_low[nodes]).T.astype(np.uint16)
    points = np.full((starts[-1], 3), 777, np.uint16)
    leaf_rows(xyz, starts, first_leaf, count, block_low, points)
    assert np.array_equal(points, xyz.T - block_low[nodes])


@pytest.mark.parametrize("width", [1, 3])
def test_runs_are_taken_in_the_order_chosen(width: int) -> None:
    starts = np.array([0, 2, 2, 7, 8])
    values = np.arange(8 * width).reshape(width, 8)
    for chosen in ([3, 0, 2, 1], [2], [], [1, 1], [0, 0, 3]):
        expected = [values[:, starts[i] : starts[i + 1]] for i in chosen]
        taken = np.full((width, sum(part.shape[1] for part in expected)), -1)
        copy_runs(values, starts, np.array(chosen, np.int64), taken)
        assert np.array_equal(taken, np.concatenate([values[:, :0], *expected], axis=1))
