"""Cells of one height: every point once, in an aligned cube, as many a cell as a tree of that height holds."""

import numpy as np
import pytest
from solidcloud.builder.config import BuildConfig
from solidcloud.builder.kernels.points.octree_cells import voxel_codes
from solidcloud.builder.passes.cell_summary import tree_heights
from solidcloud.builder.voxel.balance_cells import balance_cells, packed_heights, tree_height, tree_limits
from solidcloud.builder.voxel.exact_enclosure import loose_nodes
from solidcloud.builder.voxel.voxel_octree import VoxelPoints, build_voxel
from solidcloud.schemas.archive.codec import encode_voxel
from solidcloud.schemas.archive.voxel import check_voxel
from synthetic_scans import WITH_POINTS, make_steps

pytestmark = pytest.mark.interpreted

STEPS = 1000


def balanced(points: np.ndarray, largest: int, fewest: int, most: int) -> list[tuple[np.ndarray, int]]:
    """The cells of points (n, 3) below 1024, each its points and the log2 of its cube."""
    codes = voxel_codes(points)
    by_code = np.argsort(codes, kind="stable")
    order, starts, log2_size = balance_cells(codes[by_code], 10, largest, fewest, most)
    assert np.array_equal(np.sort(order), np.arange(len(points))), "every point once"
    runs = np.split(points[by_code][order], starts[1:])
    return list(zip(runs, log2_size.tolist(), strict=True))


@pytest.mark.parametrize(
    ("cell_points", "leaf", "degree", "limits"),
    [
        (4096, 32, 8, (257, 2048)),
        (2048, 32, 8, (257, 2048)),
        (16384, 32, 8, (2049, 16384)),
        (4096, 32, 16, (513, 8192)),
        (32, 32, 8, (1, 32)),
        (1, 32, 8, (1, 32)),
        (100, 8, 2, (65, 128)),
    ],
)
def test_limits_are_those_of_the_nearest_height(
    cell_points: int, leaf: int, degree: int, limits: tuple[int, int]
) -> None:
    assert tree_limits(cell_points, leaf, degree) == limits


@pytest.mark.parametrize("kind", WITH_POINTS)
@pytest.mark.parametrize(("fewest", "most"), [(1, 8), (9, 32), (17, 32), (65, 512)])
@pytest.mark.parametrize("largest", [8, 10])
def test_cells_hold_what_one_height_holds_inside_their_cube(
    kind: str, fewest: int, most: int, largest: int
) -> None:
    points = make_steps(kind, 4, 300, STEPS)
    in_cube: dict[tuple[int, ...], list[int]] = {}
    for held, log2 in balanced(points, largest, fewest, most):
        assert log2 <= largest
        assert len(np.unique(held >> log2, axis=0)) == 1, "all in the aligned cube"
        assert 1 <= len(held) <= most
        in_cube.setdefault(tuple((held[0] >> largest).tolist()), []).append(len(held))
    for sizes in in_cube.values():
        # 33 points cannot be cut into cells of 17 to 32; any other number that is too many for one can.
        if sum(sizes) >= fewest and (fewest, most) != (17, 32):
            assert min(sizes) >= fewest
        elif sum(sizes) < fewest:
            assert len(sizes) == 1, "what is too little for a cell is not scattered over several"


@pytest.mark.parametrize("kind", ["noise", "plane", "corner", "duplicates"])
@pytest.mark.parametrize("degree", [3, 8])
def test_all_trees_of_a_voxel_have_one_height(kind: str, degree: int) -> None:
    points = VoxelPoints(make_steps(kind, 2, 400, STEPS))
    config = BuildConfig(leaf=4, degree=degree, cell_points=4 * degree, cells="balanced")
    voxel = build_voxel(5, points, STEPS, config)
    heights = tree_heights(voxel.cells, check_voxel(voxel, STEPS))
    assert len(heights) > 3
    assert set(heights) == {2}
    plain = build_voxel(5, points, STEPS, BuildConfig(leaf=4, degree=degree, cell_points=4 * degree))
    if kind == "noise":
        assert len(set(tree_heights(plain.cells, check_voxel(plain, STEPS)))) > 1


def test_the_same_voxel_has_the_same_bytes_in_any_order_of_points() -> None:
    points = make_steps("corner", 3, 300, STEPS)
    scan_index = np.arange(300).astype(np.uint16)
    order = np.random.default_rng(9).permutation(300)
    config = BuildConfig(leaf=4, degree=4, cell_points=64, cells="balanced")
    a = build_voxel(5, VoxelPoints(points, scan_index), STEPS, config)
    b = build_voxel(5, VoxelPoints(points[order], scan_index[order]), STEPS, config)
    assert encode_voxel(a, bytes(16)) == encode_voxel(b, bytes(16))
    assert len(a.cells.nodes) > 3


def scattered() -> np.ndarray:
    """Return a voxel of 100,000 steps whose largest cubes hold 300, 200, 12, 2 and 1 points."""
    rng = np.random.default_rng(12)
    corners = [(0, 0, 0), (65536, 0, 0), (0, 65536, 0), (65536, 65536, 0), (0, 0, 65536)]
    clusters = [
        corner + rng.integers(0, 30000, (held, 3))
        for corner, held in zip(corners, (300, 200, 12, 2, 1), strict=True)
    ]
    return np.concatenate(clusters).astype(np.int32)


@pytest.mark.parametrize("with_slab", [True, False])
@pytest.mark.parametrize(("leaf", "degree", "cell_points"), [(4, 4, 64), (32, 8, 1024), (1, 2, 2), (8, 3, 8)])
def test_cells_alone_in_the_largest_cube_have_trees_of_the_same_height(
    leaf: int, degree: int, cell_points: int, with_slab: bool
) -> None:
    points, steps = scattered(), 100_000
    config = BuildConfig(
        leaf=leaf, degree=degree, cell_points=cell_points, cells="balanced", with_slab=with_slab
    )
    voxel = build_voxel(5, VoxelPoints(points), steps, config)
    links = check_voxel(voxel, steps)
    height = tree_height(cell_points, leaf, degree)
    assert set(tree_heights(voxel.cells, links)) == {height + 1}
    fewest, most = tree_limits(cell_points, leaf, degree)
    held = voxel.cells.points.astype(np.int64)
    assert held.max() <= most and held.sum() == len(points)
    assert (held < fewest).any() == (height > 0), "some cells are too small for a packed tree"
    assert loose_nodes(voxel, links, range(len(voxel.nodes.count))) == []


@pytest.mark.parametrize(("leaf", "degree"), [(32, 8), (4, 3), (1, 2)])
def test_packed_heights_are_those_of_packed_trees(leaf: int, degree: int) -> None:
    held = np.array([1, 2, leaf, leaf + 1, leaf * degree, leaf * degree + 1, leaf * degree**2 + 1])
    rng = np.random.default_rng(3)
    expected = []
    for n in held.tolist():
        config = BuildConfig(leaf=leaf, degree=degree, cell_points=10**6)
        voxel = build_voxel(5, VoxelPoints(rng.integers(0, STEPS, (n, 3)).astype(np.int32)), STEPS, config)
        expected += tree_heights(voxel.cells, check_voxel(voxel, STEPS))
    assert (packed_heights(held, leaf, degree) + 1).tolist() == expected


def test_only_cells_that_are_not_the_default_are_named_in_the_archive() -> None:
    assert "cells" not in BuildConfig().identity()
    assert BuildConfig(cells="balanced").identity()["cells"] == "balanced"
