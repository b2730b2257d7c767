"""Do two bounding sphere hierarchies touch under a pose? [Fig12] section 6, figures 5 and 6, corrected.

As printed, the figures descend into "all children A[i] and B[j]" when A is a leaf and B is not: a leaf has no
children, the loop runs zero times, and the contact is lost. Here the larger inner node is descended, and a
leaf never is.

What decides is an inequality of integers (NUMERICS.md N5). A float32 pass finds nearly all there is to know:
distances are in lattice steps from a lattice point near the avatar, where scene coordinates are whole numbers
below 2^24 and so exact, and the placed avatar carries an error `error` that is added to every bound. Pairs of
points below `near` touch, above `far` do not; only between them are the integers asked.
"""

import math
from typing import NamedTuple

import numba as nb
import numpy as np
from numpy.typing import NDArray

from .layout import BLOCK_WORDS, COUNT, FIRST, LANES, ROW_WORDS
from .placing import GOOD, largest_term, lattice_to_units, place, to_units
from .reach import Reach, find_reach

U32 = 2.0**-24  # half a unit in the last place of 1, float32
# Relative slack of a float32 test: over 16 U32, where the sums below take at most 8.
SLACK = np.float32(1e-6)
ONE_SLACK = np.float32(1.0 + 2e-6)
# A pair is pushed for each child of one of its nodes, so at most 15 a level stay behind on the stack: this holds
# two trees of MOST_LEVELS. Trees of degree 2 over 2^31 points have 32 levels a BSH.
MOST_LEVELS = 80
STACK = 2 * MOST_LEVELS * 15 + 16
CLEAR, CONTACT, UNKNOWN = 0, 1, 2  # schemas/answers.py Verdict


class SceneArrays(NamedTuple):
    """What the kernel reads of a scene.

    words, ints, halves: the arena (layout.py).  where: (v, 3) int64, a voxel's runs in it, -1: not resident.
    coordinates: (v, 3) int64 voxel coordinates.  origin: (3,) float64 [m].  step: [m].
    """

    words: NDArray[np.float32]
    ints: NDArray[np.int32]
    halves: NDArray[np.uint16]
    where: NDArray[np.int64]
    coordinates: NDArray[np.int64]
    origin: NDArray[np.float64]
    step: float
    units_per_step: float
    voxel_steps: int


class Placed(NamedTuple):
    """An avatar under one pose, float32 steps from `frame`, a lattice point; scratch of one call.

    nodes: (4, a): x[], y[], z[], radius[], rounded outward.  lanes: (b, 3, LANES).  stamp: (b,) int64, the pose a
    block was placed for: blocks are placed when first reached, most never are.
    frame: (3,) int64.  shift: (3,) float64, t - O.
    """

    nodes: NDArray[np.float32]
    lanes: NDArray[np.float32]
    stamp: NDArray[np.int64]
    frame: NDArray[np.int64]
    shift: NDArray[np.float64]


class Limits(NamedTuple):
    """The thresholds of one pose. reach, error: [steps], float32, rounded up.  near, far: squares, float32.

    units: r_a + r_b + margin, exact units, int64.
    """

    reach: np.float32
    error: np.float32
    near: np.float32
    far: np.float32
    units: np.int64


