"""Test that cells of one height hold every point once and enclose it."""

import numpy as np
import pytest
from solidcloud.builder.config import BuildConfig
from solidcloud.builder.kernels.points.octree_cells import voxel_codes
from solidcloud.builder.passes.cell_summary import tree_heights
from solidcloud.builder.voxel.balance_cells import balance_cells, tree_height, tree_limits
from solidcloud.builder.voxel.exact_enclosure import loose_nodes
from solidcloud.builder.voxel.voxel_octree import VoxelPoints, build_voxel
from solidcloud.schemas.archive.voxel import check_voxel

pytestmark = pytest.mark.interpreted


def balanced(points: np.ndarray, largest: int, fewest: int, most: int) -> list[tuple[np.ndarray, int]]:
    """The cells of points (n, 3) below 1024, each its points and the log2 of its cube."""
    codes = voxel_codes(points)
    by_code = np.argsort(codes, kind="stable")
    order, starts, log2_size = balance_cells(codes[by_code], 10, largest, fewest, most)
    assert np.array_equal(np.sort(order), np.arange(len(points))), "every point once"
    runs = np.split(points[by_code][order], starts[1:])
    return list(zip(runs, log2_size.tolist(), strict=True))


def scattered() -> np.ndarray:
    """Return a voxel of 100,000 steps whose largest cubes hold 300, 200, 12, 2 and 1 points."""
    rng = np.random.default_rng(12)
    corners = [(0, 0, 0), (65536, 0, 0), (0, 65536, 0), (65536, 65536, 0), (0, 0, 65536)]
    clusters = [
        corner + rng.integers(0, 30000, (held, 3))
        for corner, held in zip(corners, (300, 200, 12, 2, 1), strict=True)
    ]
    return np.concatenate(clusters).astype(np.int32)


@pytest.mark.parametrize(("leaf", "degree", "cell_points"), [(4, 4, 64), (8, 3, 8)])
def test_cells_alone_in_the_largest_cube_have_trees_of_the_same_height(
    leaf: int, degree: int, cell_points: int
) -> None:
    points, steps = scattered(), 100_000
    config = BuildConfig(leaf=leaf, degree=degree, cell_points=cell_points, cells="balanced")
    voxel = build_voxel(5, VoxelPoints(points), steps, config)
    links = check_voxel(voxel, steps)
    height = tree_height(cell_points, leaf, degree)
    assert set(tree_heights(voxel.cells, links)) == {height + 1}
    fewest, most = tree_limits(cell_points, leaf, degree)
    held = voxel.cells.points.astype(np.int64)
    assert held.max() <= most and held.sum() == len(points)
    assert (held < fewest).any() == (height > 0), "some cells are too small for a packed tree"
    assert loose_nodes(voxel, links, range(len(voxel.nodes.count))) == []
