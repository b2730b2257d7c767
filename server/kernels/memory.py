"""What a walker's last poses leave behind, so that the next one, a step further, need not be looked at from the start.

Kept is a cut through the scene's trees: entries, scene nodes that together hold every point that could be touched. Of
each entry is known why the avatar does not touch it, and how far that stays true:

- the way: the avatar's front nodes are farther from it than that, so until the avatar has travelled it, none arrives;
- the gap: those front nodes that are nearer lie all on one side of its slab, so many steps away from it. What a motion
  leaves of that is two products: walking along a wall or over a floor uses up hardly any of it.

A pose then costs one vector loop over the entries. Those whose reason is used up are looked at again, against all front
nodes at once, in the avatar's own frame, where nothing of the avatar has to be placed. An inner node without a good
reason gives way to its children; a leaf node is tested as in overlap.py. A contact is remembered as the pair of leaf
nodes it was found in, which is looked at first.

Every bound errs outward, so verdicts are those of `overlap_poses`, pose by pose; only the counts differ.

Keeping a front between two poses is as old as Lin and Canny's closest features (1991) and Klosowski et al.'s fronts
(1998); here what is kept is not where a descent ended but how far that stays true.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .compiled import borrowing
from .front import U
from .layout import LANES

# Entries there is room for; a walk needs some hundred. One that needs more starts afresh.
ENTRIES = 2048
VOXELS = 64
# After this way everything is looked at from the roots again: what lies behind would never be dropped else. [m]
AFRESH = 1.0
# Front nodes nearer than this are to lie beyond the slab, those farther are left to the way. [m]
NEAR = 0.3
# A gap this small would soon be used up. [m]
LEAST_GAP = 0.0005
WAY, SCALE, KNOWN, ROOM, MEASURED, LARGEST = range(6)  # of Memory.state
# Rows of Memory.gaps: normal towards the avatar; the scene node's center in the avatar's frame; the normal in that
# frame, when looked at; how far around the center near front nodes lie; the gap, less the plane's place.
NORMAL, CENTER, TURNED, AROUND, GAP = 0, 3, 6, 9, 10
GAPS = 11
BEYOND = np.float32(1e15)
BEYOND_BITS = np.int32(BEYOND.view(np.int32))
# Above the rounding of a dozen float32 operations.
BLUR = 4e-6


class Memory(NamedTuple):
    """What is known after the last pose of an avatar with f front nodes, all leaf nodes. Lengths in lattice steps.

    state: (6,) float64: way travelled since all was looked at, scale, 1 where anything is known, reach and errors of
    the largest radius, and of `body` the scale and the largest radius.
    last: (4, 4) float64, the last pose.  frame: (3,) int64, a lattice point near the avatar.
    body: (7, f padded to LANES) float32, of each front node the middle of its points' box from the root's center, half
    its sides, and the radius of a sphere around the middle; axes of the avatar's frame.
    until: (ENTRIES,) float32, the way up to which an entry is good, if its gap is.
    gaps: (GAPS, ENTRIES) float32, and entry_of: (ENTRIES,) int64, the entry each is of.
    nodes: (ENTRIES, 3) int64: voxel, row (words from the voxel's first), and which of the gaps, -1: none.
    counts: (3,) int64: entries, voxels, gaps.  voxels: (VOXELS,) int64, those whose root is above some entry.
    touched: (3,) int64: the block, voxel and row of the last contact; block -1: none.
    """

    state: NDArray[np.float64]
    last: NDArray[np.float64]
    frame: NDArray[np.int64]
    body: NDArray[np.float32]
    until: NDArray[np.float32]
    gaps: NDArray[np.float32]
    entry_of: NDArray[np.int64]
    nodes: NDArray[np.int64]
    counts: NDArray[np.int64]
    voxels: NDArray[np.int64]
    touched: NDArray[np.int64]


def make_memory(front: int) -> Memory:
    """Nothing known of a front of so many nodes."""
    return Memory(
        np.zeros(6),
        np.zeros((4, 4)),
        np.zeros(3, np.int64),
        np.zeros((7, (front + LANES - 1) // LANES * LANES), np.float32),
        np.zeros(ENTRIES, np.float32),
        np.zeros((GAPS, ENTRIES), np.float32),
        np.zeros(ENTRIES, np.int64),
        np.zeros((ENTRIES, 3), np.int64),
        np.zeros(3, np.int64),
        np.zeros(VOXELS, np.int64),
        np.full(3, -1, np.int64),
    )


@borrowing
def _measure_body(avatar, scale, scene, body):
    """Fill Memory.body, rounded outward."""
    steps = scale / scene.step
    blur = 1e-6 * avatar.radius[0] * steps
    n = avatar.front.shape[1]
    for i in range(n):
        block = ~np.int64(avatar.first[avatar.front_first + i])
        for r in range(3):
            low, high = np.inf, -np.inf
            for j in range(LANES):
                low = min(low, avatar.points[block, r, j])
                high = max(high, avatar.points[block, r, j])
            body[r, i] = np.float32((0.5 * (low + high) - avatar.center[0, r]) * steps)
            body[3 + r, i] = np.float32(0.5 * (high - low) * steps + blur)
        square = 0.0
        for j in range(LANES):
            own = 0.0
            for r in range(3):
                d = (avatar.points[block, r, j] - avatar.center[0, r]) * steps - np.float64(body[r, i])
                own += d * d
            square = max(square, own)
        body[6, i] = np.float32(math.sqrt(square) + blur)
    for i in range(n, body.shape[1]):
        body[0, i] = BEYOND
        for r in range(1, 7):
            body[r, i] = np.float32(0.0)


@borrowing
def travelled(avatar, m, last, scale):
    """No less than any of the avatar's points moved between two poses [m]."""
    square, turn = 0.0, 0.0
    for r in range(3):
        moved = m[r, 3] - last[r, 3]
        for c in range(3):
            change = m[r, c] - last[r, c]
            moved += change * avatar.center[0, c]
            turn += change * change
        square += moved * moved
    # The difference of two rotations has two singular values that are equal, and one that is 0.
    way = math.sqrt(square) + (math.sqrt(0.5 * turn) * (1.0 + 1e-6) + 1e-8 * scale) * avatar.radius[0]
    for r in range(3):
        way += 1e-15 * (abs(m[r, 3]) + scale * abs(avatar.center[0, r]))
    return way


@borrowing
def bits_of(number):
    """The bits of a float32: of numbers that are not negative, integers in the same order."""
    return np.float32(number).view(np.int32)


@borrowing
def number_of(bits):
    """The float32 of these bits."""
    return np.int32(bits).view(np.float32)


@borrowing
def find_used(until, count, way, used):
    """Mark in used (ENTRIES,) bool which of `count` entries are not good for this way. Returns whether any is."""
    any_used = False
    i = U(0)
    for _ in range((count + LANES - 1) // LANES):
        for j in range(LANES):
            bad = until[i + U(j)] < way
            used[i + U(j)] = bad
            any_used |= bad
        i += U(LANES)
    return any_used


@borrowing
def find_closed(gaps, count, turn, x, y, z, closed):
    """Mark in closed (ENTRIES,) bool the gaps that may be used up. Returns whether any is.

    turn: (9,) float32, the rotation, row by row; x, y, z: the root's center from the frame.
    """
    r0, r1, r2 = turn[0], turn[1], turn[2]
    r3, r4, r5 = turn[3], turn[4], turn[5]
    r6, r7, r8 = turn[6], turn[7], turn[8]
    any_closed = False
    i = U(0)
    for _ in range((count + LANES - 1) // LANES):
        for j in range(LANES):
            k = i + U(j)
            nx, ny, nz = gaps[NORMAL, k], gaps[NORMAL + 1, k], gaps[NORMAL + 2, k]
            tx = r0 * nx + r3 * ny + r6 * nz
            ty = r1 * nx + r4 * ny + r7 * nz
            tz = r2 * nx + r5 * ny + r8 * nz
            at = tx * gaps[CENTER, k] + ty * gaps[CENTER + 1, k] + tz * gaps[CENTER + 2, k]
            at += nx * x + ny * y + nz * z
            ux, uy, uz = tx - gaps[TURNED, k], ty - gaps[TURNED + 1, k], tz - gaps[TURNED + 2, k]
            turned = np.sqrt(ux * ux + uy * uy + uz * uz)
            bad = gaps[GAP, k] + at < turned * gaps[AROUND, k]
            closed[k] = bad
            any_closed |= bad
        i += U(LANES)
    return any_closed


@borrowing
def sift_body(body, x, y, z, span, dx, dy, dz, low, high, least, apart, above, below, meets):
    """Hold all front nodes against one scene node, in the avatar's frame.

    x, y, z: its center; span: its radius and the room around it; d: its normal, low, high: its slab with that room.
    Writes for each node: apart (f,) int32, bits of float32, how far its sphere is, 0 where it meets; above, below (f,)
    float32, how far its box is beyond the slab; meets (f,) bool. Returns the least `apart`, bits, of all, of those not
    `least` above, of those not `least` below, and of those above 0.
    """
    ax, ay, az = abs(dx), abs(dy), abs(dz)
    none = BEYOND_BITS
    nearest, up, down, rest = none, none, none, none
    i = U(0)
    for _ in range(body.shape[1] // LANES):
        for j in range(LANES):
            k = i + U(j)
            bx, by, bz = body[0, k] - x, body[1, k] - y, body[2, k] - z
            far = np.sqrt(bx * bx + by * by + bz * bz) - body[6, k] - span
            far = far if far > np.float32(0.0) else np.float32(0.0)
            bits = bits_of(far)
            along = dx * bx + dy * by + dz * bz
            wide = ax * body[3, k] + ay * body[4, k] + az * body[5, k]
            over, under = along - wide - high, low - along - wide
            apart[k], above[k], below[k] = bits, over, under
            meets[k] = bits <= 0
            nearest = min(nearest, bits)
            rest = min(rest, bits if bits > 0 else none)
            up = min(up, bits if over <= least else none)
            down = min(down, bits if under <= least else none)
        i += U(LANES)
    return nearest, up, down, rest


@borrowing
def least_gap(apart, beyond, count, within):
    """The least of `beyond` of the nodes nearer than `within`, bits; all of these are above 0."""
    least = BEYOND_BITS
    for j in range(count):
        own, is_near = bits_of(beyond[U(j)]), apart[U(j)] < within
        least = min(least, own if is_near else BEYOND_BITS)
    return least


@borrowing
def turn_points(halves, lane_at, x, y, z, turn, points):
    """Write points (3, LANES) float32, a scene block's in the avatar's frame. x, y, z: its corner from the root's
    center; turn: (9,) float32, the rotation, row by row."""
    r0, r1, r2 = turn[0], turn[1], turn[2]
    r3, r4, r5 = turn[3], turn[4], turn[5]
    r6, r7, r8 = turn[6], turn[7], turn[8]
    for j in range(LANES):
        i = U(lane_at) + U(j)
        px = np.float32(halves[i]) + x
        py = np.float32(halves[i + U(LANES)]) + y
        pz = np.float32(halves[i + U(2 * LANES)]) + z
        points[0, U(j)] = r0 * px + r3 * py + r6 * pz
        points[1, U(j)] = r1 * px + r4 * py + r7 * pz
        points[2, U(j)] = r2 * px + r5 * py + r8 * pz


@borrowing
def from_box(points, body, node):
    """The square of the least distance of points (3, LANES) from the box of a front node, bits of float32."""
    k = U(node)
    x, y, z = body[0, k], body[1, k], body[2, k]
    wide, deep, high = body[3, k], body[4, k], body[5, k]
    zero, least = np.float32(0.0), BEYOND_BITS
    for j in range(LANES):
        dx = abs(points[0, U(j)] - x) - wide
        dy = abs(points[1, U(j)] - y) - deep
        dz = abs(points[2, U(j)] - z) - high
        dx = dx if dx > zero else zero
        dy = dy if dy > zero else zero
        dz = dz if dz > zero else zero
        least = min(least, bits_of(dx * dx + dy * dy + dz * dz))
    return least


@borrowing
def start_afresh(avatar, scale, scene, memory, rooms, placed, extent):
    """Forget all entries, and begin at pose m. rooms: `ByClass.room`."""
    state = memory.state
    if state[MEASURED] != scale:
        _measure_body(avatar, scale, scene, memory.body)
        state[MEASURED], state[LARGEST] = scale, 0.0
        for i in range(memory.body.shape[1]):
            state[LARGEST] = max(state[LARGEST], np.float64(memory.body[6, i]))
    state[WAY], state[SCALE], state[KNOWN] = 0.0, scale, 1.0
    # AFRESH farther from the origin the errors are hardly greater; 1e-6 of that way is far above it.
    more = 1e-6 * (AFRESH / scene.step + extent)
    largest = rooms[0]
    for c in range(1, rooms.shape[0]):
        largest = max(largest, rooms[c])
    state[ROOM] = np.float64(largest) * (1.0 + 1e-6) + more
    memory.counts[0], memory.counts[1], memory.counts[2] = 0, 0, 0
    for r in range(3):
        memory.frame[r] = placed.frame[r]


@borrowing
def add_voxels(rows, begin, end, memory):
    """Make entries of the roots of those voxels rows[begin:end] that have none. Returns whether there was room."""
    voxels, counts, nodes = memory.voxels, memory.counts, memory.nodes
    for at in range(begin, end):
        voxel, known = rows[at], False
        for i in range(counts[1]):
            known |= voxels[i] == voxel
        if known:
            continue
        if counts[1] == VOXELS or counts[0] == ENTRIES:
            return False
        voxels[counts[1]] = voxel
        nodes[counts[0], 0], nodes[counts[0], 1], nodes[counts[0], 2] = voxel, 0, -1
        memory.until[counts[0]] = np.float32(-1.0)
        counts[1] += 1
        counts[0] += 1
    return True


@borrowing
def open_gap(gaps, g):
    """Make of a gap one that is never used up."""
    for r in range(GAPS):
        gaps[r, g] = np.float32(0.0)
    gaps[GAP, g] = BEYOND