@nb.njit(nogil=True, cache=True)
def _limits(units, units_per_step, extent, farthest, voxel_steps):
    """The thresholds for a reach of `units`.

    extent: how far placed avatar points lie from the frame.  farthest: the largest term of a placed coordinate.
    Errors of a coordinate difference, in steps: rounding to exact units, half a unit for either point; the
    float32 of the avatar's coordinate, U32 of its size, once from the frame and once from the voxel or block,
    where a pair in reach is within the larger of voxel and block, and the reach (doubled, so that a pair beyond
    cannot pass as near); float64 rounding far from the origin: 4 half units in the last place for a placed centre,
    4 for a point below it, 1 for the frame, 1 for the lattice point, 10 * 2^-53 of the largest term.
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
    # One float32 step outward covers the narrowing just done; at 0 nothing is certified near.
    near = np.nextafter(near, np.float32(-1.0)) if below > 0.0 else np.float32(-1.0)
    return Limits(
        np.nextafter(np.float32(reach), np.float32(np.inf)),
        np.nextafter(np.float32(around), np.float32(np.inf)),
        near,
        np.nextafter(far, np.float32(np.inf)),
        np.int64(units),
    )


@nb.njit(nogil=True, cache=True)
def _place_nodes(avatar, m, scale, placed, scene):
    """Place an avatar's nodes; fills placed.frame, shift and nodes. Returns (extent, farthest) for `_limits`."""
    step = scene.step
    per_step = 1.0 / step
    nodes = placed.nodes
    for r in range(3):
        placed.shift[r] = m[r, 3] - scene.origin[r]
        root = place(m, placed.shift, r, avatar.center[0, 0], avatar.center[0, 1], avatar.center[0, 2])
        placed.frame[r] = np.int64(np.rint(root * per_step))
    center = avatar.center[0]
    farthest = largest_term(m, placed.shift, center[0], center[1], center[2]) * per_step
    extent = avatar.radius[0] * scale * per_step + 1.0
    for r in range(3):
        base = np.float64(placed.frame[r]) * step
        for i in range(avatar.center.shape[0]):
            world = place(m, placed.shift, r, avatar.center[i, 0], avatar.center[i, 1], avatar.center[i, 2])
            nodes[r, i] = np.float32((world - base) * per_step)
    for i in range(avatar.center.shape[0]):
        # + 1e-6: the float32 centre is off by at most U32 of `extent`, and the radius by U32 of itself.
        nodes[3, i] = np.float32(avatar.radius[i] * scale * per_step * (1.0 + 1e-6) + extent * 1e-6)
    return extent, farthest + extent


@nb.njit(nogil=True, cache=True)
def _place_block(avatar, m, block, placed, scene):
    """Place the points of one leaf node of the avatar, all LANES at once."""
    per_step = 1.0 / scene.step
    for r in range(3):
        base = np.float64(placed.frame[r]) * scene.step
        for j in range(LANES):
            points = avatar.points
            world = place(m, placed.shift, r, points[block, 0, j], points[block, 1, j], points[block, 2, j])
            placed.lanes[block, r, j] = np.float32((world - base) * per_step)


@nb.njit(nogil=True, cache=True)
def _nodes_meet(words, row, x, y, z, radius, limits):
    """Whether a sphere (float32, from the voxel's low corner) comes within reach of a node's points, as far as its
    bound can tell: the sphere test of [Fig12] line 2, then the slab."""
    dx, dy, dz = x - words[row], y - words[row + 1], z - words[row + 2]
    span = radius + limits.reach + limits.error
    both = words[row + 3] + span
    if dx * dx + dy * dy + dz * dz > both * both * ONE_SLACK:
        return False
    along = words[row + 4] * dx + words[row + 5] * dy + words[row + 6] * dz
    # Beyond `both` the line above has answered, so rounding of `along` is SLACK of that at most.
    room = words[row + 7] * (span + SLACK * both + SLACK * both)
    return along <= words[row + 9] + room and along >= words[row + 8] - room


@nb.njit(nogil=True, cache=True)
def _exact(avatar, m, block, lane, placed, scene, voxel, lane_at, block_at, j, units):
    """The definition (NUMERICS.md N5), for one pair, in integers."""
    square = np.int64(0)
    points = avatar.points
    for r in range(3):
        world = place(
            m, placed.shift, r, points[block, 0, lane], points[block, 1, lane], points[block, 2, lane]
        )
        low = scene.coordinates[voxel, r] * scene.voxel_steps + np.int64(scene.ints[block_at + r])
        steps = low + np.int64(scene.halves[lane_at + r * LANES + j])
        difference = to_units(world) - lattice_to_units(steps, scene.units_per_step)
        if abs(difference) > units:  # also keeps the squares inside 63 bits
            return False
        square += difference * difference
    return square <= units * units


