"""The rows of a record: their byte planes, and the points of leaf nodes as deltas along the axis they are sorted by.

Loops that should become vector code run to a length known only at run time: LLVM unrolls a loop of 32 constant trips
over bytes and halfwords and then leaves it scalar (3 times as slow). And they index by uint64: numba gives signed
indices a wrap-around check, and LLVM then loads element by element.
"""

import numpy as np

from . import compiling as nb

# Points of a leaf node side by side, all of a vector test; MAX_LEAF of schemas/voxel.py.
LANES = 32
# Written instead of a leaf node's sort axis: its points are no deltas.
NO_AXIS = 3


@nb.njit(nogil=True, cache=True)
def delta_along(points, first, count, axis):
    """Points (p, 3) uint16 with the sort axis of each run replaced by steps from the point before it.

    first, count, axis: (r,) int64, the runs (leaf nodes); along `axis` a run ascends. Returns a new array.
    """
    deltas = points.copy()
    for run in range(first.shape[0]):
        a, k = first[run], axis[run]
        for i in range(a + 1, a + count[run]):
            deltas[i, k] = points[i, k] - points[i - 1, k]
    return deltas


@nb.njit(nogil=True, cache=True)
def join_planes(planes, words):
    """Join byte planes (k w, n) uint8, low bytes first, to words (k, n) of w bytes, unsigned: HDF5's shuffle undone."""
    width = np.uint64(planes.shape[0] // words.shape[0])
    for k in range(np.uint64(words.shape[0])):
        out, first = words[k], planes[k * width]
        for i in range(np.uint64(out.shape[0])):
            out[i] = first[i]
        for b in range(np.uint64(1), width):
            plane, shift = planes[k * width + b], out.dtype.type(8 * b)
            for i in range(np.uint64(out.shape[0])):
                out[i] |= out.dtype.type(plane[i]) << shift


@nb.njit(nogil=True, inline="always")
def _join(low, high, begin, count, out):
    """out[j] = low[begin + j] + 256 high[begin + j] for j below count; the last one repeated to the end of out."""
    for j in range(count):
        out[j] = np.uint16(low[begin + j]) | (np.uint16(high[begin + j]) << np.uint16(8))
    for j in range(count, np.uint64(out.shape[0])):
        out[j] = out[count - np.uint64(1)]


@nb.njit(nogil=True, inline="always")
def _undo_delta(count, out):
    """Running sums of out[:count], the last one repeated to the end of out. Returns the last, which is the greatest.

    Beyond 2^16 what is written wraps and what is returned does not.
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
    """The greatest of values (m,) uint16."""
    most = np.uint16(0)
    for j in range(np.uint64(values.shape[0])):
        most = max(most, values[j])
    return most


@nb.njit(nogil=True, cache=True)
def leaf_lanes(planes, links, nodes, cells, voxel_steps, lanes, bounds):
    """Read the points of every leaf node, undo their deltas, and check that they lie in their cell and voxel.

    planes: (6 or more, p) uint8: low and high bytes of x, y, z.  links: (first, is_leaf, cell) of schemas/voxel.py.
    nodes: (count, axis, block_low) (n,), (n,), (3, n); axis NO_AXIS: no deltas.  cells: (low (3, c), log2_size (c,)).
    Writes lanes (b, 3, LANES) uint16: x[], y[], z[] of each leaf node's points from its block_low, in the order of
    the rows, the last one repeated to the end. Returns whether all lie inside; stops at the first that does not.
    Writes bounds (2, 3) int64: the least low corner of a leaf node's box and the greatest coordinate of a point
    [voxel steps]. The low corner of a box is the least coordinate of its points in a record that follows FORMAT.md.
    Assumes that the tree has been checked: runs inside the planes, at most LANES points, axis 0 to 3, b leaf nodes.
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
    """A column of two bytes a point as `leaf_lanes` lays it out: lanes (b, LANES) uint16 from planes (2, p) uint8."""
    first, is_leaf, _ = links
    block = np.uint64(0)
    for i in range(np.uint64(first.shape[0])):
        if is_leaf[i]:
            _join(planes[0], planes[1], np.uint64(first[i]), np.uint64(count[i]), lanes[block])
            block += np.uint64(1)


@nb.njit(nogil=True, cache=True)
def leaf_bytes(plane, links, count, lanes):
    """A column of one byte a point as `leaf_lanes` lays it out: lanes (b, LANES) uint8 from plane (p,) uint8.

    Returns the greatest byte, and a uint32 with bit b set where a byte is b, modulo 32.
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
    """Write the points (p, 3) uint16 of lanes (b, 3, LANES), each leaf node's where its run is."""
    first, is_leaf, _ = links
    block = np.uint64(0)
    for i in range(np.uint64(first.shape[0])):
        if is_leaf[i]:
            for j in range(np.uint64(count[i])):
                for k in range(np.uint64(3)):
                    points[np.uint64(first[i]) + j, k] = lanes[block, k, j]
            block += np.uint64(1)
