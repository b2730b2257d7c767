"""Bounding sphere hierarchy (BSH) of one set of points, such as an avatar's, and their spacing.

voxel_octree.py makes the hierarchies of many cells at once.

[Fig12] section 5: an R-tree-like tree of spheres of degree m, with all leaf nodes on one level and
each point in one node. There are two differences: nodes are packed from the top instead of
inserted, and each sphere is cut by a slab, because scanned surfaces are flat and spheres are not
(scripts/walkthrough compares both kinds of node).
"""

import math
from itertools import chain
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..kernels.neighbours.nearest_points import FAR, SearchTree, closest_other
from ..kernels.trees.bounding_sphere import MOMENTS
from ..kernels.trees.build_tree import build_tree, tree_rows, tree_workspace
from ..kernels.trees.pack_tree import ROWS

# The lattice of an avatar is never finer than this: 1 micrometre.
FINEST_STEP = 2.0**-20
# Most lattice steps that an avatar spans, which keeps the arithmetic of the bounds inside int64 and
# int32.
MAX_STEPS = 1 << 22
# Distances summed at a time; in between, other threads may take the interpreter lock.
_PIECE = 4096


class Tree(NamedTuple):
    """Tree topology: which items are below which of t nodes, listed level by level from the root.

    order: (n,) int64, items in leaf-node order.  begin, end: (t,) int64, range of each node in that
    order.
    count: (t,) uint8, number of children, or of items for a leaf node.
    levels: (height + 1,) int64, first node of each level, then t.
    """

    order: NDArray[np.int64]
    begin: NDArray[np.int64]
    end: NDArray[np.int64]
    count: NDArray[np.uint8]  # type: ignore[assignment]  # hides tuple.count, which nobody calls
    levels: NDArray[np.int64]


class Bounds(NamedTuple):
    """Bounds of t nodes, int64; columns as in schemas/archive/voxel.py `Nodes`. radius: in units."""

    center: NDArray[np.int64]
    radius: NDArray[np.int64]
    normal: NDArray[np.int64]
    slab: NDArray[np.int64]


class Hierarchy(NamedTuple):
    """Tree over points, with its bounds.

    points: (n, 3) int32 in leaf-node order.
    axis: (t,) uint8, axis along which the points of a leaf node are sorted; 0 for inner nodes.
    block_low: (t, 3) int64, low corner of the box of a leaf node; 0 for inner nodes.
    """

    tree: Tree
    bounds: Bounds
    points: NDArray[np.int32]
    axis: NDArray[np.uint8]
    block_low: NDArray[np.int64]


def build_hierarchy(
    points: NDArray[np.int32], *, leaf: int, degree: int, with_slab: bool = True, highest: int = (1 << 16) - 1
) -> Hierarchy:
    """Build the BSH of points (n, 3) int32, n >= 1, coordinates 0 to 2^23 [steps].

    The result is a function of the points and their order alone. If the points are in a canonical
    order, it is a function of their set.
    leaf: 1 to 32 points.  degree: 2 to 16 children.  highest: greatest stored coordinate of a
    centre. Every bound encloses its points exactly.
    """
    n = len(points)
    own = np.empty((ROWS, n), np.int32)
    own[:3], own[3] = points.T, np.arange(n)
    space, rows = tree_workspace(n, leaf, degree), tree_rows(n, leaf)
    total, height = build_tree(own, n, leaf, degree, with_slab, highest, space, rows, np.empty(MOMENTS))
    begin, end, levels = space[2]
    center, radius, normal, slab, count, axis, block_low = (column[:total] for column in rows)
    tree = Tree(own[3].astype(np.int64), begin[:total], end[:total], count, levels[: height + 2])
    ordered = np.ascontiguousarray(own[:3].T)
    return Hierarchy(tree, Bounds(center, radius, normal, slab), ordered, axis, block_low)


class LocalHierarchy(NamedTuple):
    """Hierarchy of free points on their own lattice: world = low + steps * step (low (3,) [m])."""

    hierarchy: Hierarchy
    low: NDArray[np.float64]
    step: float


def build_local(points: NDArray[np.float64], *, leaf: int, degree: int) -> LocalHierarchy:
    """Build the hierarchy of points (n, 3) [m], n >= 1, on their own lattice.

    Its step is 2^-20 m, or the power of two that the extent of the points requires. Points are
    rounded down to the lattice. Each therefore lies less than two steps (sqrt(3) of them) from its
    lattice point.
    """
    low = points.min(axis=0)
    extent = float((points.max(axis=0) - low).max())
    step = max(FINEST_STEP, 2.0 ** math.ceil(math.log2(extent / MAX_STEPS))) if extent > 0 else FINEST_STEP
    steps = np.floor((points - low) / step).astype(np.int32)
    return LocalHierarchy(build_hierarchy(steps, leaf=leaf, degree=degree, highest=2 * MAX_STEPS), low, step)


def mean_closest_distance(local: LocalHierarchy) -> float:
    """Return the mean closest-point distance [m] of distinct lattice points.

    Return 0 for fewer than two points.
    """
    tree = local.hierarchy.tree
    t = len(tree.begin)
    is_leaf = np.arange(t) >= tree.levels[-2]
    inner = int(tree.levels[-2])
    first = np.empty(t, np.int32)
    first[:inner] = (
        1 + np.concatenate([[0], np.cumsum(tree.count[:inner], dtype=np.int64)[:-1]]) if inner else 0
    )
    first[inner:] = tree.begin[inner:]
    points = local.hierarchy.points.astype(np.int64)
    search = SearchTree(
        local.hierarchy.bounds.center, local.hierarchy.bounds.radius, first, tree.count, is_leaf, points
    )
    queries = _distinct(points)
    if len(queries) < 2:
        return 0.0
    best = np.full(len(queries), FAR)
    closest_other(search, queries, best)
    distances = np.sqrt(best.astype(np.float64)) * local.step
    # Sum in pieces: math.fsum of the whole array would hold the interpreter lock for 50 ms with
    # 10^6 points.
    pieces = (distances[i : i + _PIECE].tolist() for i in range(0, len(distances), _PIECE))
    return math.fsum(chain.from_iterable(pieces)) / len(queries)


def _distinct(points: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the distinct rows of points (n, 3), n >= 1, in lexicographic order.

    `np.unique(points, axis=0)` does the same, but holds the interpreter lock while sorting: 0.9 s
    for 10^6 points.
    """
    ordered = points[np.lexsort(points.T[::-1])]
    first = np.ones(len(ordered), bool)
    first[1:] = (ordered[1:] != ordered[:-1]).any(axis=1)
    return ordered[first]
