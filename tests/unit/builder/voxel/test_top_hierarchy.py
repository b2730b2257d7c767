"""The top hierarchy encloses all points, as closely as its centres allow, in whatever parts they pass."""

import math

import numpy as np
import pytest
from solidcloud.builder.config import BuildConfig
from solidcloud.builder.kernels.points.octree_cells import split_octree
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


@pytest.mark.parametrize("kind", ["corner", "duplicates"])
@pytest.mark.parametrize("steps", [1000, 1 << 21])
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
