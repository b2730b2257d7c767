"""Octree of one voxel, with a BSH in every leaf cell and a BSH over the cells: a `VoxelData`."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...schemas.archive.voxel import CELL_BITS, VoxelData, top_shift
from ..config import BuildConfig
from ..kernels.points.octree_cells import is_ascending, merge_order, split_octree, voxel_codes
from .balance_cells import balance_cells, tree_limits
from .cell_trees import block_points, build_trees, join_rows, stored_cells, take_cells, take_rows
from .top_hierarchy import pack_top


class VoxelPoints(NamedTuple):
    """Points of one voxel, in any order.

    local: (n, 3) int32 [voxel steps].  scan_index: (n,) uint16 or None.  intensity: (n,) float32 or
    None.
    radius_class: (n,) uint8 or None.  normal: (n,) uint16 or None. These two are the same for equal
    points.
    """

    local: NDArray[np.int32]
    scan_index: NDArray[np.uint16] | None = None
    intensity: NDArray[np.float32] | None = None
    radius_class: NDArray[np.uint8] | None = None
    normal: NDArray[np.uint16] | None = None


def canonical(points: VoxelPoints) -> tuple[VoxelPoints, NDArray[np.uint64]]:
    """Sort points into Morton order, duplicates by their columns, which makes the order unique.

    Every input order thus gives the same bytes. Return the points and their codes. Points already
    in this order are not copied.
    """
    codes = voxel_codes(points.local)
    if is_ascending(codes):
        return _with_ties_sorted(points, codes), codes
    columns = [c for c in (points.intensity, points.scan_index) if c is not None]
    order = np.lexsort((*columns, codes)) if columns else np.argsort(codes, kind="stable")
    return _taken(points, order), codes[order]


def _with_ties_sorted(points: VoxelPoints, codes: NDArray[np.uint64]) -> VoxelPoints:
    """Sort points of equal codes by their columns. The points are in Morton order."""
    columns = [c for c in (points.intensity, points.scan_index) if c is not None]
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
    points = VoxelPoints(
        np.ascontiguousarray(rows["local"]),
        np.ascontiguousarray(rows["scan_index"]) if "scan_index" in names else None,
        np.ascontiguousarray(rows["intensity"]) if "intensity" in names else None,
    )
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
