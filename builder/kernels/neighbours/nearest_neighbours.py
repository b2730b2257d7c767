"""Closest points of each of many points, among distinct points in Morton order; exact over integers.

The points form blocks of BLOCK, boxes of FAN blocks, boxes of FAN of those, and so on. Only the
boxes are stored, no tree. The search visits the blocks beside a point first, which limits the boxes
that it must open afterwards.
"""

import numpy as np

from ....schemas.runtime import compiling as nb

BLOCK = 16
FAN = 8
# Boxes on the stack while one path to a block is followed: FAN - 1 per level and the block, 22
# levels for 2^63 points.
STACK = 22 * FAN


@nb.njit(nogil=True, cache=True)
def box_starts(count):
    """Return where each level of boxes over `count` points begins, and the total: (levels + 1,).

    The first level holds the blocks.
    """
    starts = np.zeros(32, np.int64)
    boxes, levels = (count + BLOCK - 1) // BLOCK, 0
    while True:
        starts[levels + 1] = starts[levels] + boxes
        levels += 1
        if boxes <= 1:
            return starts[: levels + 1].copy()
        boxes = (boxes + FAN - 1) // FAN


@nb.njit(nogil=True, cache=True)
def bound_boxes(points, starts):
    """Return the boxes (b, 6) int32 of points (n, 3) int32, n >= 1: least, then greatest coordinates.

    starts: of `box_starts`.
    """
    boxes = np.empty((starts[-1], 6), np.int32)
    for box in range(starts[1]):
        first = box * BLOCK
        for k in range(3):
            low = high = points[first, k]
            for i in range(first + 1, min(first + BLOCK, points.shape[0])):
                low, high = min(low, points[i, k]), max(high, points[i, k])
            boxes[box, k], boxes[box, 3 + k] = low, high
    for level in range(1, starts.shape[0] - 1):
        for box in range(starts[level], starts[level + 1]):
            first = starts[level - 1] + (box - starts[level]) * FAN
            for k in range(3):
                low, high = boxes[first, k], boxes[first, 3 + k]
                for child in range(first + 1, min(first + FAN, starts[level])):
                    low, high = min(low, boxes[child, k]), max(high, boxes[child, 3 + k])
                boxes[box, k], boxes[box, 3 + k] = low, high
    return boxes


@nb.njit(nogil=True, cache=True, inline="always")
def _box_distance2(boxes, box, x, y, z):
    """Return the squared distance of a point from a box; 0 inside it."""
    dx = max(max(np.int64(boxes[box, 0]) - x, x - np.int64(boxes[box, 3])), np.int64(0))
    dy = max(max(np.int64(boxes[box, 1]) - y, y - np.int64(boxes[box, 4])), np.int64(0))
    dz = max(max(np.int64(boxes[box, 2]) - z, z - np.int64(boxes[box, 5])), np.int64(0))
    return dx * dx + dy * dy + dz * dz


@nb.njit(nogil=True, cache=True)
def _insert(closest, held, d2, dx, dy, dz):
    """Insert an entry into closest[:held] (k, 4), sorted by (d2, dx, dy, dz).

    A full list drops its last entry. Returns the new number of entries.
    """
    k = closest.shape[0]
    at = min(held, k)
    while at > 0:
        before = closest[at - 1]
        if before[0] < d2 or (
            before[0] == d2
            and (
                before[1] < dx
                or (before[1] == dx and (before[2] < dy or (before[2] == dy and before[3] < dz)))
            )
        ):
            break
        if at < k:
            for j in range(4):
                closest[at, j] = before[j]
        at -= 1
    if at < k:
        closest[at, 0], closest[at, 1], closest[at, 2], closest[at, 3] = d2, dx, dy, dz
    return min(held + 1, k)


@nb.njit(nogil=True, cache=True)
def _search_block(points, block, i, closest, held, limit2):
    """Insert the points of a block into the closest of point i. Returns the new number of entries."""
    x, y, z = np.int64(points[i, 0]), np.int64(points[i, 1]), np.int64(points[i, 2])
    k = closest.shape[0]
    bound = closest[k - 1, 0] if held == k else limit2
    for j in range(block * BLOCK, min((block + 1) * BLOCK, points.shape[0])):
        dx, dy, dz = points[j, 0] - x, points[j, 1] - y, points[j, 2] - z
        d2 = dx * dx + dy * dy + dz * dz
        if d2 <= bound and j != i:
            held = _insert(closest, held, d2, dx, dy, dz)
            if held == k:
                bound = closest[k - 1, 0]
    return held


@nb.njit(nogil=True, cache=True)
def closest_distinct(points, boxes, starts, i, limit2, closest, stack):
    """Find the k closest points of point i within a distance; return their number, at most k.

    points: (n, 3) int32 [steps], distinct, in an order that keeps neighbours close.
    boxes, starts: of these points.
    limit2: the greatest squared distance, inclusive, int64.
    stack: (STACK, 2) int64, work space.
    Writes the first rows of closest (k, 4) int64: squared distance and dx, dy, dz from the point,
    sorted by all four. Of equally distant points those with lesser coordinates are therefore taken,
    whatever the order of points.
    """
    x, y, z = np.int64(points[i, 0]), np.int64(points[i, 1]), np.int64(points[i, 2])
    k, own = closest.shape[0], i // BLOCK
    first, last = max(own - 1, 0), min(own + 1, starts[1] - 1)
    held = _search_block(points, own, i, closest, 0, limit2)
    for block in range(first, last + 1):
        if block != own:
            held = _search_block(points, block, i, closest, held, limit2)
    level = starts.shape[0] - 2
    stack[0, 0], stack[0, 1] = level, starts[level]
    depth = 1
    while depth > 0:
        depth -= 1
        level, box = stack[depth, 0], stack[depth, 1]
        bound = closest[k - 1, 0] if held == k else limit2
        if _box_distance2(boxes, box, x, y, z) > bound:
            continue
        if level == 0:
            if not first <= box <= last:
                held = _search_block(points, box, i, closest, held, limit2)
            continue
        child = starts[level - 1] + (box - starts[level]) * FAN
        base = depth
        nearest, least = -1, np.int64(0)
        for c in range(child, min(child + FAN, starts[level])):
            distance2 = _box_distance2(boxes, c, x, y, z)
            if distance2 <= bound:
                if nearest < 0 or distance2 < least:
                    nearest, least = depth, distance2
                stack[depth, 0], stack[depth, 1] = level - 1, c
                depth += 1
        if depth - base > 1 and nearest != depth - 1:  # open the closest first: it bounds the others
            swap = stack[nearest, 1]
            stack[nearest, 1] = stack[depth - 1, 1]
            stack[depth - 1, 1] = swap
    return held
