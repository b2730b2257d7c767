"""Avatar moving along one chord, both ends placed in float32 as in placed_avatar.py.

Most motions of a frame are translations at one orientation. The avatar is then turned once, and a
chord only adds an offset: placing it in float64 for each chord took half the time of a sweep.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ....schemas.archive.radius_model import RADIUS_CLASSES
from ....schemas.runtime import compiling as nb
from ..core.kernel_decorators import njit_inlined, njit_no_refcount
from ..core.node_bounds import STACK
from ..core.placed_avatar import Avatar, largest_term, place
from ..core.scene_arrays import LANES, SceneArrays
from .screw_motion import ScrewMotion

# Error of float32 sums along a chord: w + t d, with t from two dot products and a quotient, is off
# by less than 24 U32 of |w| + |d|.
CHORD_ERROR = 32.0
ONE = np.float32(1.0)
ZERO = np.float32(0.0)
U = np.uint64  # see placed_avatar.py


class MovingAvatar(NamedTuple):
    """Avatar along one chord, float32 steps from `frame`, a lattice point; scratch of one call.

    nodes: (8, a): x[], y[], z[] at the beginning of the chord, radius[], the displacement to its
    end x[], y[], z[], and 1 / its square.
    lanes: (b, 3, LANES), displacements: (b, 4, LANES), the same of the points.
    stamp: (b,) int64, the chord a block was placed for.  frame: (3,) int64.
    turned_nodes: (3, a), turned_lanes: (b, 3, LANES), positions relative to the root's centre at the
    orientation and step in turn, (10,) float64.  turned: (b,) int64, the orientation, counted from
    1, that a block was turned for.
    offset: (7,) float32, on a translation the root's centre at the beginning, the displacement x, y,
    z, and 1 / its square.
    ends: (2, 4, 4), shifts: (2, 3), poses at the ends and t - O.
    pose, shift: (4, 4), (3,), the one pose that is tested with integers.
    pair: (6,) int64, block, lane, voxel, lane_at, block_at, j of one pair of points
    (placed_avatar.py).
    best: (6,), the pair of the earliest contact found.
    first: (3,) float64, fractions of the chord, inf for never: when a contact is first possible;
    when `pair` certainly touches; the one of these two that prunes. `pair` is the first pair that
    may touch or, on a final chord, the first that certainly touches.
    thresholds: (2, RADIUS_CLASSES) float32, of the chord by radius class: reach plus error [steps],
    and `far` (placed_avatar.py). It is one array because a sweep is passed on whole: with the four arrays of
    `ClassThresholds`, a motion of the walk took a quarter longer.
    counters: (5,) int64, node visits, point tests, chords placed, orientations placed, and 1 while
    the chord is a translation.
    keep, off, stack: scratch.
    """

    nodes: NDArray[np.float32]
    lanes: NDArray[np.float32]
    displacements: NDArray[np.float32]
    stamp: NDArray[np.int64]
    frame: NDArray[np.int64]
    turned_nodes: NDArray[np.float32]
    turned_lanes: NDArray[np.float32]
    turn: NDArray[np.float64]
    turned: NDArray[np.int64]
    offset: NDArray[np.float32]
    ends: NDArray[np.float64]
    shifts: NDArray[np.float64]
    pose: NDArray[np.float64]
    shift: NDArray[np.float64]
    pair: NDArray[np.int64]
    best: NDArray[np.int64]
    first: NDArray[np.float64]
    thresholds: NDArray[np.float32]
    counters: NDArray[np.int64]
    keep: NDArray[np.bool_]
    off: NDArray[np.float32]
    stack: NDArray[np.int64]


class AvatarSweep(NamedTuple):
    """One motion of one avatar in one scene.

    motion: ScrewMotion.  avatar: Avatar.  scene: SceneArrays.  moving: MovingAvatar.
    units: the radii of the avatar and of the scan's largest sphere plus the margin, exact units. The
    reach of a pair is less by its `SceneArrays.radius_deficit`.
    """

    motion: ScrewMotion
    avatar: Avatar
    scene: SceneArrays
    moving: MovingAvatar
    units: np.int64


class AvatarChord(NamedTuple):
    """Straight approximation of a motion over one interval (sweep_interval.py).

    t0, t1: fractions.  inner, outer: U - band, U + band, exact units, with U of the scan's largest
    sphere.
    final: whether halving the interval is useless.
    """

    t0: float
    t1: float
    inner: float
    outer: float
    final: bool


@nb.njit(nogil=True, cache=True)
def make_moving(avatar):
    """Allocate scratch for one avatar, not empty. It may serve any number of motions, one at a time."""
    nodes, blocks = avatar.center.shape[0], avatar.points.shape[0]
    return MovingAvatar(
        np.empty((8, nodes), np.float32), np.empty((blocks, 3, LANES), np.float32),
        np.empty((blocks, 4, LANES), np.float32), np.full(blocks, -1, np.int64), np.empty(3, np.int64),
        np.empty((3, nodes), np.float32), np.empty((blocks, 3, LANES), np.float32), np.full(10, np.nan),
        np.zeros(blocks, np.int64), np.empty(7, np.float32), np.empty((2, 4, 4)), np.empty((2, 3)), np.empty((4, 4)),
        np.empty(3), np.zeros(6, np.int64), np.zeros(6, np.int64), np.empty(3),
        np.empty((2, RADIUS_CLASSES), np.float32), np.zeros(5, np.int64), np.empty(LANES, np.bool_),
        np.empty(3, np.float32), np.empty((STACK, 2), np.int64),
    )  # fmt: skip


@njit_inlined
def least_square(x, y, z, dx, dy, dz, inverse, latest):
    """Return the least square of a vector that moves from (x, y, z) by up to `latest` times (dx, dy, dz).

    All of one type, float32 or float64. inverse: 1 / the square of (dx, dy, dz).
    """
    t = min(max(-(x * dx + y * dy + z * dz) * inverse, ZERO), latest)
    ex, ey, ez = x + t * dx, y + t * dy, z + t * dz
    return ex * ex + ey * ey + ez * ez


@njit_no_refcount
def _inverse(x, y, z):
    """Return 1 / (x^2 + y^2 + z^2), or 0 for a vector too short to matter or to divide by.

    The limit is a length of 10^-10 steps.
    """
    square = x * x + y * y + z * z
    return np.float32(ONE / square) if square > np.float32(1e-20) else ZERO


@njit_no_refcount
def _is_translation(begin, end):
    """Return whether two poses have the same rotation bit for bit."""
    for r in range(3):
        for c in range(3):
            if begin[r, c] != end[r, c]:
                return False
    return True


@njit_no_refcount
def _turn_nodes(avatar, pose, step, moving):
    """Fill moving.turned_nodes, and forget the turned blocks, unless orientation and step are the last ones."""
    turn, turned = moving.turn, moving.turned_nodes
    same = turn[9] == step
    for r in range(3):
        for c in range(3):
            same &= turn[3 * r + c] == pose[r, c]
    if same:
        return
    turn[9] = step
    per_step = 1.0 / step
    for r in range(3):
        m0, m1, m2 = pose[r, 0], pose[r, 1], pose[r, 2]
        turn[3 * r], turn[3 * r + 1], turn[3 * r + 2] = m0, m1, m2
        root = m0 * avatar.center[0, 0] + m1 * avatar.center[0, 1] + m2 * avatar.center[0, 2]
        for i in range(avatar.center.shape[0]):
            x, y, z = avatar.center[i, 0], avatar.center[i, 1], avatar.center[i, 2]
            turned[r, i] = np.float32((((m0 * x + m1 * y) + m2 * z) - root) * per_step)
    moving.counters[3] += 1


@njit_no_refcount
def _turn_block(avatar, block, moving):
    """Fill the turned lanes of a block, for the orientation and step of `_turn_nodes`."""
    turn, lanes, points, b = moving.turn, moving.turned_lanes, avatar.points, U(block)
    per_step = 1.0 / turn[9]
    for r in range(3):
        m0, m1, m2 = turn[3 * r], turn[3 * r + 1], turn[3 * r + 2]
        root = m0 * avatar.center[0, 0] + m1 * avatar.center[0, 1] + m2 * avatar.center[0, 2]
        for lane in range(LANES):
            j = U(lane)
            x, y, z = points[b, 0, j], points[b, 1, j], points[b, 2, j]
            lanes[b, r, j] = np.float32((((m0 * x + m1 * y) + m2 * z) - root) * per_step)
    moving.turned[b] = moving.counters[3]


@njit_no_refcount
def place_nodes(avatar, speed, moving, scene):
    """Place an avatar's nodes at both ends of a chord; fill shifts, frame and nodes.

    speed: the farthest any point moves on the chord [m]. Returns (extent, farthest) for
    `make_thresholds`.
    """
    per_step = 1.0 / scene.step
    nodes, frame, offset = moving.nodes, moving.frame, moving.offset
    begin, end, shift0, shift1 = moving.ends[0], moving.ends[1], moving.shifts[0], moving.shifts[1]
    x, y, z = avatar.center[0, 0], avatar.center[0, 1], avatar.center[0, 2]
    for r in range(3):
        shift0[r] = begin[r, 3] - scene.origin[r]
        shift1[r] = end[r, 3] - scene.origin[r]
        root = place(begin, shift0, r, x, y, z)
        middle = 0.5 * (root + place(end, shift1, r, x, y, z))
        frame[r] = np.int64(np.rint(middle * per_step))
        offset[r] = np.float32((root - np.float64(frame[r]) * scene.step) * per_step)
        offset[3 + r] = np.float32((shift1[r] - shift0[r]) * per_step)
    farthest = max(largest_term(begin, shift0, x, y, z), largest_term(end, shift1, x, y, z)) * per_step
    longest = (speed * per_step) ** 2
    count = avatar.center.shape[0]
    translation = _is_translation(begin, end)
    moving.counters[4] = np.int64(translation)
    if translation:
        _turn_nodes(avatar, begin, scene.step, moving)
        offset[6] = _inverse(offset[3], offset[4], offset[5])
        for r in range(3):
            for i in range(count):
                nodes[r, i] = moving.turned_nodes[r, i] + offset[r]
        for r in range(3, 7):
            to = r + 1 if r < 6 else 7
            for i in range(count):
                nodes[to, i] = offset[r]
        longest = max(
            longest,
            np.float64(offset[3]) * offset[3]
            + np.float64(offset[4]) * offset[4]
            + np.float64(offset[5]) * offset[5],
        )
    else:
        for r in range(3):
            base = np.float64(frame[r]) * scene.step
            for i in range(count):
                x, y, z = avatar.center[i, 0], avatar.center[i, 1], avatar.center[i, 2]
                world = place(begin, shift0, r, x, y, z)
                nodes[r, i] = np.float32((world - base) * per_step)
                nodes[4 + r, i] = np.float32((place(end, shift1, r, x, y, z) - world) * per_step)
        for i in range(count):
            x, y, z = nodes[4, i], nodes[5, i], nodes[6, i]
            nodes[7, i] = _inverse(x, y, z)
            longest = max(longest, np.float64(x) * x + np.float64(y) * y + np.float64(z) * z)
    longest = math.sqrt(longest) * (1.0 + 1e-6)
    extent = avatar.radius[0] * per_step + 1.0 + longest
    for i in range(count):
        # The added 1e-6 is that of placed_avatar.py; it also covers a pose that is rigid within 1e-9.
        nodes[3, i] = np.float32(avatar.radius[i] * per_step * (1.0 + 1e-6) + extent * 1e-6)
    if translation:
        # A coordinate is rounded to float32 three times instead of once: turned, offset and their
        # sum. Its float64 terms are rounded eleven times instead of four.
        return 3.0 * extent + CHORD_ERROR * longest, 3.0 * (farthest + extent)
    return extent + CHORD_ERROR * longest, farthest + extent


@njit_no_refcount
def place_block(avatar, block, moving, scene):
    """Place the points of one leaf node of the avatar at both ends of a chord."""
    per_step = 1.0 / scene.step
    lanes, displacements, points, b = moving.lanes, moving.displacements, avatar.points, U(block)
    if moving.counters[4] != 0:
        if moving.turned[b] != moving.counters[3]:
            _turn_block(avatar, block, moving)
        turned, offset = moving.turned_lanes, moving.offset
        for r in range(3):
            along = offset[r]
            for lane in range(LANES):
                lanes[b, r, U(lane)] = turned[b, r, U(lane)] + along
        for r in range(4):
            along = offset[3 + r]
            for lane in range(LANES):
                displacements[b, r, U(lane)] = along
        return
    for r in range(3):
        base = np.float64(moving.frame[r]) * scene.step
        for lane in range(LANES):
            j = U(lane)
            x, y, z = points[b, 0, j], points[b, 1, j], points[b, 2, j]
            world = place(moving.ends[0], moving.shifts[0], r, x, y, z)
            lanes[b, r, j] = np.float32((world - base) * per_step)
            end = place(moving.ends[1], moving.shifts[1], r, x, y, z)
            displacements[b, r, j] = np.float32((end - world) * per_step)
    for lane in range(LANES):
        j = U(lane)
        displacements[b, 3, j] = _inverse(
            displacements[b, 0, j], displacements[b, 1, j], displacements[b, 2, j]
        )
