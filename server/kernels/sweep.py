"""When does a moving avatar first touch a scene? Two hierarchies, one of them on its way ([Fig12] section 6, in time).

Conservative advancement (Mirtich 1996; Zhang, Redon, Lee, Kim 2007; Tang, Kim, Manocha 2009, C2A), with what bounds
an advance taken from the directions of the motion, not from a greatest speed: over an interval [t0, t1] every avatar
point x is taken to go straight from a0 = M(t0) x to a1 = M(t1) x, in proportion to time, and one descent finds the
first moment at which any straight-moving sphere could touch, and the first at which one must.

Proof. Let a*(t) be the ideal motion of x, b a scan point, U their reach, all in exact units.
 1. |a*(t) - chord of a*| <= B (t1 - t0)^2 / 8, B the greatest |a*''| of any point (motion.py, `bend`).
 2. A computed coordinate vector, at t, t0 and t1, lies within `slip` of a*.
 3. Rounding to whole units moves a by at most sqrt(3) / 2, and b is a whole number.
So |a - b|, as NUMERICS.md N5 has it under M(t), lies within `band` = sqrt(3) / 2 + B (t1 - t0)^2 / 8 + 2 slip of the
distance D(t) from b to the chord. While D > U + band nothing touches; once D <= U - band the pair does. D is of a
point on a line from a fixed one: both moments are roots of a quadratic, here taken from the point of closest approach,
whose rounding is relative to the lengths and not to their squares. A node's sphere moves straight with its centre:
|lerp(x) - lerp(c)| is convex in t, so never above the radius. Node pairs are pruned by the least distance of the
centre's chord, up to the earliest certain contact found so far, in float32 with the error bound of placed.py enlarged
by 32 half units in the last place of the chord.

The interval found is halved and quartered until its ends are within the tolerance, or until B (t1 - t0)^2 / 8 no
longer counts beside rounding: what is undecided then is a graze. Which pairs are looked at in float64 may differ
from tree to tree; what they give does not, and the least of it is taken: so no tree, voxel or order changes an answer.
"""

import math
from typing import NamedTuple

import numba as nb
import numpy as np
from numpy.typing import NDArray

from ...schemas.voxel_grid import UNITS_PER_METRE
from .compiled import borrowing
from .layout import COUNT, COUNTED, FIRST, LANES, ROW_WORDS, SceneArrays
from .motion import Motion, pose_at
from .overlap import STACK
from .placed import ONE_SLACK, SLACK, make_limits, pair_square
from .placing import SIMILARITY_TOLERANCE, Avatar, largest_term, lattice_to_units, place

# Float32 sums along a chord: w + t d, with t from two dot products and a quotient, is off by under 24 U32 of |w| + |d|.
CHORD_ERROR = 32.0
# An interval whose sagitta is below this many units is not worth halving: rounding alone makes up 0.87 of the band.
LEAST_SAGITTA = 0.25
# Advances of one segment that settled nothing; beyond, what is undecided stays so. A full turn 1 um from a wall all the
# way takes some hundreds.
MOST_REFUSED = 512
INFINITE = np.inf
ONE = np.float32(1.0)
ZERO = np.float32(0.0)


class Moving(NamedTuple):
    """An avatar along one chord, float32 steps from `frame`, a lattice point; scratch of one call.

    nodes: (8, a): x[], y[], z[] at the chord's beginning, radius[], the way to its end x[], y[], z[], and 1 / its
    square.  lanes: (b, 3, LANES), ways: (b, 4, LANES) likewise of the points.  stamp: (b,) int64, the chord a block was
    placed for.  frame: (3,) int64.  ends: (2, 4, 4), shifts: (2, 3), poses at the ends and t - O.
    pose, shift: (4, 4), (3,) of the one pose that integers are asked about.
    pair: (6,) int64, block, lane, voxel, lane_at, block_at, j of one pair of points (placed.py).  best: (6,) that of
    the earliest contact found.
    first: (3,) float64, fractions of the chord, inf: never: when anything could touch first; when `pair` is sure to;
    that of the two which prunes. On a chord worth halving `pair` is the one that could touch first, else the first one
    sure to.
    counters: (4,) int64, node visits, point tests, chords placed, most visits.  gap, way, keep, off, stack: scratch.
    """

    nodes: NDArray[np.float32]
    lanes: NDArray[np.float32]
    ways: NDArray[np.float32]
    stamp: NDArray[np.int64]
    frame: NDArray[np.int64]
    ends: NDArray[np.float64]
    shifts: NDArray[np.float64]
    pose: NDArray[np.float64]
    shift: NDArray[np.float64]
    pair: NDArray[np.int64]
    best: NDArray[np.int64]
    first: NDArray[np.float64]
    counters: NDArray[np.int64]
    gap: NDArray[np.float64]
    way: NDArray[np.float64]
    keep: NDArray[np.bool_]
    off: NDArray[np.float32]
    stack: NDArray[np.int64]


