"""Data of one voxel as flat arrays, and the checks that every decoded voxel passes.

The checks are `link_tree`, `check_tree` and, as the points are read, `decode_points` (codec.py);
`check_voxel` runs all three.

A voxel is an octree whose leaf cells each hold a bounding sphere hierarchy (BSH), with one more BSH
over the cells ([Fig12] section 4 and figures 3, 4). Every BSH is an R-tree-like tree of degree m
with all leaf nodes on one level. Only counts are stored: children are contiguous, so their start
follows from the counts.

Node order: the nodes of the top BSH, level by level from its root; then the root node of every
cell, in cell order; then, cell by cell, the cell's other nodes, level by level. A voxel of one cell
has no top BSH.
"""

from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from ..errors import CorruptError
from ..kernels.record_rows import LANES, NO_AXIS, leaf_lanes, link_rows

# Limit of the points of a leaf node: lanes of the vector test. LLVM vectorises 32 lanes but not 8
# or 16 (server/kernels/collide/collide_poses.py).
MAX_LEAF = LANES
MIN_DEGREE, MAX_DEGREE = 2, 16
# Limit of the levels of nodes from root to leaf. Trees of degree 2 over 2^31 points have 32 levels
# per BSH, and a voxel has two BSHs on top of each other. Kernels have stacks and lists of this
# size.
MAX_LEVELS = 80

# Bits per axis of coordinates inside a leaf cell (NUMERICS.md N3).
CELL_BITS = 16


class LeafCells(NamedTuple):
    """Leaf cells of a voxel's octree, c of them.

    Cell `i` covers `low[i] + [0, 2**log2_size[i])` on each axis.
    low: (c, 3) int32 [voxel steps].  log2_size: (c,) uint8.
    nodes: (c,) uint32, nodes of the cell's BSH.  points: (c,) uint32, points in the cell.
    """

    low: NDArray[np.int32]
    log2_size: NDArray[np.uint8]
    nodes: NDArray[np.uint32]
    points: NDArray[np.uint32]


class Nodes(NamedTuple):
    """Bounding spheres, each cut by a slab; n of them.

    Each sphere and slab encloses all *points* below its node (centres only, without their radii).
    center: (n, 3) uint16 [steps from the cell's low corner; top BSH: 2**top_shift steps from the
    voxel's].
    radius: (n,) uint16, the same unit.
    normal: (n, 3) int8, the slab's direction, not of unit length; zero: no slab.
    slab: (n, 2) int32, least and greatest dot(normal, point - center) [steps].
    count: (n,) uint8, children, or points of a leaf node.
    axis: (n,) uint8, leaf nodes: the axis along which the points are sorted; else 0.
    block_low: (n, 3) uint16, leaf nodes: low corner of the points' box [steps from the cell]; else
    0.
    """

    center: NDArray[np.uint16]
    radius: NDArray[np.uint16]
    normal: NDArray[np.int8]
    slab: NDArray[np.int32]
    count: NDArray[np.uint8]  # type: ignore[assignment]  # hides tuple.count, which nobody calls
    axis: NDArray[np.uint8]
    block_low: NDArray[np.uint16]


class VoxelData(NamedTuple):
    """Complete data of one voxel.

    key: voxel key.  top_shift: see Nodes.center.  cells, nodes: see LeafCells and Nodes.
    points: (p, 3) uint16 x, y, z from their leaf node's block_low, in leaf-node order [steps].
    scan_index: (p,) uint16 or None.  intensity: (p,) float32 or None.
    radius_class: (p,) uint8 below RADIUS_CLASSES, or None.
    rgb: (p, 3) uint8, red, green, blue, or None.  classification: (p,) uint8 or None.
    """

    key: int
    top_shift: int
    cells: LeafCells
    nodes: Nodes
    points: NDArray[np.uint16]
    scan_index: NDArray[np.uint16] | None = None
    intensity: NDArray[np.float32] | None = None
    radius_class: NDArray[np.uint8] | None = None
    rgb: NDArray[np.uint8] | None = None
    classification: NDArray[np.uint8] | None = None


class Links(NamedTuple):
    """Positions of the nodes' children, derived from the counts by `link_nodes`.

    first: (n,) int32, first child node; leaf nodes: first point.  is_leaf: (n,) bool.
    cell: (n,) int32, the cell of a node, -1 for the top BSH.
    height: levels of nodes, root to leaf.
    """

    first: NDArray[np.int32]
    is_leaf: NDArray[np.bool_]
    cell: NDArray[np.int32]
    height: int


def top_shift(voxel_steps: int) -> int:
    """Return the binary logarithm of the unit of the top BSH's centres.

    The unit is the least power of two [steps] with which a voxel fits 16 bits.
    """
    return max(0, int(voxel_steps - 1).bit_length() - CELL_BITS)


def link_nodes(voxel: VoxelData) -> Links:
    """Derive the positions of every node's children.

    Raises CorruptError if the counts do not form trees.
    """
    return link_tree(f"voxel {voxel.key:#x}", voxel.cells, voxel.nodes.count)


def link_tree(name: str, cells: LeafCells, count: NDArray[np.uint8]) -> Links:
    """Derive the links from cells and the nodes' counts (n,), as `link_nodes` does.

    name: of the voxel, for messages.
    """
    n = len(count)
    check_cell_nodes(name, cells, n)
    first, cell_of, is_leaf = np.empty(n, np.int32), np.empty(n, np.int32), np.zeros(n, bool)
    height = link_rows(count, cells.nodes, cells.points, first, is_leaf, cell_of)
    if height < 0:
        raise CorruptError(f"{name}: the counts of node {-1 - height} do not form a tree")
    if height > MAX_LEVELS:
        raise CorruptError(f"{name}: {height} levels of nodes, expected at most {MAX_LEVELS}")
    return Links(first, is_leaf, cell_of, height)


