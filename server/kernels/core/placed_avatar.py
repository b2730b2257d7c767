"""Avatar under one pose: placement of its points and nodes by the formula of NUMERICS.md N5.

A placed coordinate is ((r0 p0 + r1 p1) + r2 p2) + (t - O), float64, in this order, without
contraction. Multiplied by 2^26 (exact) and rounded half to even, it is the integer that decides.
Compiled and interpreted code agree bit for bit.

A placed avatar holds float32 distances in lattice steps from the frame, a lattice point near it.
Relative to the frame, scene coordinates are integers below 2^24 and therefore exact in float32. The
placed avatar has a rounding error, which every bound includes (node_bounds.py). Where float32
cannot decide, the integers do: `pair_square`.

Two pairs compare by their separation, sqrt(D) - R: D is the squared distance of the centres and R
the sum of the radii, both integers in exact units. Most separations are therefore irrational. Where
all radii are the same, the squares alone decide. Where they differ, float64 nearly always decides.
Where it cannot, the roots are eliminated by squaring, and integers of 128 bits are compared.

The *front* is one level of the avatar's tree as a flat list. A descent of two trees tests one pair
of nodes at a time and branches after each test. Here only the scene's tree is descended. Each of
its nodes is tested against the list of those front nodes that met its parent: 32 in a vector step,
in the time of one or two single tests. For the figure of 3,617 points the front is its 114 leaf
nodes.

Indices are np.uint64 wherever vectorisation matters. LLVM assumes that a signed index may be
negative; it then computes an address for each lane and loads each lane separately (six times
slower, scripts/bench_engine's `collide`).
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ....schemas.archive.units import UNITS_PER_METRE
from ....schemas.archive.voxel import MAX_LEVELS
from ....schemas.runtime import compiling as nb
from .kernel_decorators import njit_inlined, njit_no_refcount
from .scene_arrays import LANES

U = np.uint64
# Distances are compared in exact units whose squares must fit 63 bits (NUMERICS.md N5): 16 m.
MAX_REACH_UNITS = 1 << 30
# The front of a larger avatar consists of inner nodes. 256 are eight vector steps.
MAX_FRONT = 256
# One list is written for each level of the descent; none is longer than the list above it.
LIST_CAPACITY = MAX_FRONT * (MAX_LEVELS + 2)
# Coordinate of the entries that pad a list to whole vector steps. With radius 0, no test keeps a
# node this far away.
FAR_AWAY = np.float32(1e30)
# Two separations whose float64 values differ by more than this are in that order. Squares are below
# 2^62, so a root is off by at most half of 2^-22 for its rounding and 2^-54 of itself for that of
# the square: 2.3e-7. Two of them and a sum stay below 6e-7. The last difference is exact where it
# is small.
CERTAIN = 2.0**-19
_LOW = np.uint64(0xFFFFFFFF)
_HALF = np.uint64(32)


class Avatar(NamedTuple):
    """BSH of an avatar as the kernels read it; a nodes, b leaf nodes.

    center: (a, 3), radius: (a,) float64, avatar frame [m], rounded outward.
    first: (a,) int32, first child, or ~block for a leaf node.  count: (a,) int32, children or
    points.
    points: (b, 3, LANES) float64 [m], as the client sent them, the last one repeated.
    front: (4, f) float64, x[], y[], z[], radius[] of one level of the tree, see placed_avatar.py.
    front_first: its first node.
    inner_points: number of the points that fill a mesh.
    """

    center: NDArray[np.float64]
    radius: NDArray[np.float64]
    first: NDArray[np.int32]
    count: NDArray[np.int32]  # type: ignore[assignment]  # hides tuple.count, which nobody calls
    points: NDArray[np.float64]
    front: NDArray[np.float64]
    front_first: int
    inner_points: int


class PlacedAvatar(NamedTuple):
    """Avatar under one pose, float32 steps from `frame`, a lattice point; scratch of one call.

    nodes: (4, a): x[], y[], z[], radius[], rounded outward.  lanes: (b, 3, LANES), points.
    stamp: (b,) int64, the pose a block was placed for. Blocks are placed when first reached; most
    are never reached.
    frame: (3,) int64.  shift: (3,) float64, t - O.
    """

    nodes: NDArray[np.float32]
    lanes: NDArray[np.float32]
    stamp: NDArray[np.int64]
    frame: NDArray[np.int64]
    shift: NDArray[np.float64]


class AvatarFront(NamedTuple):
    """Lists of placed front nodes, one after another; scratch of one call.

    bounds: (4, LIST_CAPACITY) float32: x[], y[], z[] from the frame, radius[] [steps], rounded
    outward.
    which: (LIST_CAPACITY,) int32, numbers in the front.
    keep: (MAX_FRONT,) bool, marks; keep8: the same memory as uint64, eight marks each.
    """

    bounds: NDArray[np.float32]
    which: NDArray[np.int32]
    keep: NDArray[np.bool_]
    keep8: NDArray[np.uint64]


@njit_no_refcount
def place(m, shift, r, x, y, z):
    """Return coordinate r of an avatar point placed by pose m, from the dataset's origin [m].

    shift: t - O (3,).
    """
    return ((m[r, 0] * x + m[r, 1] * y) + m[r, 2] * z) + shift[r]


@njit_no_refcount
def largest_term(m, shift, x, y, z):
    """Return the largest sum of the absolute values of the terms of a placed coordinate [m].

    2^-50 of it bounds the rounding of `place` for this point and for one next to it, also where
    large terms cancel.
    """
    largest = 0.0
    for r in range(3):
        size = abs(m[r, 0] * x) + abs(m[r, 1] * y) + abs(m[r, 2] * z) + abs(shift[r])
        largest = max(largest, size)
    return largest


@njit_no_refcount
def to_units(metres):
    """Convert a placed coordinate to exact units: times 2^26, half to even, int64."""
    return np.int64(np.rint(metres * UNITS_PER_METRE))


@njit_no_refcount
def lattice_to_units(steps, units_per_step):
    """Convert a lattice coordinate to exact units: one float64 product, half to even, int64."""
    return np.int64(np.rint(np.float64(steps) * units_per_step))


@njit_no_refcount
def _from_frame(world, frame, step):
    """Return a placed coordinate [m] relative to that of the frame [steps], float32."""
    return np.float32((world - np.float64(frame) * step) * (1.0 / step))


@njit_no_refcount
def place_root(avatar, m, placed, scene):
    """Choose the frame and place an avatar's root; fill placed.frame, shift and node 0.

    Returns (extent, farthest) for `make_thresholds`, of the whole avatar.
    """
    per_step = 1.0 / scene.step
    x, y, z = avatar.center[0, 0], avatar.center[0, 1], avatar.center[0, 2]
    extent = avatar.radius[0] * per_step + 1.0
    for r in range(3):
        placed.shift[r] = m[r, 3] - scene.origin[r]
        root = place(m, placed.shift, r, x, y, z)
        placed.frame[r] = np.int64(np.rint(root * per_step))
        placed.nodes[r, 0] = _from_frame(root, placed.frame[r], scene.step)
    placed.nodes[3, 0] = node_reach(avatar.radius[0], per_step, extent)
    return extent, largest_term(m, placed.shift, x, y, z) * per_step + extent


@njit_no_refcount
def node_reach(radius, per_step, extent):
    """Return the radius [steps] of a placed node, rounded outward.

    per_step: lattice steps a metre. The slack of 1e-6 covers the float32 centre, which
    is off by at most U32 of `extent`, and the radius, off by U32 of itself.
    """
    return np.float32(radius * per_step * (1.0 + 1e-6) + extent * 1e-6)


@njit_no_refcount
def place_nodes(avatar, m, placed, scene):
    """Place all nodes of an avatar; fill placed.frame, shift and nodes.

    Returns (extent, farthest), as `place_root` does.
    """
    extent, farthest = place_root(avatar, m, placed, scene)
    step = scene.step
    per_step = 1.0 / step
    nodes = placed.nodes
    for r in range(3):
        base = np.float64(placed.frame[r]) * step
        for i in range(1, avatar.center.shape[0]):
            world = place(m, placed.shift, r, avatar.center[i, 0], avatar.center[i, 1], avatar.center[i, 2])
            nodes[r, i] = np.float32((world - base) * per_step)
    for i in range(1, avatar.center.shape[0]):
        nodes[3, i] = node_reach(avatar.radius[i], per_step, extent)
    return extent, farthest


@nb.njit(nogil=True, cache=True)
def empty_lines(n):
    """Return n float32 that begin at a cache line.

    numba's arrays begin at a multiple of 32 bytes, and vectors of 64 bytes then may cross a line each.
    Five processes took 6.8 to 7.5 ms for `distance` on the walk, and 7.0 to 7.2 with this.
    """
    raw = np.empty(n + 16, np.float32)
    first = -raw.ctypes.data % 64 // 4
    return raw[first : first + n]


@nb.njit(nogil=True, cache=True)
def make_front(avatar):
    """Allocate scratch for one avatar (not empty); nothing is placed yet."""
    which = np.empty(LIST_CAPACITY, np.int32)
    for i in range(avatar.front.shape[1]):
        which[i] = i
    keep = np.zeros(MAX_FRONT, np.bool_)
    bounds = empty_lines(4 * LIST_CAPACITY).reshape((4, LIST_CAPACITY))
    return AvatarFront(bounds, which, keep, keep.view(np.uint64))


@njit_no_refcount
def pad_list(bounds, begin, end):
    """Fill entries [begin, end) of the lists with nodes that no test keeps."""
    for i in range(begin, end):
        bounds[0, U(i)] = FAR_AWAY
        bounds[1, U(i)] = np.float32(0.0)
        bounds[2, U(i)] = np.float32(0.0)
        bounds[3, U(i)] = np.float32(0.0)


@njit_no_refcount
def place_front(avatar, m, placed, scene, extent, bounds):
    """Place the front, after `place_root`, as the first list of `bounds`. Returns its length."""
    step = scene.step
    per_step = 1.0 / step
    front = avatar.front
    n = front.shape[1]
    for r in range(3):
        base = np.float64(placed.frame[r]) * step
        m0, m1, m2, shift = m[r, 0], m[r, 1], m[r, 2], placed.shift[r]
        for i in range(n):
            # The formula of `place`.
            world = ((m0 * front[0, i] + m1 * front[1, i]) + m2 * front[2, i]) + shift
            bounds[r, i] = np.float32((world - base) * per_step)
    for i in range(n):
        bounds[3, i] = node_reach(front[3, i], per_step, extent)
    pad_list(bounds, n, (n + LANES - 1) // LANES * LANES)
    return n


@njit_no_refcount
def place_block(avatar, m, block, placed, scene):
    """Place the points of one leaf node of the avatar, all LANES at once."""
    place_lanes(avatar.points, m, block, placed.lanes, placed.shift, placed.frame, scene.step)


@njit_no_refcount
def place_lanes(points, m, block, lanes, shift, frame, step):
    """Place the points of one leaf node, given the arrays themselves.

    Passing three tuples of arrays, as `place_block` does, takes as long as the work itself.
    """
    per_step = 1.0 / step
    b = np.uint64(block)
    for r in range(3):
        base = np.float64(frame[r]) * step
        m0, m1, m2, along = m[r, 0], m[r, 1], m[r, 2], shift[r]
        for lane in range(LANES):
            j = np.uint64(lane)
            # The formula of `place`.
            world = ((m0 * points[b, 0, j] + m1 * points[b, 1, j]) + m2 * points[b, 2, j]) + along
            lanes[b, r, j] = np.float32((world - base) * per_step)


@njit_inlined
def place_block_once(avatar, m, pose, block, placed, scene):
    """Place a block of the avatar unless it is already placed for this pose."""
    if placed.stamp[U(block)] != pose:
        place_block(avatar, m, block, placed, scene)
        placed.stamp[U(block)] = pose


@njit_no_refcount
def place_node(avatar, m, a, placed, scene):
    """Place one node of the avatar: return x, y, z from the frame [steps], float32."""
    shift, frame, step = placed.shift, placed.frame, scene.step
    x, y, z = avatar.center[a, 0], avatar.center[a, 1], avatar.center[a, 2]
    return (
        _from_frame(place(m, shift, 0, x, y, z), frame[0], step),
        _from_frame(place(m, shift, 1, x, y, z), frame[1], step),
        _from_frame(place(m, shift, 2, x, y, z), frame[2], step),
    )


@nb.njit(nogil=True, cache=True)
def make_placed(avatar):
    """Allocate scratch for one avatar (not empty); nothing is placed yet."""
    blocks = avatar.points.shape[0]
    return PlacedAvatar(
        np.empty((4, avatar.center.shape[0]), np.float32),
        empty_lines(3 * LANES * blocks).reshape((blocks, 3, LANES)),
        np.full(blocks, -1, np.int64),
        np.empty(3, np.int64),
        np.empty(3, np.float64),
    )


@njit_no_refcount
def place_units(points, m, shift, block, lane):
    """Place the centre of an avatar's point: three int64, exact units."""
    x, y, z = points[block, 0, lane], points[block, 1, lane], points[block, 2, lane]
    return (
        to_units(place(m, shift, 0, x, y, z)),
        to_units(place(m, shift, 1, x, y, z)),
        to_units(place(m, shift, 2, x, y, z)),
    )