class Job(NamedTuple):
    """One motion of one avatar in one scene. motion: Motion.  avatar: Avatar.  scene: SceneArrays.  moving: Moving.

    radius: of the avatar's points [m].  scale: of the poses.  In exact units: other_units: the scan's radius and the
    margin; units: these and the avatar's radius at either end, the larger; loose: what that may differ by on the way.
    """

    motion: Motion
    avatar: Avatar
    scene: SceneArrays
    moving: Moving
    radius: float
    scale: float
    other_units: int
    units: np.int64
    loose: float


class Chord(NamedTuple):
    """One interval. t0, t1: fractions.  inner, outer: U - band, U + band, exact units.  final: not worth halving."""

    t0: float
    t1: float
    inner: float
    outer: float
    final: bool


@nb.njit(nogil=True, cache=True)
def make_moving(avatar):
    """Scratch for one avatar, not empty."""
    blocks = avatar.points.shape[0]
    return Moving(
        np.empty((8, avatar.center.shape[0]), np.float32),
        np.empty((blocks, 3, LANES), np.float32),
        np.empty((blocks, 4, LANES), np.float32),
        np.full(blocks, -1, np.int64),
        np.empty(3, np.int64),
        np.empty((2, 4, 4)),
        np.empty((2, 3)),
        np.empty((4, 4)),
        np.empty(3),
        np.zeros(6, np.int64),
        np.zeros(6, np.int64),
        np.empty(3),
        np.zeros(4, np.int64),
        np.empty(3),
        np.empty(3),
        np.empty(LANES, np.bool_),
        np.empty(3, np.float32),
        np.empty((STACK, 2), np.int64),
    )


@borrowing
def _inverse(x, y, z):
    """1 / (x^2 + y^2 + z^2), or 0 where that is too small to matter (a way of 10^-10 steps) or to be divided by."""
    square = x * x + y * y + z * z
    return np.float32(ONE / square) if square > np.float32(1e-20) else ZERO


@borrowing
def _place_nodes(avatar, scale, speed, moving, scene):
    """Place an avatar's nodes at both ends of a chord; speed: the farthest any point goes on it [m].

    Fills shifts, frame and nodes. Returns (extent, farthest) for `make_limits`.
    """
    per_step = 1.0 / scene.step
    nodes, frame = moving.nodes, moving.frame
    begin, end, shift0, shift1 = moving.ends[0], moving.ends[1], moving.shifts[0], moving.shifts[1]
    x, y, z = avatar.center[0, 0], avatar.center[0, 1], avatar.center[0, 2]
    for r in range(3):
        shift0[r] = begin[r, 3] - scene.origin[r]
        shift1[r] = end[r, 3] - scene.origin[r]
        middle = 0.5 * (place(begin, shift0, r, x, y, z) + place(end, shift1, r, x, y, z))
        frame[r] = np.int64(np.rint(middle * per_step))
    farthest = max(largest_term(begin, shift0, x, y, z), largest_term(end, shift1, x, y, z)) * per_step
    longest = (speed * per_step) ** 2
    count = avatar.center.shape[0]
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
    extent = avatar.radius[0] * scale * per_step + 1.0 + longest
    for i in range(count):
        # + 1e-6 as in placed.py; it also covers a scale within 1e-9 of 1, or of the other end's.
        nodes[3, i] = np.float32(avatar.radius[i] * scale * per_step * (1.0 + 1e-6) + extent * 1e-6)
    return extent + CHORD_ERROR * longest, farthest + extent


