"""Rows of a record: positions of the nodes' children, byte planes, and the points of leaf nodes.

The children's positions follow from the counts alone, which are checked at the same time. Points
are stored as differences along the sort axis of their leaf node.

Loops that should be vectorised run to a length known only at run time: LLVM unrolls a loop of 32
constant iterations over bytes and halfwords and then leaves it scalar (3 times as slow). They also
index by uint64: numba gives signed indices a wrap-around check, and LLVM then loads element by
element.
"""

import numpy as np

from ..runtime import compiling as nb


@nb.njit(nogil=True, cache=True)
def _walk(count, total, root, rest, first, is_leaf, cell_of, cell, point, leaves_are_cells):
    """Walk one BSH level by level and fill in its rows.

    Row k of the BSH is `root` for k = 0, else `rest + k - 1`. A level's children are the next
    level. The children of the last level are points from `point` on or, with leaves_are_cells, the
    rows directly after the BSH.
    Returns (levels, items below the last level), or (-1, row) at a node with an impossible count.
    """
    done, size, levels, child = 0, 1, 0, rest
    while True:
        last = done + size == total
        below = 0
        for k in range(done, done + size):
            row = root if k == 0 else rest + k - 1
            if count[row] == 0:
                return -1, row
            cell_of[row] = cell
            if last and not leaves_are_cells:
                is_leaf[row] = True
                first[row] = point + below
            else:
                first[row] = child
                child += int(count[row])
            below += int(count[row])
        done += size
        levels += 1
        if last:
            return levels, below
        if below > total - done:
            return -1, root if done == 1 else rest + done - 2
        size = below


@nb.njit(nogil=True, cache=True)
def link_rows(count, cell_nodes, cell_points, first, is_leaf, cell_of):
    """Fill first, is_leaf and cell_of (n,) of a voxel from its counts.

    schemas/archive/voxel.py defines the node order.
    count: (n,) uint8.
    cell_nodes, cell_points: (c,) uint32, c >= 1, each >= 1; cell_nodes sum to at most n.
    Returns the height in levels, root to leaf; or -1 - row for the first row whose counts do not
    form a tree.
    """
    c = cell_nodes.shape[0]
    top = count.shape[0]
    for i in range(c):
        top -= int(cell_nodes[i])
    top_levels = 0
    if top > 0:
        top_levels, below = _walk(count, top, 0, 1, first, is_leaf, cell_of, -1, 0, True)
        if top_levels < 0:
            return -1 - below
        if below != c:
            return -top
    rest, point, height = top + c, 0, 0
    for i in range(c):
        levels, below = _walk(
            count, np.int64(cell_nodes[i]), top + i, rest, first, is_leaf, cell_of, i, point, False
        )
        if levels < 0:
            return -1 - below
        if below != cell_points[i]:
            return -1 - (top + i)
        rest += int(cell_nodes[i]) - 1
        point += int(cell_points[i])
        height = max(height, levels)
    return top_levels + height


# Lanes of a leaf node's points, all processed by one vector test; equals MAX_LEAF of
# schemas/archive/voxel.py.
LANES = 32
# Replaces a leaf node's sort axis: its points are stored without deltas.
NO_AXIS = 3


@nb.njit(nogil=True, cache=True)
def delta_along(points, first, count, axis):
    """Return points (p, 3) uint16 with the sort axis of each run replaced by differences.

    Each difference is to the point before it in the run.
    first, count, axis: (r,) int64, the runs (leaf nodes); along `axis` a run ascends. Returns a new
    array.
    """
    deltas = points.copy()
    for run in range(first.shape[0]):
        a, k = first[run], axis[run]
        for i in range(a + 1, a + count[run]):
            deltas[i, k] = points[i, k] - points[i - 1, k]
    return deltas


@nb.njit(nogil=True, inline="always")
def _join(low, high, begin, count, out):
    """Write out[j] = low[begin + j] + 256 high[begin + j] for j < count.

    The last value is repeated up to the end of out.
    """
    for j in range(count):
        out[j] = np.uint16(low[begin + j]) | (np.uint16(high[begin + j]) << np.uint16(8))
    for j in range(count, np.uint64(out.shape[0])):
        out[j] = out[count - np.uint64(1)]


@nb.njit(nogil=True, inline="always")
def _undo_delta(count, out):
    """Replace out[:count] by its running sums, and repeat the last one up to the end of out.

    Returns the last sum, which is the greatest. Beyond 2^16 the written values wrap and the
    returned one does not.
    """
    total = np.uint32(0)
    for j in range(count):
        total = np.uint32(total + out[j])
        out[j] = total
    for j in range(count, np.uint64(out.shape[0])):
        out[j] = total
    return total


