"""Octree of one voxel, with a BSH in every leaf cell and a BSH over the cells: a `VoxelData`.

A voxel that does not fit in memory is built in parts of whole cells (dense_voxel.py). The
hierarchies of a part are the same as if the voxel were built at once.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...schemas.archive.codec import Record
from ...schemas.archive.voxel import CELL_BITS, LeafCells, Nodes, VoxelData, top_shift
from ..config import BuildConfig
from ..kernels.points.octree_cells import is_ascending, merge_order, split_octree, voxel_codes
from ..kernels.trees.bounding_sphere import MOMENTS
from ..kernels.trees.build_tree import EXTREMES, build_cells, copy_runs, leaf_rows
from ..kernels.trees.pack_tree import max_nodes
from ..spool.point_order import sort_keys
from .balance_cells import balance_cells, packed_heights, raise_trees, tree_height, tree_limits
from .top_hierarchy import HIGHEST, pack_top


class VoxelPoints(NamedTuple):
    """Points of one voxel, in any order.

    local: (n, 3) int32 [voxel steps].  scan_index: (n,) uint16 or None.  intensity: (n,) float32 or
    None.
    radius_class: (n,) uint8 or None, the same for equal points.  rgb: (n, 3) uint8 or None.
    classification: (n,) uint8 or None.
    """

    local: NDArray[np.int32]
    scan_index: NDArray[np.uint16] | None = None
    intensity: NDArray[np.float32] | None = None
    radius_class: NDArray[np.uint8] | None = None
    rgb: NDArray[np.uint8] | None = None
    classification: NDArray[np.uint8] | None = None


class BuiltVoxel(NamedTuple):
    """Finished voxel, as `write_shard` takes it.

    voxel: at least its key and the columns it has.
    low, high: (3,) int64, least and greatest coordinates of its points [voxel steps].
    """

    voxel: VoxelData
    record: Record
    low: NDArray[np.int64]
    high: NDArray[np.int64]


def canonical(points: VoxelPoints) -> tuple[VoxelPoints, NDArray[np.uint64]]:
    """Sort points into Morton order, duplicates by their columns, which makes the order unique.

    Every input order thus gives the same bytes. Return the points and their codes. Points already
    in this order are not copied.
    """
    codes = voxel_codes(points.local)
    if is_ascending(codes):
        return _with_ties_sorted(points, codes), codes
    columns = sort_keys(points._asdict())
    order = np.lexsort((*columns, codes)) if columns else np.argsort(codes, kind="stable")
    return _taken(points, order), codes[order]


def _with_ties_sorted(points: VoxelPoints, codes: NDArray[np.uint64]) -> VoxelPoints:
    """Sort points of equal codes by their columns. The points are in Morton order."""
    columns = sort_keys(points._asdict())
    if not columns:
        return points
    same = np.append(codes[1:] == codes[:-1], False)
    same[1:] |= same[:-1]
    tied = np.flatnonzero(same)
    order = np.arange(len(codes))
    order[tied] = tied[np.lexsort((*(c[tied] for c in columns), codes[tied]))]
    return _taken(points, order)


def gather_voxel(parts: list[NDArray]) -> VoxelPoints:
    """Merge several sorted arrays of spool rows into points in Morton order."""
    rows = np.concatenate(parts)
    names = rows.dtype.names or ()
    points = VoxelPoints(**{name: np.ascontiguousarray(rows[name]) for name in names})
    if len(parts) == 1:
        return points
    starts = np.cumsum([0, *map(len, parts)])
    return _taken(points, merge_order(voxel_codes(points.local), starts))


def _taken(points: VoxelPoints, order: NDArray[np.integer]) -> VoxelPoints:
    """Return the points in another order."""
    return VoxelPoints._make(None if column is None else column[order] for column in points)


def build_voxel(key: int, points: VoxelPoints, voxel_steps: int, config: BuildConfig) -> VoxelData:
    """Build the octree and hierarchies of a voxel of n >= 1 points ([Fig12] sections 4 and 5).

    The result depends only on the set of points, `voxel_steps` and `config`. Hierarchies bound the
    points' centres; the radii are added at query time, so that a scene may choose among radius
    models.
    """
    points, codes = canonical(points)
    root_log2 = int(voxel_steps - 1).bit_length()
    if config.cells == "balanced":
        limits = tree_limits(config.cell_points, config.leaf, config.degree)
        order, starts, log2_size = balance_cells(codes, root_log2, CELL_BITS, *limits)
        points = _taken(points, order)
    else:
        starts, log2_size = split_octree(codes, root_log2, CELL_BITS, config.cell_points)
    trees = build_trees(points.local, starts, log2_size, config)
    if config.cells == "balanced":
        trees = _raised(trees, config)
    top = None
    if len(starts) > 1:
        top = pack_top(trees.low, log2_size, trees.spreads, trees.extremes, voxel_steps, config)
        trees = take_cells(trees, top.order)
        top.grow(trees.xyz, trees.starts, trees.low, 0)
    of_roots = np.zeros(len(trees.nodes.count), bool)
    of_roots[trees.rows[:-1]] = True
    levels = [
        *([] if top is None else [top.rows()]),
        *(take_rows(trees.nodes, of) for of in (of_roots, ~of_roots)),
    ]
    return VoxelData(
        key,
        top_shift(voxel_steps),
        stored_cells(trees),
        join_rows(levels),
        block_points(trees, config.leaf),
        *_taken(points, trees.rank)[1:],
    )


def _raised(trees: "CellTrees", config: BuildConfig) -> "CellTrees":
    """Give the trees of cells with too few points the height of all others."""
    height = tree_height(config.cell_points, config.leaf, config.degree)
    lacking = height - packed_heights(np.diff(trees.starts), config.leaf, config.degree)
    nodes, rows = raise_trees(trees.nodes, trees.rows, lacking)
    return trees._replace(nodes=nodes, rows=rows)


class CellTrees(NamedTuple):
    """Hierarchies of c cells, concatenated, with n points and m nodes in total.

    low: (c, 3) int64 corners [voxel steps].  log2_size: (c,) uint8.
    starts: (c + 1,) int64, index of the first point of each cell.
    rows: (c + 1,) int64, index of the first node of each cell.
    nodes: m rows, cell by cell, level by level.
    xyz: (3, n) uint16, points in leaf-node order, from their cell's corner.
    rank: (n,) int32, index of each point among the input points.
    spreads: (c, MOMENTS) float64 and extremes: (c, EXTREMES, 3) int32, see kernels/trees/build_tree.py.
    """

    low: NDArray[np.int64]
    log2_size: NDArray[np.uint8]
    starts: NDArray[np.int64]
    rows: NDArray[np.int64]
    nodes: Nodes
    xyz: NDArray[np.uint16]
    rank: NDArray[np.int32]
    spreads: NDArray[np.float64]
    extremes: NDArray[np.int32]


def build_trees(
    points: NDArray[np.int32],
    starts: NDArray[np.int64],
    log2_size: NDArray[np.uint8],
    config: BuildConfig,
) -> CellTrees:
    """Build the hierarchies of cells of points in canonical order.

    points: (n, 3) [voxel steps], n >= 1.  starts: (c,) index of the first point of each cell.
    log2_size: (c,) log2 of the edge of each cell's cube.
    """
    n, c = len(points), len(starts)
    size = np.int64(1) << log2_size.astype(np.int64)
    low = points[starts] // size[:, None] * size[:, None]
    bounds = np.append(starts, n).astype(np.int64)
    m = sum(map(max_nodes, np.diff(bounds).tolist(), [config.leaf] * c))
    nodes = Nodes(
        np.empty((m, 3), np.uint16),
        np.empty(m, np.uint16),
        np.empty((m, 3), np.int8),
        np.empty((m, 2), np.int32),
        np.empty(m, np.uint8),
        np.empty(m, np.uint8),
        np.empty((m, 3), np.uint16),
    )
    held = np.empty(c, np.int64)
    xyz, rank = np.empty((3, n), np.uint16), np.empty(n, np.int32)
    spreads, extremes = np.empty((c, MOMENTS)), np.empty((c, EXTREMES, 3), np.int32)
    tree = (config.leaf, config.degree, config.with_slab, HIGHEST)
    total = build_cells(points, bounds, low, *tree, tuple(nodes), held, xyz, rank, spreads, extremes)
    nodes = Nodes._make(column[:total].copy() for column in nodes)
    rows = np.concatenate([[0], np.cumsum(held)])
    return CellTrees(low, log2_size, bounds, rows, nodes, xyz, rank, spreads, extremes)


def run_indices(starts: NDArray[np.int64], lengths: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the integers of the ranges [starts[i], starts[i] + lengths[i]), concatenated."""
    ends = np.cumsum(lengths)
    return np.repeat(starts - ends + lengths, lengths) + np.arange(int(ends[-1]))


