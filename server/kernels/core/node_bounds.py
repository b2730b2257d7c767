"""Bounds of a node of the scene's tree, and their overlap with a placed avatar.

A test compares float32 distances with a threshold that includes all errors: a node that holds a
point in reach always passes. Pairs of points below `near` touch, pairs above `far` do not; pairs
between them need integers (`pair_in_reach`).

A node is bounded by its sphere, and by its slab or its box if that is tighter. A slab bounds a flat
patch of any direction, but only across it. A box bounds a node on all sides, but only parallel to
the axes. Which one is tighter depends on the node, so each node has the one that leaves less room
around its points. On the façade, whose walls are parallel to the axes, nine of ten nodes have a box;
turned by 30 degrees about the vertical, seven; tilted as well, one (scripts/bench_engine --only
boxes).

Boxes are computed when a voxel is loaded, from the points themselves, so every archive has them and
no archive can state them wrongly. A row that has a box holds, in place of the slab:

- the centre of the box, and the radius of a sphere around that centre;
- in the words of the slab's normal, half the edges of the box;
- -1 as the length of that normal, which marks the box; a length is positive otherwise;
- in the words of the slab's offsets, minus and plus half the shortest edge.

All are exact in float32, except the radius, which is rounded up: edges are below 2^21 steps.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ....schemas.archive.voxel import MAX_LEVELS
from ....schemas.runtime import compiling as nb
from .kernel_decorators import njit_inlined, njit_no_refcount
from .placed_avatar import pad_list
from .scene_arrays import COUNT, COUNTED, FIRST, LANES, ROW_WORDS

U = np.uint64  # see placed_avatar.py
U32 = 2.0**-24  # half a unit in the last place of 1, float32
# Relative slack of a float32 test: more than 16 U32, while the sums below need at most 8.
SLACK = np.float32(1e-6)
ONE_SLACK = np.float32(1.0 + 2e-6)
# A pair is pushed for each child of one of its nodes: at most 15 a level stay behind on the stack.
# This size holds two trees of MAX_LEVELS.
STACK = 2 * MAX_LEVELS * 15 + 16
# A scene node is called flat if its slab is thinner than this many radii of an avatar's leaf node;
# the avatar's points are then tested against it at once. Values from 0.5 to 2 take the same time on
# the walk; 8 takes a fifth more.
FLAT = np.float32(1.0)
# A scene node of more than this many radii of the avatar's root is tested against the root only,
# because most of the front's nodes would meet it.
BROAD = np.float32(2.0)
# Bounds are compared by the room within this distance of them [m], about the radius of an avatar's
# leaf node. Other values were not tried.
ROOM = 0.02
ZERO = np.float32(0.0)


class Thresholds(NamedTuple):
    """Thresholds of one pose.

    reach, error: [steps], float32, rounded up.  near, far: squares, float32. A pair below `near`
    touches, a pair above `far` does not.
    units: r_a + r_b + margin, exact units, int64.
    """

    reach: np.float32
    error: np.float32
    near: np.float32
    far: np.float32
    units: np.int64


class ClassThresholds(NamedTuple):
    """Thresholds of one pose by radius class; scratch of one call. As long as `radius_deficit`.

    threshold: reach plus error, float32 [steps].  near, far, units: as in `Thresholds`.
    mask: the number of classes minus one, uint64, for `node_class` and `point_class`.
    """

    threshold: NDArray[np.float32]
    near: NDArray[np.float32]
    far: NDArray[np.float32]
    units: NDArray[np.int64]
    mask: np.uint64


class VoxelLocation(NamedTuple):
    """Location of one voxel.

    rows, blocks, lanes: its first row, block and lane in the arena.
    x, y, z: its low corner relative to the frame, float32.
    """

    rows: int
    blocks: int
    lanes: int
    x: np.float32
    y: np.float32
    z: np.float32


@nb.njit(nogil=True, cache=True)
def make_class_thresholds(deficit):
    """Allocate scratch for the radius classes of `SceneArrays.radius_deficit`."""
    n = deficit.shape[0]
    threshold, near, far = np.empty(n, np.float32), np.empty(n, np.float32), np.empty(n, np.float32)
    return ClassThresholds(threshold, near, far, np.empty(n, np.int64), np.uint64(n - 1))


@njit_no_refcount
def set_class_thresholds(by_class, scene, units, extent, farthest):
    """Compute the thresholds of one pose for each radius class.

    Arguments as for `make_thresholds`; `units` is for the largest radius. Returns the largest error.
    """
    error = np.float32(0.0)
    for c in range(scene.radius_deficit.shape[0]):
        thresholds = make_thresholds(
            units - scene.radius_deficit[c], scene.units_per_step, extent, farthest, scene.voxel_steps
        )
        by_class.threshold[c] = thresholds.reach + thresholds.error
        by_class.near[c], by_class.far[c] = thresholds.near, thresholds.far
        by_class.units[c] = thresholds.units
        error = max(error, thresholds.error)
    return error


@njit_no_refcount
def make_thresholds(units, units_per_step, extent, farthest, voxel_steps):
    """Compute the thresholds for a reach of `units`.

    extent: largest distance of placed avatar points from the frame [steps].  farthest: the largest
    term of a placed coordinate.
    Errors of a coordinate difference, in steps:
    - rounding to exact units: half a unit for each of the two points;
    - float32 of the avatar's coordinate: U32 of its size, once relative to the frame and once
      relative to the voxel or block. There a pair in reach is within the larger of voxel and block,
      plus the reach (doubled, so that a pair beyond reach cannot pass as near);
    - float64 rounding far from the origin: 4 half units in the last place for a placed centre, 4
      for a point below it, 1 for the frame, 1 for the lattice point: 10 * 2^-53 of the largest
      term.
    """
    reach = np.float64(units) / units_per_step
    error = (
        1.1 / units_per_step
        + U32 * (extent + 2.0 * (max(65536.0, voxel_steps) + reach))
        + farthest * 2.0**-49
    )
    around = math.sqrt(3.0) * error
    below = max(reach * (1.0 - 2.0 * U32) - around, 0.0)
    above = reach * (1.0 + 2.0 * U32) + around
    near = np.float32(below * below * (1.0 - 8.0 * U32))
    far = np.float32(above * above * (1.0 + 8.0 * U32))
    # One float32 step outward covers the rounding to float32. At 0, nothing is certified near.
    near = np.nextafter(near, np.float32(-1.0)) if below > 0.0 else np.float32(-1.0)
    return Thresholds(
        np.nextafter(np.float32(reach), np.float32(np.inf)),
        np.nextafter(np.float32(around), np.float32(np.inf)),
        near,
        np.nextafter(far, np.float32(np.inf)),
        np.int64(units),
    )


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


@njit_no_refcount
def nodes_meet(words, row, x, y, z, radius, threshold):
    """Return whether a sphere may come within `threshold` of a node's points, by the node's bounds.

    x, y, z: float32, relative to the voxel's low corner.  threshold: reach plus error. Tests the
    sphere as in [Fig12] line 2, and the slab or the box.
    """
    w = U(row)
    dx, dy, dz = x - words[w], y - words[w + U(1)], z - words[w + U(2)]
    span = radius + threshold
    both = words[w + U(3)] + span
    if has_box(words, row):
        outside = span + SLACK * both + SLACK * both
        return (dx * dx + dy * dy + dz * dz <= both * both * ONE_SLACK) & (
            box_square(words, row, dx, dy, dz) <= outside * outside * ONE_SLACK
        )
    along = words[w + U(4)] * dx + words[w + U(5)] * dy + words[w + U(6)] * dz
    # The sphere test decides beyond `both`; the rounding of `along` is therefore at most SLACK of
    # it.
    wide = words[w + U(7)] * (span + SLACK * both + SLACK * both)
    # One branch on all three costs less than three branches that are hard to predict.
    return (
        (dx * dx + dy * dy + dz * dz <= both * both * ONE_SLACK)
        & (along <= words[w + U(9)] + wide)
        & (along >= words[w + U(8)] - wide)
    )


@njit_inlined
def power_distance(words, row, x, y, z):
    """Return the power distance of a position from a node's sphere, |x - c|^2 - r^2 [steps^2].

    x, y, z: float32, relative to the voxel's low corner. It only orders nodes, so its rounding does
    not matter.
    """
    w = U(row)
    dx, dy, dz = x - words[w], y - words[w + U(1)], z - words[w + U(2)]
    return dx * dx + dy * dy + dz * dz - words[w + U(3)] * words[w + U(3)]


@njit_inlined
def mark_meeting(words, row, bounds, at, steps, off_x, off_y, off_z, threshold, keep):
    """Mark in `keep` the nodes of a list that meet the scene node `row`.

    The test is that of `nodes_meet`.
    at: the start of the list.  steps: its length in units of LANES nodes.  off: from the frame to
    the voxel's low corner.  threshold: reach plus error. Returns whether any node meets.
    """
    w = U(row)
    cx, cy, cz = words[w] + off_x, words[w + U(1)] + off_y, words[w + U(2)] + off_z
    radius = words[w + U(3)]
    nx, ny, nz, length = words[w + U(4)], words[w + U(5)], words[w + U(6)], words[w + U(7)]
    low, high = words[w + U(8)], words[w + U(9)]
    any_meets = False
    begin, to = U(at), U(0)
    if length < np.float32(0.0):
        for _ in range(steps):
            for j in range(LANES):
                i = begin + U(j)
                dx, dy, dz = bounds[0, i] - cx, bounds[1, i] - cy, bounds[2, i] - cz
                span = bounds[3, i] + threshold
                both = radius + span
                outside = span + (SLACK * both + SLACK * both)
                meets = (dx * dx + dy * dy + dz * dz <= both * both * ONE_SLACK) & (
                    box_square(words, row, dx, dy, dz) <= outside * outside * ONE_SLACK
                )
                keep[to + U(j)] = meets
                any_meets |= meets
            begin += U(LANES)
            to += U(LANES)
        return any_meets
    for _ in range(steps):
        for j in range(LANES):
            i = begin + U(j)
            dx, dy, dz = bounds[0, i] - cx, bounds[1, i] - cy, bounds[2, i] - cz
            span = bounds[3, i] + threshold
            both = radius + span
            along = nx * dx + ny * dy + nz * dz
            wide = length * (span + (SLACK * both + SLACK * both))
            meets = (
                (dx * dx + dy * dy + dz * dz <= both * both * ONE_SLACK)
                & (along <= high + wide)
                & (along >= low - wide)
            )
            keep[to + U(j)] = meets
            any_meets |= meets
        begin += U(LANES)
        to += U(LANES)
    return any_meets


@njit_inlined
def compact_marked(bounds, which, keep, keep8, at, steps, to):
    """Write the marked nodes of the list at `at` as a new list at `to`. Returns its length."""
    n = U(to)
    for eight in range(4 * steps):
        if keep8[U(eight)] == U(0):
            continue
        for j in range(8 * eight, 8 * eight + 8):
            if keep[U(j)]:
                copy_node(bounds, which, U(at) + U(j), n)
                n += U(1)
    count = np.int64(n) - to
    pad_list(bounds, to + count, to + (count + LANES - 1) // LANES * LANES)
    return count


@njit_no_refcount
def copy_node(bounds, which, at, to):
    """Copy one node of the lists; at, to: uint64."""
    bounds[0, to] = bounds[0, at]
    bounds[1, to] = bounds[1, at]
    bounds[2, to] = bounds[2, at]
    bounds[3, to] = bounds[3, at]
    which[to] = which[at]


@njit_inlined
def lanes_meet(words, row, lanes, block, off_x, off_y, off_z, threshold, keep):
    """Mark in `keep` the points of an avatar's block within `threshold` of a node's bounds.

    lanes: relative to the frame.  threshold: reach plus error.  row: a scene node. Returns whether
    any point is marked.
    """
    w = U(row)
    cx, cy, cz = words[w] + off_x, words[w + U(1)] + off_y, words[w + U(2)] + off_z
    nx, ny, nz = words[w + U(4)], words[w + U(5)], words[w + U(6)]
    both = words[w + U(3)] + threshold
    wide = words[w + U(7)] * (threshold + SLACK * both + SLACK * both)
    low, high = words[w + U(8)] - wide, words[w + U(9)] + wide
    square = both * both * ONE_SLACK
    b = U(block)
    any_meets = False
    if has_box(words, row):
        outside = threshold + SLACK * both + SLACK * both
        outside = outside * outside * ONE_SLACK
        for j in range(LANES):
            dx, dy, dz = lanes[b, 0, U(j)] - cx, lanes[b, 1, U(j)] - cy, lanes[b, 2, U(j)] - cz
            meets = (dx * dx + dy * dy + dz * dz <= square) & (box_square(words, row, dx, dy, dz) <= outside)
            keep[U(j)] = meets
            any_meets |= meets
        return any_meets
    for j in range(LANES):
        dx, dy, dz = lanes[b, 0, U(j)] - cx, lanes[b, 1, U(j)] - cy, lanes[b, 2, U(j)] - cz
        along = nx * dx + ny * dy + nz * dz
        meets = (dx * dx + dy * dy + dz * dz <= square) & (along <= high) & (along >= low)
        keep[U(j)] = meets
        any_meets |= meets
    return any_meets


@njit_no_refcount
def next_near(halves, lane_at, low_x, low_y, low_z, lanes, block, far, keep, keep8, begin):
    """Find the first marked point, from `begin` on, that may be near a point of a scene block.

    The points are those of an avatar's block.  lane_at: the scene block in `halves`.  low: its
    corner, relative to the frame.  far: a square, see `Thresholds`. Returns (lane or -1, number of
    points tested against the block).
    """
    h, b = U(lane_at), U(block)
    tested = 0
    for eight in range(begin // 8, LANES // 8):
        if keep8[U(eight)] == U(0):
            continue
        for lane in range(8 * eight, 8 * eight + 8):
            if lane < begin or not keep[U(lane)]:
                continue
            tested += 1
            x, y, z = lanes[b, 0, U(lane)] - low_x, lanes[b, 1, U(lane)] - low_y, lanes[b, 2, U(lane)] - low_z
            touched = False
            for j in range(LANES):
                i = h + U(j)
                dx = np.float32(halves[i]) - x
                dy = np.float32(halves[i + U(LANES)]) - y
                dz = np.float32(halves[i + U(2 * LANES)]) - z
                touched |= dx * dx + dy * dy + dz * dz <= far
            if touched:
                return lane, tested
    return -1, tested


@njit_no_refcount
def write_squares(halves, lane_at, x, y, z, squares):
    """Write the squared distances (LANES,) of a block's points from a place; return the least.

    x, y, z: float32, relative to the block's low corner, as the points are.
    """
    # Unsigned: numba does not vectorise an index that may be negative (70 ns instead of 5 for 32
    # lanes).
    at_x = U(lane_at)
    at_y, at_z = at_x + U(LANES), at_x + U(2 * LANES)
    # The bits of non-negative floats sort like the numbers. The minimum of integers is vectorised;
    # that of floats is not, because LLVM must allow for a NaN.
    least = np.int32(0x7F800000)
    for lane in range(LANES):
        j = U(lane)
        dx, dy = np.float32(halves[at_x + j]) - x, np.float32(halves[at_y + j]) - y
        dz = np.float32(halves[at_z + j]) - z
        square = np.float32(dx * dx + dy * dy + dz * dz)
        squares[j] = square
        least = min(least, square.view(np.int32))
    return np.int32(least).view(np.float32)


@njit_inlined
def locate_block(ints, location, row, block_words):
    """Locate the block of a leaf node: its place in `ints` and in `halves`, and its low corner.

    The corner is relative to the frame, float32.  location: of its voxel.
    """
    number = ~np.int64(ints[U(row + FIRST)])
    block_at = location.blocks + number * block_words
    return (
        block_at,
        location.lanes + number * 3 * LANES,
        location.x + np.float32(ints[U(block_at)]),
        location.y + np.float32(ints[U(block_at + 1)]),
        location.z + np.float32(ints[U(block_at + 2)]),
    )


@njit_no_refcount
def locate_voxel(scene, voxel, placed):
    """Locate a resident voxel in the arena and relative to the frame."""
    corners, where, frame = scene.corners, scene.where, placed.frame
    return VoxelLocation(
        where[voxel, 0],
        where[voxel, 1],
        where[voxel, 2],
        np.float32(corners[voxel, 0] - frame[0]),
        np.float32(corners[voxel, 1] - frame[1]),
        np.float32(corners[voxel, 2] - frame[2]),
    )


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