@borrowing
def _place_block(avatar, block, moving, scene):
    """Place the points of one leaf node of the avatar at both ends of a chord."""
    per_step = 1.0 / scene.step
    lanes, ways, points = moving.lanes, moving.ways, avatar.points
    for r in range(3):
        base = np.float64(moving.frame[r]) * scene.step
        for j in range(LANES):
            x, y, z = points[block, 0, j], points[block, 1, j], points[block, 2, j]
            world = place(moving.ends[0], moving.shifts[0], r, x, y, z)
            lanes[block, r, j] = np.float32((world - base) * per_step)
            end = place(moving.ends[1], moving.shifts[1], r, x, y, z)
            ways[block, r, j] = np.float32((end - world) * per_step)
    for j in range(LANES):
        ways[block, 3, j] = _inverse(ways[block, 0, j], ways[block, 1, j], ways[block, 2, j])


@borrowing
def _nodes_meet(words, row, x, y, z, dx, dy, dz, inverse, radius, latest, limits):
    """Whether a sphere that goes from (x, y, z) by (dx, dy, dz) comes within reach of a node's points before the
    fraction `latest` of that way, as far as its bound can tell: the sphere, then the slab. All float32."""
    wx, wy, wz = x - words[row], y - words[row + 1], z - words[row + 2]
    span = radius + limits.reach + limits.error
    both = words[row + 3] + span
    t = min(max(-(wx * dx + wy * dy + wz * dz) * inverse, ZERO), latest)
    ex, ey, ez = wx + t * dx, wy + t * dy, wz + t * dz
    if ex * ex + ey * ey + ez * ez > both * both * ONE_SLACK:
        return False
    nx, ny, nz = words[row + 4], words[row + 5], words[row + 6]
    begin = nx * wx + ny * wy + nz * wz
    end = begin + latest * (nx * dx + ny * dy + nz * dz)
    room = words[row + 7] * (span + SLACK * both + SLACK * both)
    return min(begin, end) <= words[row + 9] + room and max(begin, end) >= words[row + 8] - room


@borrowing
def pair_times(gap, way, inner, outer):
    """When a point that goes from `gap` by `way` (3,) comes within `outer` of 0, and within `inner`: fractions.

    Returns (enters, certain, closest): enters, rounded down, inf when it never does in [0, 1]; certain, rounded up, inf
    likewise; the fraction of closest approach, within [0, 1].
    """
    dot = gap[0] * way[0] + gap[1] * way[1] + gap[2] * way[2]
    length = math.sqrt(way[0] * way[0] + way[1] * way[1] + way[2] * way[2])
    apart = math.sqrt(gap[0] * gap[0] + gap[1] * gap[1] + gap[2] * gap[2])
    # Rounding of these lines: a few half units in the last place of the lengths. They are whole or far above 2^-500.
    slack = 2.0**-48 * (apart + length)
    outer, inner = outer + slack, inner - slack
    at = -dot / (length * length) if length > 1e-100 else 0.0
    closest = min(max(at, 0.0), 1.0)
    ex, ey, ez = gap[0] + closest * way[0], gap[1] + closest * way[1], gap[2] + closest * way[2]
    if ex * ex + ey * ey + ez * ez > outer * outer:
        return INFINITE, INFINITE, closest
    enters, certain = INFINITE, INFINITE
    if apart <= outer:
        enters = 0.0
        if apart <= inner:
            return 0.0, 0.0, closest
    if length <= 1e-100 or at <= 0.0:
        return enters, certain, closest  # never nearer than now, and now it is not certain
    ex, ey, ez = gap[0] + at * way[0], gap[1] + at * way[1], gap[2] + at * way[2]
    square = ex * ex + ey * ey + ez * ez
    late = 2.0**-48 * (1.0 + apart / length)
    if enters > 0.0:
        enters = max(at - math.sqrt(max(outer * outer - square, 0.0)) / length - late, 0.0)
    if inner > 0.0 and square < inner * inner:
        certain = max(at - math.sqrt(inner * inner - square) / length + late, 0.0)
        if certain > 1.0:
            certain = INFINITE
    return enters, certain, closest


