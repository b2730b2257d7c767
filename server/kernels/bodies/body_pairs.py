"""Contact between placed avatars: the pairs that could meet, and whether two of them touch.

The definition is that of NUMERICS.md N5 for both. Points a of A and b of B, each placed by its own
pose and rounded once to exact units of 2^-26 m, are in contact when |a - b|^2 <= (r_a + r_b +
margin)^2 in int64, each of the three rounded once. The definition is symmetric in A and B.
`touch_pairs` therefore returns the same for (B, A) as for (A, B), although it descends in another
order.

[Fig12] transforms A's spheres into B's frame by M_{B<-A}. Here both are placed relative to the
dataset's origin, in float64: the definition rounds each placed point once, and a product of two
poses would add a rounding that no bound needs. Points are compared in float32 relative to the
centre of one of the two leaf nodes, with a certified band in which integers decide.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ....schemas.archive.units import UNITS_PER_METRE
from ....schemas.runtime import compiling as nb
from ..core.kernel_decorators import njit_no_refcount
from ..core.node_bounds import STACK, U32
from ..core.placed_avatar import MAX_REACH_UNITS, Avatar, largest_term, place, to_units
from ..core.scene_arrays import LANES, stopped
from ..motion.screw_motion import make_motion
from ..motion.vector_tuples import Vector, dot, minus, place_of, placed, point_of, vector

CLEAR, CONTACT, UNKNOWN = 0, 1, 2  # schemas/wire/answers.py Verdict
# A rotation may shear by RIGID_TOLERANCE, 1e-9, and stretch a radius by as much.
STRETCH = 1.0 + 1e-8


@nb.njit(nogil=True, cache=True)
def sweep_and_prune(order, low, high, groups, masks, stop, pairs):
    """Find the pairs of objects whose boxes meet and whose groups and masks permit them.

    Sweeps along the first axis, after Cohen, Lin, Manocha and Ponamgi, I-COLLIDE (1995), with one
    axis sorted anew for each request.
    order: (n,) int64, objects by ascending low[:, 0].  low, high: (n, 3) float64.  groups, masks:
    (n,) uint32: a pair is permitted when the group of each has a bit of the other's mask.  stop:
    (1,) int64, the request's stop flag; once it is set, the result is meaningless.
    Writes pairs (capacity, 2) int32, lesser object first; pairs beyond the capacity are not
    written. Returns the number of pairs, and the number of pairs that were not permitted.
    """
    found, filtered = 0, 0
    for at in range(order.shape[0]):
        if stopped(stop):
            break
        i = order[at]
        for after in range(at + 1, order.shape[0]):
            j = order[after]
            if low[j, 0] > high[i, 0]:
                break
            if low[j, 1] > high[i, 1] or low[i, 1] > high[j, 1]:
                continue
            if low[j, 2] > high[i, 2] or low[i, 2] > high[j, 2]:
                continue
            if not (groups[i] & masks[j]) or not (groups[j] & masks[i]):
                filtered += 1
                continue
            if found < pairs.shape[0]:
                pairs[found, 0], pairs[found, 1] = min(i, j), max(i, j)
            found += 1
    return found, filtered


@nb.njit(nogil=True, cache=True)
def bound_objects(avatar, poses, which, units, origin, margin_units, low, high):
    """Write the boxes low, high (n, 3) float64 of the objects `which` of one avatar, not empty.

    The boxes are relative to the dataset's origin [m].  units: (n,) of all objects, see `check_poses`.
    Half the margin is added on either side. The boxes are rounded outward by much
    more than the rounding of placing.
    """
    root = vector(avatar.center[0])
    for i in which:
        shift, extent = minus(place_of(poses[i]), origin), avatar.radius[0] * STRETCH
        slack = 2.0 / UNITS_PER_METRE
        slack += (largest_term(poses[i], shift, root[0], root[1], root[2]) + extent) * 2.0**-49
        extent += np.float64(units[i] + margin_units / 2) / UNITS_PER_METRE + slack
        center = placed(poses[i], shift, root)
        for r in range(3):
            low[i, r], high[i, r] = center[r] - extent, center[r] + extent


@nb.njit(nogil=True, cache=True)
def bound_body(box, pose, origin, more, bounds):
    """Write the bounds (2, 3) of a body's placed box, grown by `more` on all sides.

    box: (2, 3), avatar frame.  bounds: relative to the origin [m].
    """
    for r in range(3):
        middle, half, size = pose[r, 3] - origin[r], 0.0, abs(pose[r, 3]) + abs(origin[r])
        for c in range(3):
            middle += pose[r, c] * (0.5 * (box[0, c] + box[1, c]))
            half += abs(pose[r, c]) * (0.5 * (box[1, c] - box[0, c]))
            size += abs(pose[r, c]) * (abs(box[0, c]) + abs(box[1, c]))
        half += more + 2.0 / UNITS_PER_METRE + size * 2.0**-48
        bounds[0, r], bounds[1, r] = middle - half, middle + half


@nb.njit(nogil=True, cache=True)
def find_near_bodies(box, first, last, origin, more, bounds, kinds, wanted, skip, rows):
    """Write the bodies whose bounds meet those of a motion, ascending, to rows (n,) int64.

    Returns how many.
    box: (2, 3) of the moving avatar.  first, last: (4, 4), world.  origin: (3,), that of the bounds.
    more: its radius plus the margin [m].  bounds: (n, 2, 3), see `bound_body`.  kinds: (n,) uint8,
    one bit each.  wanted: the bits of the kinds to find.  skip: a row to omit.
    """
    begin, end = np.empty((2, 3)), np.empty((2, 3))
    stray = make_motion(first, last, box, origin).bend / 8.0
    bound_body(box, first, origin, more + stray, begin)
    bound_body(box, last, origin, more + stray, end)
    count = 0
    for i in range(bounds.shape[0]):
        if i == skip or not kinds[i] & wanted:
            continue
        apart = False
        for r in range(3):
            apart |= min(begin[0, r], end[0, r]) > bounds[i, 1, r]
            apart |= max(begin[1, r], end[1, r]) < bounds[i, 0, r]
        if not apart:
            rows[count] = i
            count += 1
    return count


class PlacedBody(NamedTuple):
    """Avatar under a pose (4, 4). shift: t - O [m]."""

    avatar: Avatar
    pose: NDArray[np.float64]
    shift: Vector


@njit_no_refcount
def _place_lanes(body, block, center, lanes):
    """Write the points of a leaf node, float32, relative to `center`, to lanes (3, LANES)."""
    points, m, shift = body.avatar.points, body.pose, body.shift
    for r in range(3):
        for j in range(LANES):
            world = place(m, shift, r, points[block, 0, j], points[block, 1, j], points[block, 2, j])
            lanes[r, j] = np.float32(world - center[r])


@njit_no_refcount
def _points_touch(a, block_a, lane_a, b, block_b, lane_b, units):
    """Return whether one pair of points touches, by the definition."""
    square = np.int64(0)
    one = placed(a.pose, a.shift, point_of(a.avatar.points, block_a, lane_a))
    other = placed(b.pose, b.shift, point_of(b.avatar.points, block_b, lane_b))
    for r in range(3):
        difference = to_units(one[r]) - to_units(other[r])
        if abs(difference) > MAX_REACH_UNITS:
            return False
        square += difference * difference
    return square <= units * units


@njit_no_refcount
def _leaves_touch(a, node_a, b, node_b, radius_b, center, units, error, lanes, counters):
    """Return whether two leaf nodes hold a pair in contact.

    center: placed centre of the node of b.  radius_b: of that node, as placed [m].  lanes:
    (2, 3, LANES), scratch.
    Coordinates are relative to `center`. For points in contact, and for all of b's points, they are
    at most radius_b + reach in size. Their rounding and that of their differences is below 4 U32 of
    it; that of the square's root is below 16 U32.
    """
    block_a, block_b = ~a.avatar.first[node_a], ~b.avatar.first[node_b]
    one, other = lanes[0], lanes[1]
    _place_lanes(a, block_a, center, one)
    _place_lanes(b, block_b, center, other)
    reach = np.float64(units) / UNITS_PER_METRE
    band = error + 16.0 * U32 * (radius_b + reach + error)
    far = np.float32((reach + band) * (reach + band) * (1.0 + 16.0 * U32))
    below = reach - band
    near = np.float32(below * below * (1.0 - 16.0 * U32)) if below > 0.0 else np.float32(-1.0)
    span = radius_b + reach + band
    around = np.float32(span * span * (1.0 + 16.0 * U32))
    for i in range(a.avatar.count[node_a]):
        x, y, z = one[0, i], one[1, i], one[2, i]
        if x * x + y * y + z * z > around:
            continue
        counters[1] += LANES
        touched = False
        for j in range(LANES):
            dx, dy, dz = other[0, j] - x, other[1, j] - y, other[2, j] - z
            touched |= dx * dx + dy * dy + dz * dz <= far
        if not touched:
            continue
        for j in range(b.avatar.count[node_b]):
            dx, dy, dz = other[0, j] - x, other[1, j] - y, other[2, j] - z
            square = dx * dx + dy * dy + dz * dz
            if square <= near:
                return True
            if square <= far and _points_touch(a, block_a, i, b, block_b, j, units):
                return True
    return False


@njit_no_refcount
def _touch_bodies(one, other, units, stop, nodes, lanes, counters):
    """Return CONTACT or CLEAR for two avatars, neither empty; UNKNOWN if the stop flag ended the search.

    The descent follows [Fig12] figures 5 and 6, corrected as in collide_poses.py: the larger inner
    node is opened, a leaf never is.
    nodes: (STACK, 2) int64, scratch: pairs still to examine.
    """
    a, b = one.avatar, other.avatar
    # Rounding of two points to units, and of all sums that place a point or a centre.
    error = 2.0 / UNITS_PER_METRE + max(_largest(one), _largest(other)) * 2.0**-47
    reach = np.float64(units) / UNITS_PER_METRE + error
    nodes[0, 0], nodes[0, 1] = 0, 0
    counters[0] += 1
    depth = 1
    while depth > 0:
        depth -= 1
        i, j = nodes[depth, 0], nodes[depth, 1]
        radius_a, radius_b = a.radius[i] * STRETCH, b.radius[j] * STRETCH
        center = placed(other.pose, other.shift, b.center[j])
        gap = minus(placed(one.pose, one.shift, a.center[i]), center)
        both = (radius_a + radius_b + reach) * (1.0 + 1e-12)
        if dot(gap, gap) > both * both:
            continue
        if stopped(stop):
            return UNKNOWN
        first_a, first_b = a.first[i], b.first[j]
        if first_a < 0 and first_b < 0:
            if _leaves_touch(one, i, other, j, radius_b, center, units, error, lanes, counters):
                return CONTACT
        elif first_b < 0 or (first_a >= 0 and radius_a > radius_b):
            counters[0] += a.count[i]
            for child in range(first_a, first_a + a.count[i]):
                nodes[depth, 0], nodes[depth, 1] = child, j
                depth += 1
        else:
            counters[0] += b.count[j]
            for child in range(first_b, first_b + b.count[j]):
                nodes[depth, 0], nodes[depth, 1] = i, child
                depth += 1
    return CLEAR


@njit_no_refcount
def _largest(body):
    """Return a bound of the terms of any placed coordinate [m]."""
    root = body.avatar.center[0]
    term = largest_term(body.pose, body.shift, root[0], root[1], root[2])
    return term + body.avatar.radius[0] * STRETCH


@nb.njit(nogil=True, cache=True)
def touch_pairs(a, b, poses, units, pairs, margin_units, origin, stop, verdict, counters):
    """Decide whether objects pairs[:, 0] of avatar a touch objects pairs[:, 1] of avatar b.

    Neither avatar is empty.
    poses: (n, 4, 4), checked, of all objects.  units: (n,), see `check_poses`, without the
    margin.  pairs: (p, 2) int64.  origin: (3,) of the dataset [m].  stop: (1,) int64, the request's
    stop flag; once it is set, pairs are UNKNOWN.
    Writes verdict (p,) uint8; adds to counters (2,) int64: node visits, pairs of points tested.
    """
    nodes, lanes = np.empty((STACK, 2), np.int64), np.empty((2, 3, LANES), np.float32)
    own = np.zeros(2, np.int64)
    for number in range(pairs.shape[0]):
        if stopped(stop):
            # The root nodes of the remaining pairs alone would take tens of milliseconds: 0.5 µs a
            # pair.
            verdict[number:] = UNKNOWN
            break
        i, j = pairs[number, 0], pairs[number, 1]
        own[0] = 0
        own[1] = 0
        one = PlacedBody(a, poses[i], minus(place_of(poses[i]), origin))
        other = PlacedBody(b, poses[j], minus(place_of(poses[j]), origin))
        reach = units[i] + units[j] + margin_units
        verdict[number] = _touch_bodies(one, other, reach, stop, nodes, lanes, own)
        counters[0] += own[0]
        counters[1] += own[1]
