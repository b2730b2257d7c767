"""Bounding sphere hierarchy of one set of points, by the kernel that builds a cell's."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from solidcloud.builder.kernels.trees.bounding_sphere import MOMENTS
from solidcloud.builder.kernels.trees.build_tree import build_tree, tree_rows, tree_workspace
from solidcloud.builder.kernels.trees.pack_tree import ROWS


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
