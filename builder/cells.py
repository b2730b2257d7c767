"""The cells of a voxel, or of a part of one: points in canonical order -> each cell's hierarchy and what the top needs.

A part is whole cells, so what is made of it is the same whether the voxel is built at once (octree.py) or part by part
(dense.py).
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..schemas.voxel import CELL_BITS, Cells, Nodes
from .config import BuildConfig
from .kernels.bounding_sphere import SPREAD
from .kernels.pack import most_nodes
from .kernels.top import leaf_rows, take_runs
from .kernels.trees import EXTREMES, build_cells

HIGHEST = (1 << CELL_BITS) - 1


class CellTrees(NamedTuple):
    """The hierarchies of c cells, one after the other, n points and m nodes in all.

    low: (c, 3) int64 corners [voxel steps].  log2_size: (c,) uint8.  starts: (c + 1,) int64, first point of each cell.
    rows: (c + 1,) int64, first node of each.  nodes: m rows, cell by cell, level by level.  xyz: (3, n) uint16, points
    in leaf-node order from their cell's corner.  rank: (n,) int32, which of the points given each is.
    spreads: (c, SPREAD) float64 and extremes: (c, EXTREMES, 3) int32, see kernels/trees.py.
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
    """Build the hierarchies of the cells that begin at `starts` (c,) among points (n, 3) [voxel steps], n >= 1."""
    n, c = len(points), len(starts)
    size = np.int64(1) << log2_size.astype(np.int64)
    low = points[starts] // size[:, None] * size[:, None]
    bounds = np.append(starts, n).astype(np.int64)
    m = sum(map(most_nodes, np.diff(bounds).tolist(), [config.leaf] * c))
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
    spreads, extremes = np.empty((c, SPREAD)), np.empty((c, EXTREMES, 3), np.int32)
    tree = (config.leaf, config.degree, config.with_slab, HIGHEST)
    total = build_cells(points, bounds, low, *tree, tuple(nodes), held, xyz, rank, spreads, extremes)
    nodes = Nodes._make(column[:total].copy() for column in nodes)
    rows = np.concatenate([[0], np.cumsum(held)])
    return CellTrees(low, log2_size, bounds, rows, nodes, xyz, rank, spreads, extremes)


def run_indices(starts: NDArray[np.int64], lengths: NDArray[np.int64]) -> NDArray[np.int64]:
    """The numbers of the runs starts[i] to starts[i] + lengths[i], one behind the other."""
    ends = np.cumsum(lengths)
    return np.repeat(starts - ends + lengths, lengths) + np.arange(int(ends[-1]))


def take_cells(trees: CellTrees, order: NDArray[np.int64]) -> CellTrees:
    """The cells in another order, c of them."""
    points, held = np.diff(trees.starts)[order], np.diff(trees.rows)[order]
    of_nodes = run_indices(trees.rows[order], held)
    xyz, rank = np.empty_like(trees.xyz), np.empty((1, len(trees.rank)), np.int32)
    take_runs(trees.xyz, trees.starts, order, xyz)
    take_runs(trees.rank[None], trees.starts, order, rank)
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
    """The points (n, 3) from the corners of their leaf nodes' boxes. leaf: most points of a leaf node."""
    points = np.empty((trees.xyz.shape[1], 3), np.uint16)
    first = trees.rows[1:] - _leaves(trees, leaf)
    leaf_rows(trees.xyz, trees.starts, first, trees.nodes.count, trees.nodes.block_low, points)
    return points


def _leaves(trees: CellTrees, leaf: int) -> NDArray[np.int64]:
    """How many leaf nodes each cell has (c,): as few as hold its points (kernels/pack.py)."""
    return np.asarray(-(-np.diff(trees.starts) // leaf))


def stored_cells(trees: CellTrees) -> Cells:
    """The cells as stored."""
    return Cells(
        trees.low.astype(np.int32),
        trees.log2_size,
        np.diff(trees.rows).astype(np.uint32),
        np.diff(trees.starts).astype(np.uint32),
    )


def take_rows(nodes: Nodes, which: NDArray) -> Nodes:
    """Some of the nodes."""
    return Nodes._make(column[which] for column in nodes)


def join_rows(parts: list[Nodes]) -> Nodes:
    """Nodes, one part behind the other."""
    return Nodes._make(map(np.concatenate, zip(*parts, strict=True)))


def leaf_runs(trees: CellTrees, leaf: int) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """First point, number of points and sort axis of every leaf node. leaf: most points of one."""
    leaves = _leaves(trees, leaf)
    which = run_indices(trees.rows[1:] - leaves, leaves)
    count = trees.nodes.count[which].astype(np.int64)
    return np.cumsum(count) - count, count, trees.nodes.axis[which].astype(np.int64)