@borrowing
def _scale_of(pose):
    """The scale of a pose, as `check_poses` has it."""
    square = 0.0
    for r in range(3):
        for c in range(3):
            square += pose[r, c] * pose[r, c]
    scale = math.sqrt(square / 3.0)
    return 1.0 if abs(scale - 1.0) <= SIMILARITY_TOLERANCE else scale


@borrowing
def touches_at(job, t, pair):
    """Whether one pair (as in Moving) is in contact under M(t), by NUMERICS.md N5."""
    scene, moving = job.scene, job.moving
    pose_at(job.motion, t, moving.pose)
    for r in range(3):
        moving.shift[r] = moving.pose[r, 3] - scene.origin[r]
    units = np.int64(np.rint(_scale_of(moving.pose) * job.radius * UNITS_PER_METRE)) + job.other_units
    block, lane, voxel, lane_at, block_at, j = pair
    square = pair_square(job.avatar, moving.pose, block, lane, moving, scene, voxel, lane_at, block_at, j)
    return square >= 0 and square <= units * units


@borrowing
def scan_coordinate(scene, pair, r):
    """Lattice coordinate r of a pair's scan point [steps]."""
    low = scene.coordinates[pair[2], r] * scene.voxel_steps + np.int64(scene.ints[pair[4] + r])
    return low + np.int64(scene.halves[pair[3] + r * LANES + pair[5]])


@borrowing
def _comes_first(job, pair, other):
    """Of two pairs that touch at the same moment, whether one is named first: by scan point, then avatar's."""
    for r in range(3):
        one, two = scan_coordinate(job.scene, pair, r), scan_coordinate(job.scene, other, r)
        if one != two:
            return one < two
    points = job.avatar.points
    for r in range(3):
        if points[pair[0], r, pair[1]] != points[other[0], r, other[1]]:
            return points[pair[0], r, pair[1]] < points[other[0], r, other[1]]
    return False


@borrowing
def _certain_by_integers(job, chord, pair, enters, certain, closest):
    """The fraction at which a pair is known to touch, where its integers are asked at two poses of a final chord.

    At the first pose of all, whose contacts are those of `collide`; and where the pair is closest.
    """
    if enters == 0.0 and chord.t0 == 0.0 and certain > 0.0 and touches_at(job, 0.0, pair):
        return 0.0
    if certain == INFINITE:
        t = chord.t1 if closest >= 1.0 else chord.t0 + closest * (chord.t1 - chord.t0)
        if touches_at(job, t, pair):
            return closest
    return certain


@borrowing
def _try_pair(job, chord, pair):
    """Take one pair into account, in float64: may lower moving.first and name another moving.pair."""
    scene, moving, points = job.scene, job.moving, job.avatar.points
    gap, way, first = moving.gap, moving.way, moving.first
    block, lane = pair[0], pair[1]
    x, y, z = points[block, 0, lane], points[block, 1, lane], points[block, 2, lane]
    for r in range(3):
        begin = place(moving.ends[0], moving.shifts[0], r, x, y, z) * UNITS_PER_METRE
        end = place(moving.ends[1], moving.shifts[1], r, x, y, z) * UNITS_PER_METRE
        steps = scan_coordinate(scene, pair, r)
        gap[r] = begin - np.float64(lattice_to_units(steps, scene.units_per_step))
        way[r] = end - begin
    enters, certain, closest = pair_times(gap, way, chord.inner, chord.outer)
    if enters > first[2]:
        return
    key, best = enters, first[0]
    if chord.final:
        certain = _certain_by_integers(job, chord, pair, enters, certain, closest)
        key, best = certain, first[1]
    first[0] = min(first[0], enters)
    if key < best or (key == best and key < INFINITE and _comes_first(job, pair, moving.pair)):
        first[1], first[2] = certain, key
        for n in range(6):
            moving.pair[n] = pair[n]


