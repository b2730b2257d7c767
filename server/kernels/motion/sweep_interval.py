"""First contact of a moving avatar with a scene: two hierarchies, one of them moving.

This extends [Fig12] section 6 to time by conservative advancement (Mirtich 1996; Zhang, Redon, Lee,
Kim 2007; Tang, Kim, Manocha 2009, C2A). The bound of an advance comes from the directions of the
motion, not from a maximum speed. Over an interval [t0, t1], every avatar point x is taken to move
straight from a0 = M(t0) x to a1 = M(t1) x, in proportion to time. One descent finds the first
moment at which any straight-moving sphere could touch, and the first at which one must. Each pair
has its own reach: where scan points have radius classes, one descent handles spheres of several
sizes, and a subtree is pruned by its largest sphere.

Proof. Let a*(t) be the ideal motion of x, b a scan point, U the reach of these two, all in exact
units.
 1. |a*(t) - chord of a*| <= B (t1 - t0)^2 / 8, B the greatest |a*''| of any point (`bend`).
 2. A computed coordinate vector, at t, t0 and t1, lies within `slip` of a* (screw_motion.py).
 3. Rounding to whole units moves a by at most sqrt(3) / 2, and b is an integer.
Therefore |a - b|, as NUMERICS.md N5 defines it under M(t), differs from the distance D(t) of b from
the chord by at most

    band = sqrt(3) / 2 + B (t1 - t0)^2 / 8 + 2 slip.

While D > U + band nothing touches; once D <= U - band the pair touches. D is the distance of a
point on a line from a fixed point: both moments are roots of a quadratic. They are computed from
the point of closest approach, whose rounding is relative to the lengths and not to their squares. A
node's sphere moves straight with its centre: |lerp(x) - lerp(c)| is convex in t and therefore never
exceeds the radius. Node pairs are pruned by the least distance of the centre's chord, up to the
earliest certain contact found so far, in float32 with the error bound of placed_avatar.py enlarged
by 32 half units in the last place of the chord.

The resulting interval is halved and quartered until its ends are within the tolerance, or until B
(t1 - t0)^2 / 8 is negligible beside rounding; what is undecided then is a graze. The pairs that are
examined in float64 may differ from tree to tree. Their results do not, and the least result is
taken: no tree, voxel or order therefore changes an answer. A search that ends at the first pair that
may touch where the interval begins decides only that one may.

At a moment, an interval of length 0, the search names the first of the pairs in contact by
NUMERICS.md N11. It visits nodes of lesser x first, and skips nodes whose points all follow. In a hall
this takes 25 us more than a search that ends at the first contact (9 us), for a body of 8,000 points
with 3,400 pairs in contact.

The time of contact of one pair of points (`pair_times`) is float64 with a proof of its bounds;
integers decide at the end.
"""

import math

import numpy as np

from ....schemas.archive.units import UNITS_PER_METRE
from ..core.kernel_decorators import njit_inlined, njit_no_refcount
from ..core.node_bounds import ONE_SLACK, SLACK, has_box, make_thresholds
from ..core.placed_avatar import lattice_to_units, pair_square, to_units
from ..core.reach import HELD, INFINITE, state_of
from ..core.scene_arrays import (
    COUNT,
    COUNTED,
    FIRST,
    LANES,
    ROW_WORDS,
    leaf_class,
    node_class,
    point_class,
    stopped,
)
from .moving_avatar import AvatarChord, least_square, place_block, place_nodes
from .screw_motion import pose_at
from .vector_tuples import dot, minus, norm, place_of, placed, plus, point_of, put, times

# Halving an interval whose sagitta is below this many units is useless: rounding alone contributes
# 0.87 to the band.
LEAST_SAGITTA = 0.25
U = np.uint64  # see placed_avatar.py
ONE_CLASS = np.uint64(0)


