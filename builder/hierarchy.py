"""The bounding sphere hierarchy (BSH) of a set of points: a leaf cell's, a voxel's cells', an avatar's.

[Fig12] section 5: an R-tree-like tree of spheres of degree m, all leaf nodes on one level, each point in
one node. Two differences: nodes are packed from the top, not by insertion, and each sphere is cut by a
slab, because scanned surfaces are flat and spheres are not (scripts/walkthrough compares both kinds of node).
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .kernels.bounding_sphere import bound_nodes
from .kernels.pack import pack_tree, sort_leaves


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


def bound_runs(
    points: NDArray[np.int32],
    begin: NDArray[np.int64],
    end: NDArray[np.int64],
    *,
    unit_log2: int,
    highest: int,
    with_slab: bool,
) -> Bounds:
    """Bound the runs points[begin[i]:end[i]], none empty, by spheres cut by slabs.

    points: (n, 3) int32 [steps], 0 to 2^23.  unit_log2: the stored unit of centres and radii is 2^unit_log2
    steps.  highest: greatest stored coordinate of a centre. Every bound encloses its points exactly.
    """
    t = len(begin)
    bounds = Bounds(*(np.zeros(shape, np.int64) for shape in ((t, 3), t, (t, 3), (t, 2))))
    bound_nodes(points, begin, end, unit_log2, highest, with_slab, *bounds)
    return bounds


def build_hierarchy(
    points: NDArray[np.int32], *, leaf: int, degree: int, with_slab: bool = True, highest: int = (1 << 16) - 1
) -> Hierarchy:
    """Build the BSH of points (n, 3) int32, n >= 1, coordinates 0 to 2^23 [steps].

    The result is a function of the points and their order alone; give them in a canonical order, and it
    is a function of the set. leaf: 1 to 32 points, degree: 2 to 16 children.
    """
    tree = Tree(*pack_tree(points, leaf, degree))
    t = len(tree.begin)
    axis, block_low = np.zeros(t, np.uint8), np.zeros((t, 3), np.int64)
    sort_leaves(points, tree.order, tree.begin, tree.end, tree.levels[-2], axis, block_low)
    ordered = points[tree.order]
    bounds = bound_runs(ordered, tree.begin, tree.end, unit_log2=0, highest=highest, with_slab=with_slab)
    return Hierarchy(tree, bounds, ordered, axis, block_low)