@borrowing
def _latest(moving):
    """The fraction of the chord that still matters, float32, rounded up."""
    return np.float32(min(moving.first[2] * (1.0 + 1e-6) + 1e-30, 1.0))


@borrowing
def _leaves(job, chord, voxel, block, row, limits):
    """Take all pairs of a leaf node of the avatar and one of the scene into account.

    As in overlap.py: avatar points against the node's bound, then against its points, each in one vector loop.
    """
    scene, moving = job.scene, job.moving
    words, ints, halves = scene.words, scene.ints, scene.halves
    lanes, ways, keep, off = moving.lanes, moving.ways, moving.keep, moving.off
    latest = _latest(moving)
    cx, cy, cz = words[row] + off[0], words[row + 1] + off[1], words[row + 2] + off[2]
    nx, ny, nz = words[row + 4], words[row + 5], words[row + 6]
    both = words[row + 3] + limits.reach + limits.error
    room = words[row + 7] * (limits.reach + limits.error + SLACK * both + SLACK * both)
    least, most = words[row + 8] - room, words[row + 9] + room
    square = both * both * ONE_SLACK
    for j in range(LANES):
        dx, dy, dz = ways[block, 0, j], ways[block, 1, j], ways[block, 2, j]
        wx, wy, wz = lanes[block, 0, j] - cx, lanes[block, 1, j] - cy, lanes[block, 2, j] - cz
        t = min(max(-(wx * dx + wy * dy + wz * dz) * ways[block, 3, j], ZERO), latest)
        ex, ey, ez = wx + t * dx, wy + t * dy, wz + t * dz
        begin = nx * wx + ny * wy + nz * wz
        end = begin + latest * (nx * dx + ny * dy + nz * dz)
        keep[j] = (
            (ex * ex + ey * ey + ez * ez <= square) & (min(begin, end) <= most) & (max(begin, end) >= least)
        )
    scene_block = ~ints[row + FIRST]
    block_at = scene.where[voxel, 1] + scene_block * scene.block_words
    lane_at = scene.where[voxel, 2] + scene_block * 3 * LANES
    lx = off[0] + np.float32(ints[block_at])
    ly = off[1] + np.float32(ints[block_at + 1])
    lz = off[2] + np.float32(ints[block_at + 2])
    for lane in range(LANES):
        if not keep[lane]:
            continue
        x, y, z = lanes[block, 0, lane] - lx, lanes[block, 1, lane] - ly, lanes[block, 2, lane] - lz
        dx, dy, dz, inverse = (
            ways[block, 0, lane],
            ways[block, 1, lane],
            ways[block, 2, lane],
            ways[block, 3, lane],
        )
        moving.counters[1] += LANES
        touched = False
        for j in range(LANES):
            wx = x - np.float32(halves[lane_at + j])
            wy = y - np.float32(halves[lane_at + LANES + j])
            wz = z - np.float32(halves[lane_at + 2 * LANES + j])
            t = min(max(-(wx * dx + wy * dy + wz * dz) * inverse, ZERO), latest)
            ex, ey, ez = wx + t * dx, wy + t * dy, wz + t * dz
            touched |= ex * ex + ey * ey + ez * ez <= limits.far
        if not touched:
            continue
        for j in range(LANES):
            wx = x - np.float32(halves[lane_at + j])
            wy = y - np.float32(halves[lane_at + LANES + j])
            wz = z - np.float32(halves[lane_at + 2 * LANES + j])
            t = min(max(-(wx * dx + wy * dy + wz * dz) * inverse, ZERO), latest)
            ex, ey, ez = wx + t * dx, wy + t * dy, wz + t * dz
            if ex * ex + ey * ey + ez * ez <= limits.far:
                _try_pair(job, chord, (block, lane, voxel, lane_at, block_at, j))
                latest = _latest(moving)