@njit_inlined
def _nodes_meet(words, row, x, y, z, dx, dy, dz, inverse, radius, latest, threshold):
    """Return whether a moving sphere may come within `threshold` of a node's points.

    The sphere moves from (x, y, z) by (dx, dy, dz); its way up to the fraction `latest` counts.
    threshold: reach plus error. Tests the sphere, then the slab or each pair of sides of the box. All
    float32.
    """
    at = U(row)
    wx, wy, wz = x - words[at], y - words[at + U(1)], z - words[at + U(2)]
    span = radius + threshold
    both = words[at + U(3)] + span
    if least_square(wx, wy, wz, dx, dy, dz, inverse, latest) > both * both * ONE_SLACK:
        return False
    if has_box(words, row):
        # One branch on all sides costs less than six that are hard to predict.
        wide = span + SLACK * both + SLACK * both
        ex, ey, ez = wx + latest * dx, wy + latest * dy, wz + latest * dz
        mx, my, mz = words[at + U(4)] + wide, words[at + U(5)] + wide, words[at + U(6)] + wide
        return (
            (min(wx, ex) <= mx) & (max(wx, ex) >= -mx)
            & (min(wy, ey) <= my) & (max(wy, ey) >= -my)
            & (min(wz, ez) <= mz) & (max(wz, ez) >= -mz)
        )  # fmt: skip
    nx, ny, nz = words[at + U(4)], words[at + U(5)], words[at + U(6)]
    begin = nx * wx + ny * wy + nz * wz
    end = begin + latest * (nx * dx + ny * dy + nz * dz)
    wide = words[at + U(7)] * (span + SLACK * both + SLACK * both)
    return min(begin, end) <= words[at + U(9)] + wide and max(begin, end) >= words[at + U(8)] - wide


@njit_inlined
def _latest(moving):
    """Return the fraction of the chord that still matters, float32, rounded up."""
    return np.float32(min(moving.first[2] * (1.0 + 1e-6) + 1e-30, 1.0))


@njit_inlined
def _leaves(sweep, chord, voxel, block, row):
    """Update moving.first with all pairs of a leaf node of the avatar and one of the scene.

    As in collide_poses.py: avatar points are tested against the node's bound, then against its
    points, each in one vector loop.
    """
    scene, moving = sweep.scene, sweep.moving
    words, ints, halves = scene.words, scene.ints, scene.halves
    lanes, displacements, keep, off = moving.lanes, moving.displacements, moving.keep, moving.off
    thresholds, mask = moving.thresholds, np.uint64(scene.radius_deficit.shape[0] - 1)
    threshold = thresholds[0, node_class(ints, row, mask)]
    far = thresholds[1, leaf_class(ints, row, mask)]  # for the largest sphere in the scene's block
    latest = _latest(moving)
    at, own = U(row), U(block)
    cx, cy, cz = words[at] + off[0], words[at + U(1)] + off[1], words[at + U(2)] + off[2]
    nx, ny, nz = words[at + U(4)], words[at + U(5)], words[at + U(6)]
    both = words[at + U(3)] + threshold
    wide = abs(words[at + U(7)]) * (threshold + SLACK * both + SLACK * both)
    least, most = words[at + U(8)] - wide, words[at + U(9)] + wide
    square, boxed = both * both * ONE_SLACK, has_box(words, row)
    some = False
    for j in range(LANES):
        dx, dy, dz = displacements[own, 0, j], displacements[own, 1, j], displacements[own, 2, j]
        wx, wy, wz = lanes[own, 0, j] - cx, lanes[own, 1, j] - cy, lanes[own, 2, j] - cz
        near = least_square(wx, wy, wz, dx, dy, dz, displacements[own, 3, j], latest) <= square
        if boxed:
            ex, ey, ez = wx + latest * dx, wy + latest * dy, wz + latest * dz
            near &= (min(wx, ex) <= nx + wide) & (max(wx, ex) >= -nx - wide)
            near &= (min(wy, ey) <= ny + wide) & (max(wy, ey) >= -ny - wide)
            near &= (min(wz, ez) <= nz + wide) & (max(wz, ez) >= -nz - wide)
        else:
            begin = nx * wx + ny * wy + nz * wz
            end = begin + latest * (nx * dx + ny * dy + nz * dz)
            near &= (min(begin, end) <= most) & (max(begin, end) >= least)
        keep[j] = near
        some |= near
    if not some:
        return
    scene_block = ~ints[at + U(FIRST)]
    block_at = scene.where[voxel, 1] + scene_block * scene.block_words
    lane_at = scene.where[voxel, 2] + scene_block * 3 * LANES
    low, at_x = U(block_at), U(lane_at)
    at_y, at_z = at_x + U(LANES), at_x + U(2 * LANES)
    lx = off[0] + np.float32(ints[low])
    ly = off[1] + np.float32(ints[low + U(1)])
    lz = off[2] + np.float32(ints[low + U(2)])
    for lane in range(LANES):
        if not keep[lane]:
            continue
        x, y, z = lanes[own, 0, lane] - lx, lanes[own, 1, lane] - ly, lanes[own, 2, lane] - lz
        dx, dy, dz, inverse = (
            displacements[own, 0, lane],
            displacements[own, 1, lane],
            displacements[own, 2, lane],
            displacements[own, 3, lane],
        )
        moving.counters[1] += LANES
        touched = False
        for j in range(LANES):
            wx = x - np.float32(halves[at_x + U(j)])
            wy = y - np.float32(halves[at_y + U(j)])
            wz = z - np.float32(halves[at_z + U(j)])
            touched |= least_square(wx, wy, wz, dx, dy, dz, inverse, latest) <= far
        if not touched:
            continue
        for j in range(LANES):
            wx = x - np.float32(halves[at_x + U(j)])
            wy = y - np.float32(halves[at_y + U(j)])
            wz = z - np.float32(halves[at_z + U(j)])
            square = least_square(wx, wy, wz, dx, dy, dz, inverse, latest)
            if square <= far and square <= thresholds[1, point_class(ints, block_at, j, mask)]:
                try_pair(sweep, chord, (block, lane, voxel, lane_at, block_at, j))
                latest = _latest(moving)