def take_cells(trees: CellTrees, order: NDArray[np.int64]) -> CellTrees:
    """Return the c cells in another order."""
    points, held = np.diff(trees.starts)[order], np.diff(trees.rows)[order]
    of_nodes = run_indices(trees.rows[order], held)
    xyz, rank = np.empty_like(trees.xyz), np.empty((1, len(trees.rank)), np.int32)
    copy_runs(trees.xyz, trees.starts, order, xyz)
    copy_runs(trees.rank[None], trees.starts, order, rank)
    return CellTrees(
        trees.low[order],
        trees.log2_size[order],
        np.concatenate([[0], np.cumsum(points)]),
        np.concatenate([[0], np.cumsum(held)]),
        take_rows(trees.nodes, of_nodes),
        xyz,
        rank[0],
        trees.spreads[order],
        trees.extremes[order],
    )


def block_points(trees: CellTrees, leaf: int) -> NDArray[np.uint16]:
    """Return the points (n, 3), relative to the corners of their leaf nodes' boxes.

    leaf: most points of a leaf node.
    """
    points = np.empty((trees.xyz.shape[1], 3), np.uint16)
    first = trees.rows[1:] - _leaves(trees, leaf)
    leaf_rows(trees.xyz, trees.starts, first, trees.nodes.count, trees.nodes.block_low, points)
    return points