@borrowing
def _sweep_voxel(job, chord, voxel, limits):
    """Take one resident voxel into account: the two trees descended together, depth first.

    Returns whether to go on: not when nothing can be earlier, nor when the visits are spent.
    """
    avatar, scene, moving = job.avatar, job.scene, job.moving
    words, ints = scene.words, scene.ints
    base = scene.where[voxel, 0]
    nodes, off, stack, counters = moving.nodes, moving.off, moving.stack, moving.counters
    for r in range(3):
        off[r] = np.float32(scene.coordinates[voxel, r] * scene.voxel_steps - moving.frame[r])
    counters[0] += 1
    latest = _latest(moving)
    stack[0, 0], stack[0, 1] = 0, base
    depth = 0
    if _nodes_meet(
        words, base, nodes[0, 0] - off[0], nodes[1, 0] - off[1], nodes[2, 0] - off[2],
        nodes[4, 0], nodes[5, 0], nodes[6, 0], nodes[7, 0], nodes[3, 0], latest, limits,
    ):  # fmt: skip
        depth = 1
    while depth > 0:
        if counters[0] > counters[3]:
            return False
        depth -= 1
        a, row = stack[depth, 0], stack[depth, 1]
        a_first, b_first = avatar.first[a], ints[row + FIRST]
        if a_first < 0 and b_first < 0:
            block = ~a_first
            if moving.stamp[block] != counters[2]:
                _place_block(avatar, block, moving, scene)
                moving.stamp[block] = counters[2]
            _leaves(job, chord, voxel, block, row, limits)
            if moving.first[2] <= 0.0:
                return False
            latest = _latest(moving)
        elif b_first < 0 or (a_first >= 0 and nodes[3, a] > words[row + 3]):
            counters[0] += avatar.count[a]
            for child in range(a_first, a_first + avatar.count[a]):
                if _nodes_meet(
                    words, row, nodes[0, child] - off[0], nodes[1, child] - off[1], nodes[2, child] - off[2],
                    nodes[4, child], nodes[5, child], nodes[6, child], nodes[7, child], nodes[3, child],
                    latest, limits,
                ):  # fmt: skip
                    stack[depth, 0], stack[depth, 1] = child, row
                    depth += 1
        else:
            x, y, z = nodes[0, a] - off[0], nodes[1, a] - off[1], nodes[2, a] - off[2]
            dx, dy, dz, inverse = nodes[4, a], nodes[5, a], nodes[6, a], nodes[7, a]
            counters[0] += ints[row + COUNT] & COUNTED
            for i in range(ints[row + COUNT] & COUNTED):
                child_row = base + (b_first + i) * ROW_WORDS
                if _nodes_meet(words, child_row, x, y, z, dx, dy, dz, inverse, nodes[3, a], latest, limits):
                    stack[depth, 0], stack[depth, 1] = a, child_row
                    depth += 1
    return True


@borrowing
def search(job, t0, t1, rows):
    """One descent over the interval [t0, t1], through the voxels `rows`; those not resident are passed by.

    Fills moving.first and moving.pair. Returns (whether all was looked at, whether halving is of no use).
    """
    motion, scene, moving = job.motion, job.scene, job.moving
    pose_at(motion, t0, moving.ends[0])
    pose_at(motion, t1, moving.ends[1])
    length = t1 - t0
    sagitta = motion.bend * length * length / 8.0 * UNITS_PER_METRE
    band = (0.8661 + job.loose + sagitta + 2.0 * motion.slip * UNITS_PER_METRE) * (1.0 + 1e-9)
    chord = Chord(
        t0, t1, np.float64(job.units) - band, np.float64(job.units) + band, sagitta <= LEAST_SAGITTA
    )
    extent, farthest = _place_nodes(job.avatar, job.scale, motion.speed * length, moving, scene)
    widest = np.int64(math.ceil(chord.outer)) + 1
    limits = make_limits(widest, scene.units_per_step, extent, farthest, scene.voxel_steps)
    moving.counters[2] += 1
    moving.first[0], moving.first[1], moving.first[2] = INFINITE, INFINITE, INFINITE
    for row in rows:
        if scene.where[row, 0] >= 0 and not _sweep_voxel(job, chord, row, limits):
            break
    spent = moving.counters[0] > moving.counters[3] and moving.first[2] > 0.0
    return not spent, chord.final