@njit_no_refcount
def _least(words, row, r):
    """Return a lower bound of coordinate r of a node's points, from the voxel's low corner [steps]."""
    at = U(row)
    half = words[at + U(4 + r)] if has_box(words, row) else words[at + U(3)]
    return np.float64(words[at + U(r)]) - np.float64(half)


@njit_no_refcount
def _follows(sweep, chord, voxel, a, row):
    """Return whether every pair of two nodes that touches follows moving.pair (NUMERICS.md N11)."""
    scene, moving = sweep.scene, sweep.moving
    x, y, z = pair_point(scene, found_pair(moving))
    # A scan point that touches the avatar's node is within its radius and the reach; 1: rounding.
    reach = np.float64(moving.nodes[3, a]) + chord.outer / scene.units_per_step + 1.0
    if np.float64(moving.nodes[0, a]) - reach > np.float64(x - moving.frame[0]):
        return True
    least = _least(scene.words, row, 0), _least(scene.words, row, 1), _least(scene.words, row, 2)
    corner = scene.corners[voxel]
    return least > (np.float64(x - corner[0]), np.float64(y - corner[1]), np.float64(z - corner[2]))


@njit_inlined
def _sweep_voxel(sweep, chord, voxel):
    """Update moving.first with one resident voxel by a joint descent, depth first.

    Returns whether to continue: not when nothing can be earlier, or when the scene's stop flag is
    set. A chord of length 0 continues, and skips nodes whose points all
    follow the best pair's.
    """
    avatar, scene, moving = sweep.avatar, sweep.scene, sweep.moving
    words, ints = scene.words, scene.ints
    base = scene.where[voxel, 0]
    thresholds, mask = moving.thresholds[0], np.uint64(scene.radius_deficit.shape[0] - 1)
    nodes, off, stack, counters = moving.nodes, moving.off, moving.stack, moving.counters
    for r in range(3):
        off[r] = np.float32(scene.corners[voxel, r] - moving.frame[r])
    widest = thresholds[0]  # of the only class, if there is one
    counters[0] += 1
    latest = _latest(moving)
    stack[0, 0], stack[0, 1] = 0, base
    depth = 0
    if _nodes_meet(
        words, base, nodes[0, 0] - off[0], nodes[1, 0] - off[1], nodes[2, 0] - off[2],
        nodes[4, 0], nodes[5, 0], nodes[6, 0], nodes[7, 0], nodes[3, 0], latest,
        thresholds[node_class(ints, base, mask)],
    ):  # fmt: skip
        depth = 1
    while depth > 0:
        if stopped(scene.stop):
            return False
        depth -= 1
        a, row = stack[depth, 0], stack[depth, 1]
        if moving.first[2] <= 0.0 and _follows(sweep, chord, voxel, a, row):
            continue
        a_first, b_first = avatar.first[a], ints[U(row) + U(FIRST)]
        if a_first < 0 and b_first < 0:
            block = ~a_first
            if moving.stamp[block] != counters[2]:
                place_block(avatar, block, moving, scene)
                moving.stamp[block] = counters[2]
            _leaves(sweep, chord, voxel, block, row)
            if moving.first[2] <= 0.0 and chord.t1 > chord.t0:
                return False
            latest = _latest(moving)
        elif b_first < 0 or (a_first >= 0 and nodes[3, a] > words[U(row) + U(3)]):
            counters[0] += avatar.count[a]
            threshold = widest if mask == ONE_CLASS else thresholds[node_class(ints, row, mask)]
            for child in range(a_first, a_first + avatar.count[a]):
                if _nodes_meet(
                    words, row, nodes[0, child] - off[0], nodes[1, child] - off[1], nodes[2, child] - off[2],
                    nodes[4, child], nodes[5, child], nodes[6, child], nodes[7, child], nodes[3, child],
                    latest, threshold,
                ):  # fmt: skip
                    stack[depth, 0], stack[depth, 1] = child, row
                    depth += 1
        else:
            x, y, z = nodes[0, a] - off[0], nodes[1, a] - off[1], nodes[2, a] - off[2]
            dx, dy, dz, inverse = nodes[4, a], nodes[5, a], nodes[6, a], nodes[7, a]
            count = ints[U(row) + U(COUNT)] & COUNTED
            counters[0] += count
            begin = depth
            for i in range(count):
                child_row = base + (b_first + i) * ROW_WORDS
                threshold = widest if mask == ONE_CLASS else thresholds[node_class(ints, child_row, mask)]
                if _nodes_meet(
                    words, child_row, x, y, z, dx, dy, dz, inverse, nodes[3, a], latest, threshold
                ):
                    stack[depth, 0], stack[depth, 1] = a, child_row
                    depth += 1
            if chord.t0 == chord.t1:  # the node with the least x first
                for at in range(begin, depth - 1):
                    if _least(words, stack[at, 1], 0) < _least(words, stack[depth - 1, 1], 0):
                        stack[at, 1], stack[depth - 1, 1] = stack[depth - 1, 1], stack[at, 1]
    return True


