"""Boxes around nodes: a node is bounded by its sphere, and by its slab or its box if that is tighter.

A slab bounds a flat patch of any direction, but only across it. A box bounds a node on all sides,
but only parallel to the axes. Which one is tighter depends on the node, so each node has the one
that leaves less room around its points. On the façade, whose walls are parallel to the axes, nine of
ten nodes have a box; turned by 30 degrees about the vertical, seven; tilted as well, one
(scripts/bench_engine --only boxes).

Boxes are computed when a voxel is loaded, from the points themselves, so every archive has them and
no archive can state them wrongly. A row that has a box holds, in place of the slab:

- the centre of the box, and the radius of a sphere around that centre;
- in the words of the slab's normal, half the edges of the box;
- -1 as the length of that normal, which marks the box; a length is positive otherwise;
- in the words of the slab's offsets, minus and plus half the shortest edge.

All are exact in float32, except the radius, which is rounded up: edges are below 2^21 steps.
"""

import math

import numpy as np

from ....schemas.runtime import compiling as nb
from .kernel_decorators import njit_inlined, njit_no_refcount
from .scene_arrays import COUNT, COUNTED, FIRST, LANES, ROW_WORDS

U = np.uint64  # see placed_avatar.py
# Bounds are compared by the room within this distance of them [m], about the radius of an avatar's
# leaf node. Other values were not tried.
ROOM = 0.02
ZERO = np.float32(0.0)


@njit_inlined
def has_box(words, row):
    """Return whether a row is bounded by a box instead of a slab."""
    return words[U(row) + U(7)] < ZERO


@njit_inlined
def box_square(words, row, dx, dy, dz):
    """Return the squared distance [steps^2] of a position from a node's box, 0 inside.

    dx, dy, dz: position relative to the centre of the row.
    """
    w = U(row)
    ex = max(abs(dx) - words[w + U(4)], ZERO)
    ey = max(abs(dy) - words[w + U(5)], ZERO)
    ez = max(abs(dz) - words[w + U(6)], ZERO)
    return ex * ex + ey * ey + ez * ez


@njit_no_refcount
def enter_box(words, row, ray, radius, first, last):
    """Return where a ray enters the box of a row, inflated by `radius`, in [first, last]; inf if nowhere.

    ray: as in `meet_node` of kernels/rays/hits.py. All distances in steps, float64.
    """
    for k in range(3):
        slope, off = ray[3 + k], np.float64(words[row + k]) - ray[k]
        wide = np.float64(words[row + 4 + k]) + radius
        if slope == 0.0:
            if abs(off) > wide:
                return np.inf
            continue
        # Where the ray enters and leaves the two sides; both rounded outwards.
        begin, end = (off - wide) / slope, (off + wide) / slope
        slack = (abs(begin) + abs(end)) * 2.0**-50
        first = max(first, min(begin, end) - slack)
        last = min(last, max(begin, end) + slack)
    return first if first <= last else np.inf


@nb.njit(nogil=True, cache=True)
def lay_boxes(nodes, block_words, step, arena, where):
    """Replace the slabs of a voxel's nodes by boxes where boxes are tighter.

    nodes: number of the voxel's nodes, in rows that `lay_out` wrote, with their points.
    block_words: of a block.  step: of the lattice [m].  where: (3,) int64, the voxel's runs.
    """
    words, ints, halves = arena
    boxes = np.empty((nodes, 6), np.int32)  # least x, y, z, greatest x, y, z
    room = ROOM / step
    for node in range(nodes - 1, -1, -1):  # children follow their parents
        row = where[0] + node * ROW_WORDS
        first = np.int64(ints[row + FIRST])
        if first < 0:
            _box_of_block(
                ints, halves, where[1] + ~first * block_words, where[2] + ~first * 3 * LANES, boxes, node
            )
        else:
            for k in range(6):
                boxes[node, k] = boxes[first, k]
            for child in range(first + 1, first + np.int64(ints[row + COUNT] & COUNTED)):
                for k in range(3):
                    boxes[node, k] = min(boxes[node, k], boxes[child, k])
                    boxes[node, 3 + k] = max(boxes[node, 3 + k], boxes[child, 3 + k])
        _lay_box(words, row, boxes[node], room)


@njit_no_refcount
def _box_of_block(ints, halves, block_at, lane_at, boxes, node):
    """Write the box of the points of a block. Lanes after the last point repeat it."""
    for k in range(3):
        least, most = np.int32(0xFFFF), np.int32(0)
        for lane in range(LANES):
            value = np.int32(halves[U(lane_at + k * LANES) + U(lane)])
            least, most = min(least, value), max(most, value)
        boxes[node, k] = ints[block_at + k] + least
        boxes[node, 3 + k] = ints[block_at + k] + most


@njit_no_refcount
def _lay_box(words, row, box, room):
    """Replace the slab of a row by its box if the box is tighter. room: `ROOM` [steps]."""
    volume, square, moved, shortest = 1.0, 0.0, 0.0, np.inf
    for k in range(3):
        half = 0.5 * (np.float64(box[3 + k]) - box[k])
        volume *= 2.0 * (half + room)
        square += half * half
        moved += (0.5 * (np.float64(box[3 + k]) + box[k]) - words[row + k]) ** 2
        shortest = min(shortest, half)
    around = np.float64(words[row + 3]) + room
    of_slab = 4.0 / 3.0 * math.pi * around**3
    if words[row + 4] != ZERO or words[row + 5] != ZERO or words[row + 6] != ZERO:
        thick = (np.float64(words[row + 9]) - words[row + 8]) / words[row + 7]
        of_slab = min(of_slab, math.pi * around * around * (thick + 2.0 * room))
    if volume >= of_slab:
        return
    # Two steps of float32 upwards cover the rounding of the root and of the sum.
    radius = min(math.sqrt(square), np.float64(words[row + 3]) + math.sqrt(moved)) * (1.0 + 2.0**-22)
    for k in range(3):
        words[row + k] = np.float32(0.5 * (np.float64(box[3 + k]) + box[k]))
        words[row + 4 + k] = np.float32(0.5 * (np.float64(box[3 + k]) - box[k]))
    words[row + 3] = np.float32(radius)
    words[row + 7] = np.float32(-1.0)
    words[row + 8], words[row + 9] = np.float32(-shortest), np.float32(shortest)