@nb.njit(nogil=True, cache=True)
def _leaves_touch(avatar, m, block, placed, scene, voxel, row, off, limits, keep, counters):
    """Whether a leaf node of the avatar and one of the scene hold a pair in contact.

    First all avatar points against the scene node's bound, in one vector loop; of those that remain, each
    against all points of the node. Most avatar points end at the bound.
    """
    words, ints, halves = scene.words, scene.ints, scene.halves
    lanes = placed.lanes
    cx, cy, cz = words[row] + off[0], words[row + 1] + off[1], words[row + 2] + off[2]
    nx, ny, nz, length = words[row + 4], words[row + 5], words[row + 6], words[row + 7]
    both = words[row + 3] + limits.reach + limits.error
    room = length * (limits.reach + limits.error + SLACK * both + SLACK * both)
    least, most = words[row + 8] - room, words[row + 9] + room
    square = both * both * ONE_SLACK
    for j in range(LANES):
        dx, dy, dz = lanes[block, 0, j] - cx, lanes[block, 1, j] - cy, lanes[block, 2, j] - cz
        along = nx * dx + ny * dy + nz * dz
        keep[j] = (dx * dx + dy * dy + dz * dz <= square) & (along <= most) & (along >= least)
    scene_block = ~ints[row + FIRST]
    block_at = scene.where[voxel, 1] + scene_block * BLOCK_WORDS
    lane_at = scene.where[voxel, 2] + scene_block * 3 * LANES
    lx = off[0] + np.float32(ints[block_at])
    ly = off[1] + np.float32(ints[block_at + 1])
    lz = off[2] + np.float32(ints[block_at + 2])
    for lane in range(LANES):
        if not keep[lane]:
            continue
        x, y, z = lanes[block, 0, lane] - lx, lanes[block, 1, lane] - ly, lanes[block, 2, lane] - lz
        counters[1] += LANES
        touched = False
        for j in range(LANES):
            dx = np.float32(halves[lane_at + j]) - x
            dy = np.float32(halves[lane_at + LANES + j]) - y
            dz = np.float32(halves[lane_at + 2 * LANES + j]) - z
            touched |= dx * dx + dy * dy + dz * dz <= limits.far
        if not touched:
            continue
        for j in range(LANES):
            dx = np.float32(halves[lane_at + j]) - x
            dy = np.float32(halves[lane_at + LANES + j]) - y
            dz = np.float32(halves[lane_at + 2 * LANES + j]) - z
            square = dx * dx + dy * dy + dz * dz
            if square <= limits.near:
                return True
            if square <= limits.far and _exact(
                avatar, m, block, lane, placed, scene, voxel, lane_at, block_at, j, limits.units
            ):
                return True
    return False


@nb.njit(nogil=True, cache=True)
def _overlap_voxel(avatar, m, pose, placed, scene, voxel, limits, stack, keep, off, counters):
    """Whether the placed avatar touches one resident voxel: the two trees descended together, depth first."""
    words, ints = scene.words, scene.ints
    base = scene.where[voxel, 0]
    nodes = placed.nodes
    for r in range(3):
        off[r] = np.float32(scene.coordinates[voxel, r] * scene.voxel_steps - placed.frame[r])
    counters[0] += 1
    if not _nodes_meet(
        words, base, nodes[0, 0] - off[0], nodes[1, 0] - off[1], nodes[2, 0] - off[2], nodes[3, 0], limits
    ):
        return False
    stack[0, 0], stack[0, 1] = 0, base
    depth = 1
    while depth > 0:
        depth -= 1
        a, row = stack[depth, 0], stack[depth, 1]
        a_first, b_first = avatar.first[a], ints[row + FIRST]
        if a_first < 0 and b_first < 0:
            block = ~a_first
            if placed.stamp[block] != pose:
                _place_block(avatar, m, block, placed, scene)
                placed.stamp[block] = pose
            if _leaves_touch(avatar, m, block, placed, scene, voxel, row, off, limits, keep, counters):
                return True
        elif b_first < 0 or (a_first >= 0 and nodes[3, a] > words[row + 3]):
            counters[0] += avatar.count[a]
            for child in range(a_first, a_first + avatar.count[a]):
                if _nodes_meet(
                    words, row, nodes[0, child] - off[0], nodes[1, child] - off[1], nodes[2, child] - off[2],
                    nodes[3, child], limits,
                ):  # fmt: skip
                    stack[depth, 0], stack[depth, 1] = child, row
                    depth += 1
        else:
            x, y, z = nodes[0, a] - off[0], nodes[1, a] - off[1], nodes[2, a] - off[2]
            counters[0] += ints[row + COUNT]
            for i in range(ints[row + COUNT]):
                child_row = base + (b_first + i) * ROW_WORDS
                if _nodes_meet(words, child_row, x, y, z, nodes[3, a], limits):
                    stack[depth, 0], stack[depth, 1] = a, child_row
                    depth += 1
    return False