@njit_no_refcount
def search(sweep, t0, t1, rows, state):
    """Descend once over the interval [t0, t1], through those voxels of `rows` that are held.

    Fills moving.first and moving.pair. With t0 < t1 the search ends at the first pair found that
    may touch at t0; with t0 = t1 it finds the first of these pairs by NUMERICS.md N11. Returns
    (whether the search was complete, whether halving the interval is useless).
    """
    motion, scene, moving = sweep.motion, sweep.scene, sweep.moving
    pose_at(motion, t0, moving.ends[0])
    pose_at(motion, t1, moving.ends[1])
    length = t1 - t0
    sagitta = motion.bend * length * length / 8.0 * UNITS_PER_METRE
    band = (0.8661 + sagitta + 2.0 * motion.slip * UNITS_PER_METRE) * (1.0 + 1e-9)
    chord = AvatarChord(
        t0, t1, np.float64(sweep.units) - band, np.float64(sweep.units) + band, sagitta <= LEAST_SAGITTA
    )
    extent, farthest = place_nodes(sweep.avatar, motion.speed * length, moving, scene)
    widest = np.int64(math.ceil(chord.outer)) + 1
    for c in range(scene.radius_deficit.shape[0]):
        thresholds = make_thresholds(
            widest - scene.radius_deficit[c], scene.units_per_step, extent, farthest, scene.voxel_steps
        )
        moving.thresholds[0, c], moving.thresholds[1, c] = thresholds.reach + thresholds.error, thresholds.far
    moving.counters[2] += 1
    moving.first[0], moving.first[1], moving.first[2] = INFINITE, INFINITE, INFINITE
    for row in rows:
        if state_of(state, row) == HELD and not _sweep_voxel(sweep, chord, row):
            break
    return not (stopped(scene.stop) and moving.first[2] > 0.0), chord.final