@nb.njit(nogil=True, inline="always")
def _greatest(values):
    """Return the greatest of values (m,) uint16."""
    most = np.uint16(0)
    for j in range(np.uint64(values.shape[0])):
        most = max(most, values[j])
    return most


@nb.njit(nogil=True, cache=True)
def leaf_lanes(planes, links, nodes, cells, voxel_steps, lanes, bounds):
    """Read every leaf node's points, undo their deltas, and check that they lie in cell and voxel.

    planes: (6 or more, p) uint8: low and high bytes of x, y, z.
    links: (first, is_leaf, cell) of schemas/archive/voxel.py.
    nodes: (count, axis, block_low) (n,), (n,), (3, n); axis NO_AXIS: no deltas.
    cells: (low (3, c), log2_size (c,)).
    Writes lanes (b, 3, LANES) uint16: x[], y[], z[] of each leaf node's points from its block_low,
    in the order of the rows, with the last one repeated to the end.
    Returns True if all points lie inside; stops at the first that does not.
    Writes bounds (2, 3) int64: the least low corner of a leaf node's box and the greatest
    coordinate of a point [voxel steps]. In a record that follows FORMAT.md, the low corner of a box
    is the least coordinate of its points.
    Assumes that the tree has been checked: runs inside the planes, at most LANES points, axis 0 to
    3, b leaf nodes.
    """
    first, is_leaf, cell_of = links
    count, axis, block_low = nodes
    cell_low, log2_size = cells
    block = np.uint64(0)
    bounds[0], bounds[1] = voxel_steps, -1
    for i in range(np.uint64(first.shape[0])):
        if not is_leaf[i]:
            continue
        cell, begin, held = np.uint64(cell_of[i]), np.uint64(first[i]), np.uint64(count[i])
        size = np.int64(1) << np.int64(log2_size[cell])
        for k in range(np.uint64(3)):
            out = lanes[block, k]
            _join(planes[np.uint64(2) * k], planes[np.uint64(2) * k + np.uint64(1)], begin, held, out)
            high = np.int64(_undo_delta(held, out) if np.uint64(axis[i]) == k else _greatest(out))
            low, corner = np.int64(block_low[k, i]), np.int64(cell_low[k, cell])
            high += low
            if high >= size or high + corner >= voxel_steps:
                return False
            bounds[0, k] = min(bounds[0, k], low + corner)
            bounds[1, k] = max(bounds[1, k], high + corner)
        block += np.uint64(1)
    return True


@nb.njit(nogil=True, cache=True)
def leaf_column(planes, links, count, lanes):
    """Write a column of two bytes per point to lanes (b, LANES) uint16, laid out like `leaf_lanes`.

    planes: (2, p) uint8.
    """
    first, is_leaf, _ = links
    block = np.uint64(0)
    for i in range(np.uint64(first.shape[0])):
        if is_leaf[i]:
            _join(planes[0], planes[1], np.uint64(first[i]), np.uint64(count[i]), lanes[block])
            block += np.uint64(1)


@nb.njit(nogil=True, cache=True)
def leaf_bytes(plane, links, count, lanes):
    """Write a column of one byte per point to lanes (b, LANES) uint8, laid out as in `leaf_lanes`.

    plane: (p,) uint8.
    Returns the greatest byte, and a uint32 with bit b set if some byte equals b modulo 32.
    """
    first, is_leaf, _ = links
    block = np.uint64(0)
    greatest, seen = np.uint8(0), np.uint32(0)
    for i in range(np.uint64(first.shape[0])):
        if not is_leaf[i]:
            continue
        out, begin, held = lanes[block], np.uint64(first[i]), np.uint64(count[i])
        for j in range(held):
            out[j] = plane[begin + j]
        for j in range(held, np.uint64(out.shape[0])):
            out[j] = out[held - np.uint64(1)]
        for j in range(np.uint64(out.shape[0])):
            greatest = max(greatest, out[j])
        for j in range(np.uint64(out.shape[0])):
            seen |= np.uint32(1) << np.uint32(out[j] & np.uint8(31))
        block += np.uint64(1)
    return greatest, seen


@nb.njit(nogil=True, cache=True)
def lanes_to_points(lanes, links, count, points):
    """Write the points (p, 3) uint16 from lanes (b, 3, LANES), each leaf node's at its run."""
    first, is_leaf, _ = links
    block = np.uint64(0)
    for i in range(np.uint64(first.shape[0])):
        if is_leaf[i]:
            for j in range(np.uint64(count[i])):
                for k in range(np.uint64(3)):
                    points[np.uint64(first[i]) + j, k] = lanes[block, k, j]
            block += np.uint64(1)