@nb.njit(nogil=True, cache=True)
def overlap_poses(poses, avatar, scene, reach, which, verdict, counts):
    """Answer `collide` for the poses numbered in `which`: one call a request, all its poses and voxels.

    poses: (k, 4, 4), checked.  avatar: not empty.  reach: Reach of these poses (reach.py); a voxel in it that is not
    resident is counted as missing.
    Adds to what verdict (k,) uint8 and counts (3, k) uint32 (voxels missing, node visits, point tests) hold, CLEAR
    and 0 to begin with, so that a pose may be answered in pieces: a contact wins over anything missing, and
    that over CLEAR.
    """
    blocks = avatar.points.shape[0]
    placed = Placed(
        np.empty((4, avatar.center.shape[0]), np.float32),
        np.empty((blocks, 3, LANES), np.float32),
        np.full(blocks, -1, np.int64),
        np.empty(3, np.int64),
        np.empty(3, np.float64),
    )
    stack = np.empty((STACK, 2), np.int64)
    keep = np.empty(LANES, np.bool_)
    off = np.empty(3, np.float32)
    counters = np.zeros(2, np.int64)
    for number in range(which.shape[0]):
        i = which[number]
        counters[0], counters[1] = 0, 0
        if verdict[i] != CONTACT and reach.starts[i + 1] > reach.starts[i]:
            extent, farthest = _place_nodes(avatar, poses[i], reach.scales[i], placed, scene)
            limits = _limits(reach.units[i], scene.units_per_step, extent, farthest, scene.voxel_steps)
            for at in range(reach.starts[i], reach.starts[i + 1]):
                voxel = reach.rows[at]
                if scene.where[voxel, 0] < 0:
                    counts[0, i] += np.uint32(1)
                    verdict[i] = UNKNOWN
                elif _overlap_voxel(
                    avatar, poses[i], i, placed, scene, voxel, limits, stack, keep, off, counters
                ):
                    verdict[i] = CONTACT
                    break
        counts[1, i] += np.uint32(counters[0])
        counts[2, i] += np.uint32(counters[1])


@nb.njit(nogil=True, cache=True)
def answer_resident(poses, avatar, radius, other_units, scene, index, rows, outside, verdict, counts):
    """A whole request in one call, where all voxels in its reach are resident: `find_reach`, then `overlap_poses`.

    Writes rows (capacity,) int64, the voxels in reach, pose by pose; outside (k,) bool; and, as `overlap_poses` does,
    verdict and counts. The rest of `Reach` stays in here: arrays made here cost a tenth of arrays handed over.
    Returns (fault, pose, figure found) as `check_poses` does, and how many rows; -1: not answered, for something has
    to be loaded or the rows do not fit, and verdict and counts are untouched.
    """
    k = poses.shape[0]
    reach = Reach(
        np.empty(k), np.empty(k, np.int64), np.zeros(k + 1, np.int64), rows, np.empty((k, 2, 3)), outside
    )
    fault, pose, found, needed = find_reach(poses, avatar, radius, other_units, scene, index, reach)
    if fault != GOOD or needed > rows.shape[0]:
        return fault, pose, found, -1
    for at in range(needed):
        if scene.where[rows[at], 0] < 0:
            return fault, pose, found, -1
    if avatar.radius.shape[0] > 0:
        overlap_poses(poses, avatar, scene, reach, np.arange(k), verdict, counts)
    return fault, pose, found, needed
