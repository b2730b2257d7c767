"""Compare the hierarchies of many cells made in one call with those of each; test how the top's bounds grow."""

import itertools

import numpy as np
import pytest
from point_hierarchy import Hierarchy, build_hierarchy
from solidcloud.builder.config import BuildConfig
from solidcloud.builder.kernels.trees.build_tree import enlarge_bounds
from solidcloud.builder.voxel.voxel_octree import CellTrees, build_trees
from synthetic_scans import WITH_POINTS, make_steps

pytestmark = pytest.mark.interpreted

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


def loose_nodes(hierarchy: Hierarchy) -> list[int]:
    """Nodes that do not enclose their points, judged with Python integers."""
    tree, bounds, loose = hierarchy.tree, hierarchy.bounds, []
    for node in range(len(tree.begin)):
        points = hierarchy.points[tree.begin[node] : tree.end[node]].astype(object)
        apart = points - bounds.center[node].astype(object)
        normal = bounds.normal[node].astype(object)
        along = (apart * normal).sum(axis=1)
        if (
            max((apart * apart).sum(axis=1)) > int(bounds.radius[node]) ** 2
            or int(bounds.slab[node, 0]) > min(along)
            or max(along) > int(bounds.slab[node, 1])
        ):
            loose.append(node)
    return loose


@pytest.mark.parametrize("kind", WITH_POINTS)
@pytest.mark.parametrize(("leaf", "degree", "with_slab"), [(32, 8, True), (4, 2, True), (8, 3, False)])
def test_every_node_encloses_its_points(kind: str, leaf: int, degree: int, with_slab: bool) -> None:
    points = make_steps(kind, 3, 300, 1 << 16)
    hierarchy = build_hierarchy(points, leaf=leaf, degree=degree, with_slab=with_slab)
    assert np.array_equal(hierarchy.points, points[hierarchy.tree.order])
    assert not loose_nodes(hierarchy)
    assert hierarchy.bounds.normal.any() == (with_slab and len(points) > 2)


def test_coordinates_of_an_avatars_lattice_are_enclosed() -> None:
    points = make_steps("noise", 3, 200, 1 << 23)
    assert not loose_nodes(build_hierarchy(points, leaf=16, degree=4, highest=1 << 23))


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