@njit_no_refcount
def lattice_point(corner, ints, halves, block_at, lane_at, j):
    """Return the lattice coordinates of a scan point, three int64.

    corner: (3,) int64, of its voxel.  block_at, lane_at, j: see scene_arrays.py.
    """
    return (
        corner[0] + np.int64(ints[block_at]) + np.int64(halves[lane_at + j]),
        corner[1] + np.int64(ints[block_at + 1]) + np.int64(halves[lane_at + LANES + j]),
        corner[2] + np.int64(ints[block_at + 2]) + np.int64(halves[lane_at + 2 * LANES + j]),
    )


@njit_no_refcount
def square_apart(center, point, units_per_step):
    """Compute |a - b|^2 of one pair by the definition (NUMERICS.md N5), int64, exact units.

    center: of `place_units`.  point: of `lattice_point`.
    Returns -1 where they are farther apart along an axis than any reach, MAX_REACH_UNITS; squares
    therefore fit 63 bits.
    """
    dx = center[0] - lattice_to_units(point[0], units_per_step)
    dy = center[1] - lattice_to_units(point[1], units_per_step)
    dz = center[2] - lattice_to_units(point[2], units_per_step)
    if abs(dx) > MAX_REACH_UNITS or abs(dy) > MAX_REACH_UNITS or abs(dz) > MAX_REACH_UNITS:
        return np.int64(-1)
    return dx * dx + dy * dy + dz * dz


