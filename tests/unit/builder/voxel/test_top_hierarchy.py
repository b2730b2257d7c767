"""The top hierarchy encloses all points, as closely as its centres allow, in whatever parts they pass."""

import itertools
import math

import numpy as np
import pytest
from solidcloud.builder.config import BuildConfig
from solidcloud.builder.kernels.points.octree_cells import split_octree
from solidcloud.builder.kernels.trees.build_tree import initial_bounds
from solidcloud.builder.voxel.top_hierarchy import Top, pack_top
from solidcloud.builder.voxel.voxel_octree import CellTrees, VoxelPoints, build_trees, canonical, take_cells
from synthetic_scans import make_steps

pytestmark = pytest.mark.interpreted


def made(kind: str, steps: int, with_slab: bool = True) -> tuple[CellTrees, Top]:
    """The cells of a scan in the order of the top hierarchy over them, which knows no points yet."""
    config = BuildConfig(leaf=8, degree=3, cell_points=20, with_slab=with_slab)
    points, codes = canonical(VoxelPoints(make_steps(kind, 2, 160, steps).astype(np.int32)))
    starts, log2_size = split_octree(codes, (steps - 1).bit_length(), 16, 20)
    trees = build_trees(points.local, starts, log2_size, config)
    top = pack_top(trees.low, log2_size, trees.spreads, trees.extremes, steps, config)
    return take_cells(trees, top.order), top


def grow(trees: CellTrees, top: Top, cells: range) -> None:
    """Let some cells pass."""
    a, b = trees.starts[cells.start], trees.starts[cells.stop]
    starts = trees.starts[cells.start : cells.stop + 1] - a
    top.grow(trees.xyz[:, a:b].copy(), starts, trees.low[cells.start : cells.stop], cells.start)


def below(trees: CellTrees, top: Top, node: int) -> np.ndarray:
    """The points (n, 3) below a node, from the voxel's corner."""
    level = next(row for row in top.above if node in row)
    found = [
        trees.xyz[:, trees.starts[cell] : trees.starts[cell + 1]].T + trees.low[cell]
        for cell in np.flatnonzero(level == node)
    ]
    return np.concatenate(found)


@pytest.mark.parametrize("kind", ["plane", "corner", "pillar", "noise", "duplicates"])
@pytest.mark.parametrize("steps", [1000, 65537, 1 << 21])
def test_bounds_are_those_of_the_points_about_the_centre(kind: str, steps: int) -> None:
    trees, top = made(kind, steps)
    grow(trees, top, range(len(trees.low)))
    rows = top.rows()
    assert top.unit == 1 << max(0, (steps - 1).bit_length() - 16)
    assert len(rows.count) > 1
    for node in range(len(rows.count)):
        points = below(trees, top, node)
        apart = points.astype(object) - rows.center[node].astype(object) * top.unit
        farthest = max((apart * apart).sum(axis=1))
        assert rows.radius[node] == -(-(math.isqrt(farthest - 1) + 1 if farthest else 0) // top.unit)
        along = (apart * rows.normal[node].astype(object)).sum(axis=1)
        assert rows.slab[node].tolist() == [min(along), max(along)]
        # Half the diagonal of the box is what its centre would need; the guess is not much worse, and mostly better.
        half = np.linalg.norm(np.ptp(points, axis=0)) / 2
        assert int(rows.radius[node]) * top.unit <= 1.01 * half + 2 * top.unit
        if len(points) >= 3:
            assert np.linalg.norm(rows.normal[node]) == pytest.approx(127, abs=1)


def test_the_parts_in_which_points_pass_change_nothing() -> None:
    found = []
    for parts in ([100], [1] * 100, [3, 7, 1, 30, 100]):
        trees, top = made("corner", 200_000)
        cuts = np.minimum(np.cumsum([0, *parts]), len(trees.low))
        for a, b in reversed(list(itertools.pairwise(cuts.tolist()))):
            if b > a:
                grow(trees, top, range(a, b))
        found.append([column.tolist() for column in top.rows()])
    assert found[0] == found[1] == found[2]


def test_a_cell_that_has_not_passed_may_lie_outside() -> None:
    """What only the points can say is not in the bounds before: this test's judge would see it."""
    trees, top = made("noise", 1000)
    before = top.reach2.copy(), top.slab.copy()
    grow(trees, top, range(len(trees.low)))
    assert (top.reach2 >= before[0]).all() and (top.slab[:, 1] >= before[1][:, 1]).all()
    assert (top.reach2 > before[0]).any() or (top.slab != before[1]).any()


def test_without_slabs_there_is_no_direction() -> None:
    trees, top = made("plane", 1000, with_slab=False)
    grow(trees, top, range(len(trees.low)))
    assert not top.rows().normal.any() and not top.rows().slab.any()


def test_a_guess_whose_radius_might_not_fit_is_given_up_for_the_box() -> None:
    """Of two cells at opposite corners and one beside: any centre but the box's may need more than there is."""
    places = np.array([[0, 0, 0], [255, 255, 255], [255, 255, 0]])
    extremes = np.repeat(places[:, None], 14, axis=1).astype(np.int32)
    spreads = np.array([[1, *place, 0, 0, 0, 0, 0, 0] for place in places], float)
    tree = (np.array([0]), np.array([3], np.uint8), np.array([0, 1]))
    centers = []
    for highest in (255, 221):
        center, normal, slab = (np.empty((1, k), np.int64) for k in (3, 3, 2))
        reach2 = np.empty(1, np.int64)
        initial_bounds(tree, spreads, extremes, 1, highest, True, center, normal, reach2, slab)
        assert reach2[0] == ((places - center[0]) ** 2).sum(axis=1).max()
        centers.append(center[0].tolist())
    assert centers[1] == [128, 128, 128]
    assert centers[0] != centers[1]
