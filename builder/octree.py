"""One voxel's points -> its octree, a BSH in every leaf cell, a BSH over the cells: a `VoxelData`."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..schemas.voxel import CELL_BITS, Cells, Nodes, VoxelData, top_shift
from .balance import balance_cells, tree_limits
from .config import BuildConfig
from .hierarchy import Bounds, Hierarchy, bound_runs, build_hierarchy
from .kernels.octree import split_octree, voxel_codes
from .kernels.pack import pack_tree


class VoxelPoints(NamedTuple):
    """The points of one voxel, in any order.

    local: (n, 3) int32 [voxel steps].  scan_index: (n,) uint16 or None.  intensity: (n,) float32 or None.
    radius_class: (n,) uint8 or None, the same for equal points.
    """

    local: NDArray[np.int32]
    scan_index: NDArray[np.uint16] | None = None
    intensity: NDArray[np.float32] | None = None
    radius_class: NDArray[np.uint8] | None = None


def _canonical(points: VoxelPoints) -> tuple[VoxelPoints, NDArray[np.uint64]]:
    """Sort into Morton order, duplicates by their columns, so that any input order gives the same bytes."""
    codes = voxel_codes(points.local)
    columns = [c for c in (points.intensity, points.scan_index) if c is not None]
    order = np.lexsort((*columns, codes)) if columns else np.argsort(codes, kind="stable")
    return _taken(points, order), codes[order]


def _taken(points: VoxelPoints, order: NDArray[np.int64]) -> VoxelPoints:
    """The points in another order."""
    return VoxelPoints._make(None if column is None else column[order] for column in points)


def build_voxel(key: int, points: VoxelPoints, voxel_steps: int, config: BuildConfig) -> VoxelData:
    """Build the octree and hierarchies of a voxel of n >= 1 points ([Fig12] sections 4 and 5).

    The result depends on the set of points, `voxel_steps` and `config` alone. Hierarchies bound the points'
    centres; radii are added when a question is asked, so that a scene may choose among radius models.
    """
    points, codes = _canonical(points)
    root_log2 = int(voxel_steps - 1).bit_length()
    if config.cells == "balanced":
        limits = tree_limits(config.cell_points, config.leaf, config.degree)
        order, starts, log2_size = balance_cells(codes, root_log2, CELL_BITS, *limits)
        points = _taken(points, order)
    else:
        starts, log2_size = split_octree(codes, root_log2, CELL_BITS, config.cell_points)
    ends = np.append(starts[1:], len(codes))
    size = np.int64(1) << log2_size.astype(np.int64)
    low = points.local[starts] // size[:, None] * size[:, None]

    shift = top_shift(voxel_steps)
    top = None
    if len(starts) > 1:
        middle = (low + size[:, None] // 2).astype(np.int32)
        top = pack_tree(middle, config.degree, config.degree)
        order = top[0]
        starts, ends, low, log2_size = starts[order], ends[order], low[order], log2_size[order]

    trees = [
        build_hierarchy(
            (points.local[a:b] - corner).astype(np.int32),
            leaf=config.leaf,
            degree=config.degree,
            with_slab=config.with_slab,
        )
        for a, b, corner in zip(starts, ends, low, strict=True)
    ]
    ranks = np.concatenate([a + t.tree.order for a, t in zip(starts, trees, strict=True)])
    rows = [_cell_rows(t, slice(0, 1)) for t in trees] + [_cell_rows(t, slice(1, None)) for t in trees]
    if top is not None:
        rows.insert(0, _top_rows(top, points.local[ranks], ends - starts, shift, config))
    cells = Cells(
        low.astype(np.int32),
        log2_size,
        np.array([len(t.tree.count) for t in trees], np.uint32),
        (ends - starts).astype(np.uint32),
    )
    nodes = Nodes(*(np.concatenate(column) for column in zip(*rows, strict=True)))
    return VoxelData(
        key,
        shift,
        cells,
        nodes,
        np.concatenate([_from_block_low(t) for t in trees]),
        None if points.scan_index is None else points.scan_index[ranks],
        None if points.intensity is None else points.intensity[ranks],
        None if points.radius_class is None else points.radius_class[ranks],
    )


def _from_block_low(tree: Hierarchy) -> NDArray[np.uint16]:
    """The points of a cell (n, 3), from their leaf node's block_low."""
    leaves = slice(tree.tree.levels[-2], None)
    per_point = np.repeat(tree.block_low[leaves], tree.tree.count[leaves], axis=0)
    return (tree.points - per_point).astype(np.uint16)


def _rows(bounds: Bounds, count: NDArray[np.uint8], axis: NDArray[np.uint8], low: NDArray[np.int64]) -> Nodes:
    """Narrow int64 bounds to the stored types."""
    return Nodes(
        bounds.center.astype(np.uint16),
        bounds.radius.astype(np.uint16),
        bounds.normal.astype(np.int8),
        bounds.slab.astype(np.int32),
        count,
        axis,
        low.astype(np.uint16),
    )


def _cell_rows(tree: Hierarchy, which: slice) -> Nodes:
    """The rows `which` of one cell's BSH."""
    bounds = Bounds(*(column[which] for column in tree.bounds))
    return _rows(bounds, tree.tree.count[which], tree.axis[which], tree.block_low[which])


def _top_rows(
    top: tuple[NDArray, ...],
    points: NDArray[np.int32],
    held: NDArray[np.int64],
    shift: int,
    config: BuildConfig,
) -> Nodes:
    """The rows of the top BSH: over cells, but bounding the points (n, 3) in cell order, `held` a cell."""
    _, begin, end, count, _ = top
    first = np.concatenate([[0], np.cumsum(held)])
    bounds = bound_runs(
        points,
        first[begin],
        first[end],
        unit_log2=shift,
        highest=(1 << CELL_BITS) - 1,
        with_slab=config.with_slab,
    )
    return _rows(bounds, count, np.zeros(len(begin), np.uint8), np.zeros((len(begin), 3), np.int64))