@njit_no_refcount
def pair_square(avatar, m, block, lane, placed, scene, voxel, lane_at, block_at, j):
    """Compute |a - b|^2 of one pair, see `square_apart`.

    block, lane: of the avatar's point.  block_at, lane_at, j: of the scan's point in `voxel`, see
    scene_arrays.py.
    """
    center = place_units(avatar.points, m, placed.shift, block, lane)
    point = lattice_point(scene.corners[voxel], scene.ints, scene.halves, block_at, lane_at, j)
    return square_apart(center, point, scene.units_per_step)


@njit_no_refcount
def pair_in_reach(avatar, m, block, lane, placed, scene, voxel, lane_at, block_at, j, units):
    """Return whether one pair is within `units`, tangency included."""
    square = pair_square(avatar, m, block, lane, placed, scene, voxel, lane_at, block_at, j)
    return square >= 0 and square <= units * units


@njit_no_refcount
def _product(a, b):
    """Return the product of two uint64 as its high and low 64 bits."""
    a_high, a_low, b_high, b_low = a >> _HALF, a & _LOW, b >> _HALF, b & _LOW
    # None of these exceeds 64 bits: (2^32 - 1)^2 + 2 (2^32 - 1) = 2^64 - 1.
    low = a_low * b_low
    middle = a_high * b_low + (low >> _HALF)
    other = a_low * b_high + (middle & _LOW)
    return a_high * b_high + (middle >> _HALF) + (other >> _HALF), ((other & _LOW) << _HALF) | (low & _LOW)


