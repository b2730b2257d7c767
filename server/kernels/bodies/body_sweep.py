"""First contact of a moving avatar with a standing one: a joint descent of two avatar trees.

The motion is that of kernels/motion/screw_motion.py, the contact that of
kernels/bodies/body_pairs.py: both bodies are placed relative to the dataset's origin, in float64,
and each centre is rounded once to exact units. The proof is that of
kernels/motion/sweep_interval.py, with a rounded point of the standing avatar in place of the scan
point. Over [t0, t1], every moving point is taken along its chord, at most `band` from its true
position:

    band = sqrt(3) / 2 + B (t1 - t0)^2 / 8 + 2 slip

An interval that may contain an early contact is halved and quartered until its sagitta is
negligible beside rounding. A translation has no sagitta and takes one descent.

The answer is the fraction up to which nothing touches. There the bodies are in contact, or graze
within 1.2 units (18 nm) of contact. All arithmetic is float64: avatars have some thousand points,
few of which are near one another.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ....schemas.archive.units import UNITS_PER_METRE
from ....schemas.runtime import compiling as nb
from ..core.kernel_decorators import njit_no_refcount
from ..core.node_bounds import STACK
from ..core.placed_avatar import Avatar, largest_term, place
from ..core.reach import INFINITE
from ..core.scene_arrays import LANES, stopped
from ..motion.moving_avatar import least_square
from ..motion.screw_motion import ScrewMotion, make_motion, pose_at
from ..motion.sweep_interval import LEAST_SAGITTA, pair_times
from ..motion.sweep_segments import CHORD_BEND, MAX_REFUSED, longest_part
from ..motion.vector_tuples import dot, minus, place_of, placed, plus, point_of, put, times, vector
from .body_pairs import STRETCH, PlacedBody


class BodyScratch(NamedTuple):
    """Scratch of one thread, for avatars of limited size; see `make_body_scratch`.

    stack: (s, 2) int64, pairs of nodes still to examine.
    moving: (8, nodes): a node's centre at the beginning, its displacement, 1 / its square, its
    radius.
    paths: (blocks, 7, LANES), the same of points, without a radius.
    standing: (4, nodes), centres and radii.  lanes: (blocks, 3, LANES), points.
    stamps: (2, blocks) int64: the chord and the body that a block was placed for.
    turns: (2,) int64, chords and bodies so far.
    keep: (LANES,).
    ends: (2, 4, 4), the poses of a chord's ends.
    first: (2,), when the first contact is possible, and when a contact is certain.
    pair: (4,) int64, block and lane of either point.
    counters: (2,), node visits, point tests.
    """

    stack: NDArray[np.int64]
    moving: NDArray[np.float64]
    paths: NDArray[np.float64]
    standing: NDArray[np.float64]
    lanes: NDArray[np.float64]
    stamps: NDArray[np.int64]
    turns: NDArray[np.int64]
    keep: NDArray[np.bool_]
    ends: NDArray[np.float64]
    first: NDArray[np.float64]
    pair: NDArray[np.int64]
    counters: NDArray[np.int64]


def make_body_scratch(nodes: int, blocks: int) -> BodyScratch:
    """Allocate scratch for `sweep_bodies`.

    nodes, blocks: the most that an avatar has.
    """
    return BodyScratch(
        np.empty((STACK, 2), np.int64), np.empty((8, nodes)), np.empty((blocks, 7, LANES)), np.empty((4, nodes)),
        np.empty((blocks, 3, LANES)), np.full((2, blocks), -1, np.int64), np.zeros(2, np.int64),
        np.empty(LANES, np.bool_), np.empty((2, 4, 4)), np.empty(2), np.zeros(4, np.int64), np.zeros(2, np.int64),
    )  # fmt: skip


class BodySweep(NamedTuple):
    """One motion against one body.

    motion: ScrewMotion of a.  b: the standing body.  units: both radii plus the margin.
    error: of a distance of two placed centres, and of their rounding to units [m].
    stop: (1,) int64, a stop flag.
    """

    motion: ScrewMotion
    a: Avatar
    b: PlacedBody
    units: np.int64
    error: float
    scratch: BodyScratch
    stop: NDArray[np.int64]


class BodyChord(NamedTuple):
    """Straight approximation of a motion over one interval from t0 on (body_sweep.py).

    inner, outer: U - band, U + band, exact units, where U is `BodySweep.units`.  threshold: outer
    with the error [m].
    final: whether halving the interval is useless.
    """

    t0: float
    inner: float
    outer: float
    threshold: float
    final: bool


@njit_no_refcount
def _inverse_square(x, y, z):
    """Return 1 / (x^2 + y^2 + z^2), or 0 where the sum is too small to divide by."""
    square = x * x + y * y + z * z
    return 1.0 / square if square > 1e-200 else 0.0


@njit_no_refcount
def _place_moving(sweep, block):
    """Place the points of a leaf node of the moving avatar at both ends of a chord."""
    paths, points, first, last = (
        sweep.scratch.paths,
        sweep.a.points,
        sweep.scratch.ends[0],
        sweep.scratch.ends[1],
    )
    shift_first, shift_last = place_of(first), place_of(last)
    for r in range(3):
        for k in range(LANES):
            x, y, z = points[block, 0, k], points[block, 1, k], points[block, 2, k]
            begin = place(first, shift_first, r, x, y, z)
            paths[block, r, k] = begin
            paths[block, 3 + r, k] = place(last, shift_last, r, x, y, z) - begin
    for k in range(LANES):
        paths[block, 6, k] = _inverse_square(paths[block, 3, k], paths[block, 4, k], paths[block, 5, k])


@njit_no_refcount
def _place_standing(sweep, block):
    """Place the points of a leaf node of the standing avatar."""
    lanes, body, points = sweep.scratch.lanes, sweep.b, sweep.b.avatar.points
    for r in range(3):
        for k in range(LANES):
            x, y, z = points[block, 0, k], points[block, 1, k], points[block, 2, k]
            lanes[block, r, k] = place(body.pose, body.shift, r, x, y, z)


@njit_no_refcount
def _place_moving_nodes(sweep, count):
    """Place the first `count` nodes of the moving avatar at both ends of a chord."""
    moving, first, last = sweep.scratch.moving, sweep.scratch.ends[0], sweep.scratch.ends[1]
    for i in range(count):
        center = vector(sweep.a.center[i])
        begin = placed(first, place_of(first), center)
        way = minus(placed(last, place_of(last), center), begin)
        for r in range(3):
            moving[r, i], moving[3 + r, i] = begin[r], way[r]
        moving[6, i] = _inverse_square(way[0], way[1], way[2])
        moving[7, i] = sweep.a.radius[i] * STRETCH


@njit_no_refcount
def _place_standing_nodes(sweep):
    """Place the nodes of the standing avatar."""
    standing, body, b = sweep.scratch.standing, sweep.b, sweep.b.avatar
    for j in range(b.center.shape[0]):
        center = placed(body.pose, body.shift, b.center[j])
        for r in range(3):
            standing[r, j] = center[r]
        standing[3, j] = b.radius[j] * STRETCH


@njit_no_refcount
def _latest(scratch):
    """Return the fraction of a chord that still matters, rounded up."""
    return min(scratch.first[0] * (1.0 + 1e-9) + 1e-30, 1.0)


@njit_no_refcount
def _try_pair(sweep, chord, block_a, lane_a, block_b, lane_b):
    """Update scratch.first with one pair of points; lanes are those of block_b."""
    scratch, first = sweep.scratch, sweep.scratch.first
    ends, point = scratch.ends, point_of(sweep.a.points, block_a, lane_a)
    begin = times(UNITS_PER_METRE, placed(ends[0], place_of(ends[0]), point))
    end = times(UNITS_PER_METRE, placed(ends[1], place_of(ends[1]), point))
    x, y, z = times(UNITS_PER_METRE, point_of(scratch.lanes, block_b, lane_b))
    standing = np.rint(x), np.rint(y), np.rint(z)
    gap, displacement = minus(begin, standing), minus(end, begin)
    earliest_possible, earliest_certain, _ = pair_times(gap, displacement, chord.inner, chord.outer)
    if earliest_possible == 0.0 and earliest_certain > 0.0 and chord.t0 == 0.0 and chord.final:
        # A pair within the band at the start that does not touch there and comes no nearer does not count.
        square = np.int64(0)
        for r in range(3):
            difference = np.int64(np.rint(begin[r])) - np.int64(standing[r])
            square += difference * difference
        if dot(gap, displacement) >= 0.0 and square > sweep.units * sweep.units:
            return
    if earliest_possible < first[0]:
        first[0] = earliest_possible
        pair = scratch.pair
        pair[0], pair[1], pair[2], pair[3] = block_a, lane_a, block_b, lane_b
    first[1] = min(first[1], earliest_certain)


@njit_no_refcount
def _bounds_of(lane, threshold):
    """Return the least and greatest coordinate of (LANES,), widened by `threshold` on each side."""
    least, most = lane[0], lane[0]
    for k in range(LANES):
        least, most = min(least, lane[k]), max(most, lane[k])
    return least - threshold * (1.0 + 1e-12), most + threshold * (1.0 + 1e-12)


@njit_no_refcount
def _mark_near(scratch, block_a, block_b, j, threshold):
    """Mark in scratch.keep the points of a moving block that come near a standing block.

    Near: within `threshold` of the sphere of its node j and of the box of its points.
    """
    standing, paths, keep, latest = scratch.standing, scratch.paths, scratch.keep, _latest(scratch)
    bx, by, bz = standing[0, j], standing[1, j], standing[2, j]
    span = (standing[3, j] + threshold) * (1.0 + 1e-12)
    span *= span
    low_x, high_x = _bounds_of(scratch.lanes[block_b, 0], threshold)
    low_y, high_y = _bounds_of(scratch.lanes[block_b, 1], threshold)
    low_z, high_z = _bounds_of(scratch.lanes[block_b, 2], threshold)
    for k in range(LANES):
        px, py, pz = paths[block_a, 0, k], paths[block_a, 1, k], paths[block_a, 2, k]
        wx, wy, wz = paths[block_a, 3, k], paths[block_a, 4, k], paths[block_a, 5, k]
        square = least_square(px - bx, py - by, pz - bz, wx, wy, wz, paths[block_a, 6, k], latest)
        qx, qy, qz = px + latest * wx, py + latest * wy, pz + latest * wz
        keep[k] = (
            (square <= span)
            & (min(px, qx) <= high_x)
            & (max(px, qx) >= low_x)
            & (min(py, qy) <= high_y)
            & (max(py, qy) >= low_y)
            & (min(pz, qz) <= high_z)
            & (max(pz, qz) >= low_z)
        )


@njit_no_refcount
def _leaves(sweep, chord, i, j):
    """Update scratch.first with all pairs of two leaf nodes.

    Moving points are tested against the standing node's bounds, then against its points, each in
    one vector loop. LANES is a constant; the loops therefore include the entries beyond a node's
    count, which repeat its last point.
    """
    scratch = sweep.scratch
    lanes, paths, stamps, turns = scratch.lanes, scratch.paths, scratch.stamps, scratch.turns
    block_a, block_b = ~sweep.a.first[i], ~sweep.b.avatar.first[j]
    if stamps[0, block_a] != turns[0]:
        _place_moving(sweep, block_a)
        stamps[0, block_a] = turns[0]
    if stamps[1, block_b] != turns[1]:
        _place_standing(sweep, block_b)
        stamps[1, block_b] = turns[1]
    _mark_near(scratch, block_a, block_b, j, chord.threshold)
    far, latest = chord.threshold * chord.threshold * (1.0 + 1e-12), _latest(scratch)
    for lane in range(sweep.a.count[i]):
        if not scratch.keep[lane]:
            continue
        scratch.counters[1] += LANES
        px, py, pz = paths[block_a, 0, lane], paths[block_a, 1, lane], paths[block_a, 2, lane]
        wx, wy, wz = paths[block_a, 3, lane], paths[block_a, 4, lane], paths[block_a, 5, lane]
        inverse = paths[block_a, 6, lane]
        touched = False
        for k in range(LANES):
            gx, gy, gz = px - lanes[block_b, 0, k], py - lanes[block_b, 1, k], pz - lanes[block_b, 2, k]
            touched |= least_square(gx, gy, gz, wx, wy, wz, inverse, latest) <= far
        if not touched:
            continue
        for k in range(sweep.b.avatar.count[j]):
            gx, gy, gz = px - lanes[block_b, 0, k], py - lanes[block_b, 1, k], pz - lanes[block_b, 2, k]
            if least_square(gx, gy, gz, wx, wy, wz, inverse, latest) <= far:
                _try_pair(sweep, chord, block_a, lane, block_b, k)
                latest = _latest(scratch)


@njit_no_refcount
def _nearest(scratch, threshold, i, j):
    """Return the least squared distance that the centres of two nodes reach.

    inf where nothing below them can touch before the contact found so far.
    """
    moving, standing = scratch.moving, scratch.standing
    both = (moving[7, i] + standing[3, j] + threshold) * (1.0 + 1e-12)
    square = least_square(
        moving[0, i] - standing[0, j], moving[1, i] - standing[1, j], moving[2, i] - standing[2, j],
        moving[3, i], moving[4, i], moving[5, i], moving[6, i], _latest(scratch),
    )  # fmt: skip
    return square if square <= both * both else INFINITE


@njit_no_refcount
def _descend(sweep, chord):
    """Descend both trees once for one chord; fill scratch.first.

    The larger inner node is opened, a leaf never is. Among children, the pair whose centres come
    nearest is visited first: early contacts are then found early, and prune.
    """
    scratch, a, b = sweep.scratch, sweep.a, sweep.b.avatar
    stack, counters = scratch.stack, scratch.counters
    scratch.turns[0] += 1
    scratch.first[0], scratch.first[1] = INFINITE, INFINITE
    counters[0] += 1
    _place_moving_nodes(sweep, 1)
    if _nearest(scratch, chord.threshold, 0, 0) == INFINITE:
        return
    _place_moving_nodes(sweep, a.center.shape[0])
    stack[0, 0], stack[0, 1] = 0, 0
    depth = 1
    while depth > 0 and not stopped(sweep.stop):
        depth -= 1
        i, j = stack[depth, 0], stack[depth, 1]
        if _nearest(scratch, chord.threshold, i, j) == INFINITE:
            continue
        first_a, first_b = a.first[i], b.first[j]
        if first_a < 0 and first_b < 0:
            _leaves(sweep, chord, i, j)
            if scratch.first[0] <= 0.0:
                return
            continue
        opens_a = first_b < 0 or (first_a >= 0 and a.radius[i] > b.radius[j])
        first, count = (first_a, a.count[i]) if opens_a else (first_b, b.count[j])
        counters[0] += count
        nearest, least = depth, INFINITE
        for child in range(first, first + count):
            one, other = (child, j) if opens_a else (i, child)
            square = _nearest(scratch, chord.threshold, one, other)
            if square == INFINITE:
                continue
            stack[depth, 0], stack[depth, 1] = one, other
            if square < least:
                nearest, least = depth, square
            depth += 1
        if least < INFINITE:
            last = depth - 1
            one, other = stack[nearest, 0], stack[nearest, 1]
            stack[nearest, 0], stack[nearest, 1] = stack[last, 0], stack[last, 1]
            stack[last, 0], stack[last, 1] = one, other


@njit_no_refcount
def _search(sweep, t0, t1):
    """Descend once over [t0, t1]; fill scratch.first and pair.

    Returns whether halving the interval is useless.
    """
    motion, scratch = sweep.motion, sweep.scratch
    pose_at(motion, t0, scratch.ends[0])
    pose_at(motion, t1, scratch.ends[1])
    sagitta = motion.bend * (t1 - t0) * (t1 - t0) / 8.0 * UNITS_PER_METRE
    # The standing point is an integer, except far out where float64 cannot represent it; `error`
    # covers that.
    loose = (2.0 * motion.slip + sweep.error) * UNITS_PER_METRE
    band = (0.8661 + sagitta + loose) * (1.0 + 1e-9)
    outer = np.float64(sweep.units) + band
    final = sagitta <= LEAST_SAGITTA
    threshold = outer / UNITS_PER_METRE + 2.0 / UNITS_PER_METRE + 8.0 * sweep.error
    _descend(sweep, BodyChord(t0, np.float64(sweep.units) - band, outer, threshold, final))
    return final


@njit_no_refcount
def _advance(sweep, size, until, tolerance):
    """Return how far nothing touches, if that is before `until`; else inf.

    scratch.pair is then the pair that touches first.
    """
    motion, first = sweep.motion, sweep.scratch.first
    longest = longest_part(motion, INFINITE, CHORD_BEND * size)
    t, length, refused = 0.0, longest, 0
    while True:
        after = until if t + length >= until else t + length
        final = _search(sweep, t, after)
        if stopped(sweep.stop):
            return INFINITE
        if first[0] == INFINITE:
            if after >= until:
                return INFINITE
            t, length = after, min(2.0 * length, longest)
            continue
        since = max(t, t + first[0] * (after - t) - 2.0**-52)
        sure = t + first[1] * (after - t) if first[1] <= 1.0 else INFINITE
        refused += 1
        if final or refused > MAX_REFUSED or motion.speed * (sure - since) <= tolerance:
            return since
        length = max(min(sure - since, 0.25 * (after - t)), 2.0**-52)
        t = since


@nb.njit(nogil=True, cache=True)
def sweep_bodies(
    a, box, units_a, first, last, b, poses, units_b, rows, origin, margin_units, tolerance, until, witness, named,
    scratch, stop,
):  # fmt: skip
    """Find the first of some standing bodies, all of avatar b, that ends a motion of avatar a.

    Neither avatar is empty.
    box: (2, 3) of a.  first, last: (4, 4), checked, rigid, translations relative to the origin.
    poses: (n, 4, 4), checked, rigid, world.  units_a, units_b, margin_units: radii and margin,
    exact units.  rows: (m,) int64, of poses.  until: contacts at or after it are ignored; inf: none
    is.  stop: (1,) int64, a stop flag; once it is set, the result is meaningless.
    Returns (row, fraction): none of these bodies touches before the fraction. The body of the row
    touches or grazes there, or before the fastest point has moved `tolerance` [m] farther. Returns
    (-1, until) if none touches. Writes witness (2, 3): the centres of the two spheres there, world
    [m]; named (2,) int64: block and lane of the body's point. Adds to scratch.counters.
    """
    motion = make_motion(first, last, box, np.zeros(3))
    pose = np.empty((4, 4))
    extent, root, other = minus(box[1], box[0]), vector(a.center[0]), vector(b.center[0])
    size = 1e-6 + abs(extent[0]) + abs(extent[1]) + abs(extent[2])
    largest_a = max(
        largest_term(first, place_of(first), root[0], root[1], root[2]),
        largest_term(last, place_of(last), root[0], root[1], root[2]),
    )
    largest_a += a.radius[0]
    best, found = -1, until
    for at in range(rows.shape[0]):
        if stopped(stop):
            break
        row = rows[at]
        body = PlacedBody(b, poses[row], minus(place_of(poses[row]), origin))
        largest = largest_term(body.pose, body.shift, other[0], other[1], other[2]) + b.radius[0]
        units, error = np.int64(units_a + units_b + margin_units), max(largest_a, largest) * 2.0**-49
        sweep = BodySweep(motion, a, body, units, error, scratch, stop)
        scratch.turns[1] += 1
        _place_standing_nodes(sweep)
        since = _advance(sweep, size, min(found, 1.0), tolerance)
        if since >= found or since == INFINITE:
            continue
        best, found = row, since
        pair = scratch.pair
        named[0], named[1] = pair[2], pair[3]
        pose_at(motion, since, pose)
        own, there = point_of(a.points, pair[0], pair[1]), point_of(b.points, pair[2], pair[3])
        put(witness[0], plus(placed(pose, place_of(pose), own), origin))
        put(witness[1], plus(placed(body.pose, body.shift, there), origin))
    return best, found