def _leaves(trees: CellTrees, leaf: int) -> NDArray[np.int64]:
    """Return how many leaf nodes each cell has (c,): the fewest that hold its points (pack_tree.py)."""
    return np.asarray(-(-np.diff(trees.starts) // leaf))


def stored_cells(trees: CellTrees) -> LeafCells:
    """Return the cells in their stored form."""
    return LeafCells(
        trees.low.astype(np.int32),
        trees.log2_size,
        np.diff(trees.rows).astype(np.uint32),
        np.diff(trees.starts).astype(np.uint32),
    )


def take_rows(nodes: Nodes, which: NDArray) -> Nodes:
    """Return the selected nodes."""
    return Nodes._make(column[which] for column in nodes)


def join_rows(parts: list[Nodes]) -> Nodes:
    """Concatenate nodes."""
    return Nodes._make(map(np.concatenate, zip(*parts, strict=True)))


def leaf_runs(trees: CellTrees, leaf: int) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Return the first point, number of points and sort axis of every leaf node.

    leaf: most points of a leaf node.
    """
    leaves = _leaves(trees, leaf)
    which = run_indices(trees.rows[1:] - leaves, leaves)
    count = trees.nodes.count[which].astype(np.int64)
    return np.cumsum(count) - count, count, trees.nodes.axis[which].astype(np.int64)