def check_cell_nodes(name: str, cells: LeafCells, nodes: int) -> None:
    """Check the cells' node counts against the number of nodes in the voxel.

    Raises CorruptError.
    """
    c = len(cells.nodes)
    top = nodes - int(cells.nodes.sum(dtype=np.int64))
    if c == 0 or not cells.nodes.all() or not cells.points.all() or top < 0 or (top == 0) != (c == 1):
        raise CorruptError(f"{name}: {nodes} nodes for {c} cells are inconsistent")


def check_cell_points(name: str, cells: LeafCells, points: int) -> None:
    """Check the cells' point counts against the number of points in the voxel.

    Raises CorruptError.
    """
    claimed = int(cells.points.sum(dtype=np.int64))
    if claimed != points:
        raise CorruptError(f"{name}: cells claim {claimed} points, found {points}")


Columns = TypeVar("Columns", LeafCells, Nodes)


def transpose_columns(columns: Columns) -> Columns:
    """Transpose the columns of several components, (n, 3) to (3, n) or back, contiguous."""
    turned = (np.ascontiguousarray(column.T) for column in columns)
    return type(columns)(*turned)  # type: ignore[arg-type]  # each keeps its type


def check_tree(
    name: str, cells: LeafCells, nodes: Nodes, links: Links, points: int, voxel_steps: int
) -> None:
    """Check everything but the points that a kernel relies on, in a voxel whose counts form trees.

    name: of the voxel, for messages.  cells, nodes: transposed.  points: number of points.
    Raises CorruptError naming the fault.
    """
    check_cell_points(name, cells, points)
    if (cells.log2_size > CELL_BITS).any():
        raise CorruptError(f"{name}: a cell larger than 2^{CELL_BITS} steps")
    size = np.int64(1) << cells.log2_size.astype(np.int64)
    low = cells.low.astype(np.int64)
    if (low < 0).any() or (low % size != 0).any() or (low >= voxel_steps).any():
        raise CorruptError(f"{name}: a cell off its grid or outside the voxel")
    if (nodes.count > np.where(links.is_leaf, np.uint8(MAX_LEAF), np.uint8(MAX_DEGREE))).any():
        raise CorruptError(f"{name}: a node over {MAX_LEAF} points or {MAX_DEGREE} children")
    if (nodes.axis > 2).any():
        raise CorruptError(f"{name}: sort axis {int(nodes.axis.max())}, expected 0, 1 or 2")


def decode_points(
    name: str,
    planes: NDArray[np.uint8],
    cells: LeafCells,
    nodes: Nodes,
    links: Links,
    voxel_steps: int,
    lanes: NDArray[np.uint16],
    *,
    deltas: bool = True,
) -> NDArray[np.int64]:
    """Read the points of a checked tree from their byte planes into lanes.

    planes: (6, p).  lanes: (leaf nodes, 3, MAX_LEAF), written.
    cells, nodes: transposed.
    deltas: True if points are stored as differences along the sort axis, see codec.py.
    Returns the bounds (2, 3) of the points, as `leaf_lanes` computes them.
    Raises CorruptError for a point outside its cell. Inside, sums with block_low fit 16 bits, so
    kernels that add them stay in the range for which their error bounds are proved.
    """
    axis = nodes.axis if deltas else np.full(len(nodes.axis), NO_AXIS, np.uint8)
    tree = (links.first, links.is_leaf, links.cell)
    leaf = (nodes.count, axis, nodes.block_low)
    bounds = np.empty((2, 3), np.int64)
    if not leaf_lanes(planes, tree, leaf, (cells.low, cells.log2_size), voxel_steps, lanes, bounds):
        raise CorruptError(f"{name}: a point outside its cell")
    return bounds


def check_voxel(voxel: VoxelData, voxel_steps: int) -> Links:
    """Check everything a kernel relies on, and derive the links.

    Raises CorruptError naming the fault.
    Checked: shapes agree; counts form trees with all leaf nodes on one level; cells lie on their
    own grid inside the voxel's cube; points lie inside their cell; the unit of the top BSH is the
    one that the voxel size requires. Not checked here: that bounds enclose their points
    (`solidcloud validate`).
    """
    cells, nodes = voxel.cells, voxel.nodes
    name = f"voxel {voxel.key:#x}"
    n, c, p = len(nodes.count), len(cells.nodes), len(voxel.points)
    if any(len(a) != n for a in nodes) or any(len(a) != c for a in cells):
        raise CorruptError(f"{name}: columns of unequal length")
    if voxel.top_shift != top_shift(voxel_steps):
        raise CorruptError(f"{name}: top unit 2^{voxel.top_shift} steps, expected 2^{top_shift(voxel_steps)}")
    links = link_nodes(voxel)
    cells, nodes = transpose_columns(cells), transpose_columns(nodes)
    check_tree(name, cells, nodes, links, p, voxel_steps)
    planes = np.ascontiguousarray(np.ascontiguousarray(voxel.points).view(np.uint8).T)
    planes.flags.writeable = False  # like a record's: the kernel is compiled once for both
    lanes = np.empty((int(np.count_nonzero(links.is_leaf)), 3, MAX_LEAF), np.uint16)
    decode_points(name, planes, cells, nodes, links, voxel_steps, lanes, deltas=False)
    return links
