"""Do two bounding sphere hierarchies touch under a pose? [Fig12] section 6, figures 5 and 6, corrected.

As printed, the figures descend into "all children A[i] and B[j]" when A is a leaf and B is not: a leaf has no
children, the loop runs zero times, and the contact is lost. Here the larger inner node is descended, and a
leaf never is.

What decides is an inequality of integers (NUMERICS.md N5). A float32 pass finds nearly all there is to know:
distances are in lattice steps from a lattice point near the avatar, where scene coordinates are whole numbers
below 2^24 and so exact, and the placed avatar carries an error `error` that is added to every bound. Pairs of
points below `near` touch, above `far` do not; only between them are the integers asked.
"""

import numba as nb
import numpy as np

from .layout import BLOCK_WORDS, COUNT, FIRST, LANES, ROW_WORDS
from .placed import ONE_SLACK, SLACK, make_limits, make_placed, pair_in_reach, place_block, place_nodes
from .placing import GOOD
from .reach import Reach, find_reach

# A pair is pushed for each child of one of its nodes, so at most 15 a level stay behind on the stack: this holds
# two trees of MOST_LEVELS. Trees of degree 2 over 2^31 points have 32 levels a BSH.
MOST_LEVELS = 80
STACK = 2 * MOST_LEVELS * 15 + 16
CLEAR, CONTACT, UNKNOWN = 0, 1, 2  # schemas/answers.py Verdict


@nb.njit(nogil=True, cache=True)
def nodes_meet(words, row, x, y, z, radius, limits):
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
            if square <= limits.far and pair_in_reach(
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
    if not nodes_meet(
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
                place_block(avatar, m, block, placed, scene)
                placed.stamp[block] = pose
            if _leaves_touch(avatar, m, block, placed, scene, voxel, row, off, limits, keep, counters):
                return True
        elif b_first < 0 or (a_first >= 0 and nodes[3, a] > words[row + 3]):
            counters[0] += avatar.count[a]
            for child in range(a_first, a_first + avatar.count[a]):
                if nodes_meet(
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
                if nodes_meet(words, child_row, x, y, z, nodes[3, a], limits):
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
    placed = make_placed(avatar)
    stack = np.empty((STACK, 2), np.int64)
    keep = np.empty(LANES, np.bool_)
    off = np.empty(3, np.float32)
    counters = np.zeros(2, np.int64)
    for number in range(which.shape[0]):
        i = which[number]
        counters[0], counters[1] = 0, 0
        if verdict[i] != CONTACT and reach.starts[i + 1] > reach.starts[i]:
            extent, farthest = place_nodes(avatar, poses[i], reach.scales[i], placed, scene)
            limits = make_limits(reach.units[i], scene.units_per_step, extent, farthest, scene.voxel_steps)
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