@njit_no_refcount
def pair_times(gap, displacement, inner, outer):
    """Compute when a point moving from `gap` by `displacement` is within `outer` and `inner`.

    Returns (earliest_possible, earliest_certain, closest), fractions. earliest_possible: when it
    comes within `outer`, rounded down; inf if it never does in [0, 1]. earliest_certain: when it
    comes within `inner`, rounded up; inf likewise. closest: the fraction of closest approach, in
    [0, 1].
    """
    length, apart = norm(displacement), norm(gap)
    # Rounding of these lines: a few half units in the last place of the lengths, which are integers
    # or far above 2^-500.
    slack = 2.0**-48 * (apart + length)
    outer, inner = outer + slack, inner - slack
    at = -dot(gap, displacement) / (length * length) if length > 1e-100 else 0.0
    closest = min(max(at, 0.0), 1.0)
    nearest = plus(gap, times(closest, displacement))
    if dot(nearest, nearest) > outer * outer:
        return INFINITE, INFINITE, closest
    earliest_possible, earliest_certain = INFINITE, INFINITE
    if apart <= outer:
        earliest_possible = 0.0
        if apart <= inner:
            return 0.0, 0.0, closest
    if length <= 1e-100 or at <= 0.0:  # never nearer than now, and contact is not certain now
        return earliest_possible, earliest_certain, closest
    nearest = plus(gap, times(at, displacement))
    square = dot(nearest, nearest)
    late = 2.0**-48 * (1.0 + apart / length)
    if earliest_possible > 0.0:
        earliest_possible = max(at - math.sqrt(max(outer * outer - square, 0.0)) / length - late, 0.0)
    if inner > 0.0 and square < inner * inner:
        earliest_certain = max(at - math.sqrt(inner * inner - square) / length + late, 0.0)
        if earliest_certain > 1.0:
            earliest_certain = INFINITE
    return earliest_possible, earliest_certain, closest


@njit_no_refcount
def _deficit_of(scene, pair):
    """Return the largest radius of the scan minus that of a pair's scan point, exact units."""
    return scene.radius_deficit[
        point_class(scene.ints, pair[4], pair[5], np.uint64(scene.radius_deficit.shape[0] - 1))
    ]


@njit_no_refcount
def touches_at(sweep, t, pair):
    """Return whether one pair (as in MovingAvatar) is in contact under M(t), by NUMERICS.md N5."""
    scene, moving = sweep.scene, sweep.moving
    pose_at(sweep.motion, t, moving.pose)
    put(moving.shift, minus(place_of(moving.pose), scene.origin))
    units = sweep.units - _deficit_of(scene, pair)
    block, lane, voxel, lane_at, block_at, j = pair
    square = pair_square(sweep.avatar, moving.pose, block, lane, moving, scene, voxel, lane_at, block_at, j)
    return square >= 0 and square <= units * units


@njit_no_refcount
def found_pair(moving):
    """Return the pair that a search has found, see MovingAvatar."""
    pair = moving.pair
    return pair[0], pair[1], pair[2], pair[3], pair[4], pair[5]