@njit_no_refcount
def _compare_roots(square, other, radius_difference):
    """Return the sign of sqrt(square) - (sqrt(other) + d), int64, with d = radius_difference >= 0.

    The two sides differ by at most 1. Squaring both leaves the sign of s - 2 d sqrt(other), with
    s = square - other - d^2. If s is not negative, both sides are squared again. All terms fit,
    because d is at most slightly larger than the root of `square`.
    """
    s = square - other - radius_difference * radius_difference
    if s < 0:
        return -1
    size, twice = np.uint64(s), np.uint64(2 * radius_difference)
    high, low = _product(size, size)
    other_high, other_low = _product(twice * twice, np.uint64(other))
    if high != other_high:
        return -1 if high < other_high else 1
    if low != other_low:
        return -1 if low < other_low else 1
    return 0


@njit_inlined
def compare_separations(square, radius, other_square, other_radius):
    """Compare the separations sqrt(square) - radius of two pairs exactly.

    Returns -1, 0 or 1: the first separation is less than, equal to or greater than the other.
    square, other_square: int64, 0 to 3 * 2^60, from `pair_square`.  radius, other_radius: int64,
    -2^31 to 2^31, exact units. Terms common to both radii may be omitted: `-deficit` serves as well
    as the radius.
    """
    radius_difference = radius - other_radius
    if radius_difference == 0:
        return 0 if square == other_square else -1 if square < other_square else 1
    apart = (math.sqrt(np.float64(square)) - math.sqrt(np.float64(other_square))) - np.float64(
        radius_difference
    )
    if apart < -CERTAIN:
        return -1
    if apart > CERTAIN:
        return 1
    if radius_difference > 0:
        return _compare_roots(square, other_square, radius_difference)
    return -_compare_roots(other_square, square, -radius_difference)
