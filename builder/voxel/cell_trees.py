"""Hierarchies of the cells of a voxel, or of a part of a voxel.

A part consists of whole cells. Its hierarchies are therefore the same whether the voxel is built at
once (voxel_octree.py) or part by part (dense_voxel.py).
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...schemas.archive.voxel import CELL_BITS, LeafCells, Nodes
from ..config import BuildConfig
from ..kernels.trees.bounding_sphere import MOMENTS
from ..kernels.trees.build_tree import EXTREMES, build_cells, copy_runs, leaf_rows
from ..kernels.trees.pack_tree import max_nodes

HIGHEST = (1 << CELL_BITS) - 1


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