@njit_no_refcount
def scan_point(scene, voxel, at, block, j):
    """Return the lattice coordinates of a scan point [steps]. at, block: `lane_at`, `block_at` of a pair."""
    corners, ints, halves = scene.corners, scene.ints, scene.halves
    return (
        corners[voxel, 0] + np.int64(ints[block]) + np.int64(halves[at + j]),
        corners[voxel, 1] + np.int64(ints[block + 1]) + np.int64(halves[at + LANES + j]),
        corners[voxel, 2] + np.int64(ints[block + 2]) + np.int64(halves[at + 2 * LANES + j]),
    )


@njit_no_refcount
def pair_point(scene, pair):
    """Return the lattice coordinates of a pair's scan point [steps]."""
    return scan_point(scene, pair[2], pair[3], pair[4], pair[5])


@njit_no_refcount
def _comes_first(sweep, pair, other):
    """Return whether `pair` precedes `other`, which touches at the same moment (NUMERICS.md N11).

    The scan point decides first, then the avatar's centre at the beginning of the chord.
    """
    one, two = pair_point(sweep.scene, pair), pair_point(sweep.scene, other)
    if one != two:
        return one < two
    return _placed_units(sweep, pair) < _placed_units(sweep, other)


@njit_no_refcount
def _placed_units(sweep, pair):
    """Return a pair's avatar point at the beginning of the chord, exact units."""
    moving = sweep.moving
    x, y, z = placed(moving.ends[0], moving.shifts[0], point_of(sweep.avatar.points, pair[0], pair[1]))
    return to_units(x), to_units(y), to_units(z)


@njit_no_refcount
def _certain_by_integers(sweep, chord, pair, earliest_possible, earliest_certain, closest):
    """Return the fraction at which a pair certainly touches, also tested by integers at two poses.

    It is for final chords. The poses are the first pose of the whole motion, where contact is that
    of `collide`, and the pose where the pair is closest.
    """
    if (
        earliest_possible == 0.0
        and chord.t0 == 0.0
        and earliest_certain > 0.0
        and touches_at(sweep, 0.0, pair)
    ):
        return 0.0
    if earliest_certain == INFINITE:
        t = chord.t1 if closest >= 1.0 else chord.t0 + closest * (chord.t1 - chord.t0)
        if touches_at(sweep, t, pair):
            return closest
    return earliest_certain


@njit_no_refcount
def try_pair(sweep, chord, pair):
    """Update moving.first and moving.pair with one pair, in float64."""
    scene, moving, first = sweep.scene, sweep.moving, sweep.moving.first
    if first[2] <= 0.0 and not _comes_first(sweep, pair, found_pair(moving)):
        return
    ends, shifts, per_step = moving.ends, moving.shifts, scene.units_per_step
    point, steps = point_of(sweep.avatar.points, pair[0], pair[1]), pair_point(scene, pair)
    begin = times(UNITS_PER_METRE, placed(ends[0], shifts[0], point))
    end = times(UNITS_PER_METRE, placed(ends[1], shifts[1], point))
    cloud = (
        np.float64(lattice_to_units(steps[0], per_step)),
        np.float64(lattice_to_units(steps[1], per_step)),
        np.float64(lattice_to_units(steps[2], per_step)),
    )
    deficit = np.float64(_deficit_of(scene, pair))
    earliest_possible, earliest_certain, closest = pair_times(
        minus(begin, cloud), minus(end, begin), chord.inner - deficit, chord.outer - deficit
    )
    if earliest_possible > first[2]:
        return
    key, best = earliest_possible, first[0]
    if chord.final:
        earliest_certain = _certain_by_integers(
            sweep, chord, pair, earliest_possible, earliest_certain, closest
        )
        key, best = earliest_certain, first[1]
    first[0] = min(first[0], earliest_possible)
    if key < best or (key == best and key < INFINITE and _comes_first(sweep, pair, found_pair(moving))):
        first[1], first[2] = earliest_certain, key
        for n in range(6):
            moving.pair[n] = pair[n]
