"""The bounding sphere hierarchy (BSH) of one set of points, such as an avatar's; cells.py makes those of many cells.

[Fig12] section 5: an R-tree-like tree of spheres of degree m, all leaf nodes on one level, each point in
one node. Two differences: nodes are packed from the top, not by insertion, and each sphere is cut by a
slab, because scanned surfaces are flat and spheres are not (scripts/walkthrough compares both kinds of node).
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .kernels.bounding_sphere import SPREAD
from .kernels.pack import ROWS
from .kernels.trees import build_tree, tree_rows, tree_space


class Tree(NamedTuple):
    """Which items stand below which node; nodes level by level from the root, t of them.

    order: (n,) int64, items in leaf-node order.  begin, end: (t,) int64, a node's run in that order.
    count: (t,) uint8, children, or items of a leaf node.  levels: (height + 1,) int64, first node of each
    level, then t.
    """

    order: NDArray[np.int64]
    begin: NDArray[np.int64]
    end: NDArray[np.int64]
    count: NDArray[np.uint8]  # type: ignore[assignment]  # hides tuple.count, which nobody calls
    levels: NDArray[np.int64]


class Bounds(NamedTuple):
    """The bounds of t nodes, as in schemas/voxel.py `Nodes`, int64: center, radius [units], normal, slab."""

    center: NDArray[np.int64]
    radius: NDArray[np.int64]
    normal: NDArray[np.int64]
    slab: NDArray[np.int64]


class Hierarchy(NamedTuple):
    """A tree over points and its bounds.

    points: (n, 3) int32 in leaf-node order.  axis: (t,) uint8 and block_low: (t, 3) int64, leaf nodes: the
    axis their points are sorted along, the low corner of their box; else 0.
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

    The result is a function of the points and their order alone; give them in a canonical order, and it
    is a function of the set. leaf: 1 to 32 points, degree: 2 to 16 children.  highest: greatest stored coordinate of a
    centre. Every bound encloses its points exactly.
    """
    n = len(points)
    own = np.empty((ROWS, n), np.int32)
    own[:3], own[3] = points.T, np.arange(n)
    space, rows = tree_space(n, leaf, degree), tree_rows(n, leaf)
    total, height = build_tree(own, n, leaf, degree, with_slab, highest, space, rows, np.empty(SPREAD))
    begin, end, levels = space[2]
    center, radius, normal, slab, count, axis, block_low = (column[:total] for column in rows)
    tree = Tree(own[3].astype(np.int64), begin[:total], end[:total], count, levels[: height + 2])
    ordered = np.ascontiguousarray(own[:3].T)
    return Hierarchy(tree, Bounds(center, radius, normal, slab), ordered, axis, block_low)
