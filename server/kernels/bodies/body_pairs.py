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

import numpy as np

from ....schemas.archive.units import UNITS_PER_METRE
from ....schemas.runtime import compiling as nb
from ..core.node_overlap import STACK, U32
from ..core.placed_avatar import MAX_REACH_UNITS, largest_term, place, to_units
from ..core.scene_arrays import LANES, stopped
from ..motion.screw_motion import make_motion

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
    shift = np.empty(3)
    for at in range(which.shape[0]):
        i = which[at]
        m = poses[i]
        for r in range(3):
            shift[r] = m[r, 3] - origin[r]
        x, y, z = avatar.center[0, 0], avatar.center[0, 1], avatar.center[0, 2]
        extent = avatar.radius[0] * STRETCH
        slack = 2.0 / UNITS_PER_METRE + (largest_term(m, shift, x, y, z) + extent) * 2.0**-49
        extent += np.float64(units[i] + margin_units / 2) / UNITS_PER_METRE + slack
        for r in range(3):
            center = place(m, shift, r, x, y, z)
            low[i, r], high[i, r] = center - extent, center + extent


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


@nb.njit(nogil=True, cache=True)
def _place_lanes(avatar, m, shift, block, center, lanes):
    """Write the points of a leaf node, float32, relative to `center` (3,), to lanes (3, LANES)."""
    points = avatar.points
    for r in range(3):
        for j in range(LANES):
            world = place(m, shift, r, points[block, 0, j], points[block, 1, j], points[block, 2, j])
            lanes[r, j] = np.float32(world - center[r])


@nb.njit(nogil=True, cache=True)
def _points_touch(a, ma, shift_a, block_a, lane_a, b, mb, shift_b, block_b, lane_b, units):
    """Return whether one pair of points touches, by the definition."""
    square = np.int64(0)
    p, q = a.points, b.points
    for r in range(3):
        one = place(ma, shift_a, r, p[block_a, 0, lane_a], p[block_a, 1, lane_a], p[block_a, 2, lane_a])
        other = place(mb, shift_b, r, q[block_b, 0, lane_b], q[block_b, 1, lane_b], q[block_b, 2, lane_b])
        difference = to_units(one) - to_units(other)
        if abs(difference) > MAX_REACH_UNITS:
            return False
        square += difference * difference
    return square <= units * units


@nb.njit(nogil=True, cache=True)
def _leaves_touch(
    a, ma, shift_a, node_a, b, mb, shift_b, node_b, radius_b, center, units, error, lanes, counters
):
    """Return whether two leaf nodes hold a pair in contact.

    center: (3,), placed centre of the node of b.  radius_b: of that node, as placed [m].  lanes:
    (2, 3, LANES), scratch.
    Coordinates are relative to `center`. For points in contact, and for all of b's points, they are
    at most radius_b + reach in size. Their rounding and that of their differences is below 4 U32 of
    it; that of the square's root is below 16 U32.
    """
    block_a, block_b = ~a.first[node_a], ~b.first[node_b]
    one, other = lanes[0], lanes[1]
    _place_lanes(a, ma, shift_a, block_a, center, one)
    _place_lanes(b, mb, shift_b, block_b, center, other)
    reach = np.float64(units) / UNITS_PER_METRE
    band = error + 16.0 * U32 * (radius_b + reach + error)
    far = np.float32((reach + band) * (reach + band) * (1.0 + 16.0 * U32))
    below = reach - band
    near = np.float32(below * below * (1.0 - 16.0 * U32)) if below > 0.0 else np.float32(-1.0)
    span = radius_b + reach + band
    around = np.float32(span * span * (1.0 + 16.0 * U32))
    for i in range(a.count[node_a]):
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
        for j in range(b.count[node_b]):
            dx, dy, dz = other[0, j] - x, other[1, j] - y, other[2, j] - z
            square = dx * dx + dy * dy + dz * dz
            if square <= near:
                return True
            if square <= far and _points_touch(a, ma, shift_a, block_a, i, b, mb, shift_b, block_b, j, units):
                return True
    return False


@nb.njit(nogil=True, cache=True)
def touch_bodies(a, ma, b, mb, units, origin, stop, nodes, at, lanes, counters):
    """Return CONTACT or CLEAR for two avatars, neither empty; UNKNOWN if the stop flag ended the search.

    The descent follows [Fig12] figures 5 and 6, corrected as in collide_poses.py: the larger inner
    node is opened, a leaf never is.
    nodes: (STACK, 2) int64, at: (STACK, 6) float64, scratch: pairs still to examine, and their
    placed centres.
    """
    shift_a, shift_b = np.empty(3), np.empty(3)
    for r in range(3):
        shift_a[r], shift_b[r] = ma[r, 3] - origin[r], mb[r, 3] - origin[r]
    p, q = a.center, b.center
    largest = largest_term(ma, shift_a, p[0, 0], p[0, 1], p[0, 2]) + a.radius[0] * STRETCH
    largest = max(largest, largest_term(mb, shift_b, q[0, 0], q[0, 1], q[0, 2]) + b.radius[0] * STRETCH)
    # Rounding of two points to units, and of all sums that place a point or a centre.
    error = 2.0 / UNITS_PER_METRE + largest * 2.0**-47
    reach = np.float64(units) / UNITS_PER_METRE + error
    for r in range(3):
        at[0, r] = place(ma, shift_a, r, p[0, 0], p[0, 1], p[0, 2])
        at[0, 3 + r] = place(mb, shift_b, r, q[0, 0], q[0, 1], q[0, 2])
    nodes[0, 0], nodes[0, 1] = 0, 0
    here = np.empty(6)
    counters[0] += 1
    depth = 1
    while depth > 0:
        depth -= 1
        i, j = nodes[depth, 0], nodes[depth, 1]
        for r in range(6):
            here[r] = at[depth, r]
        radius_a, radius_b = a.radius[i] * STRETCH, b.radius[j] * STRETCH
        dx, dy, dz = here[0] - here[3], here[1] - here[4], here[2] - here[5]
        both = (radius_a + radius_b + reach) * (1.0 + 1e-12)
        if dx * dx + dy * dy + dz * dz > both * both:
            continue
        if stopped(stop):
            return UNKNOWN
        first_a, first_b = a.first[i], b.first[j]
        if first_a < 0 and first_b < 0:
            if _leaves_touch(
                a, ma, shift_a, i, b, mb, shift_b, j, radius_b, here[3:], units, error, lanes, counters
            ):  # fmt: skip
                return CONTACT
        elif first_b < 0 or (first_a >= 0 and radius_a > radius_b):
            counters[0] += a.count[i]
            for child in range(first_a, first_a + a.count[i]):
                nodes[depth, 0], nodes[depth, 1] = child, j
                for r in range(3):
                    at[depth, r] = place(ma, shift_a, r, p[child, 0], p[child, 1], p[child, 2])
                    at[depth, 3 + r] = here[3 + r]
                depth += 1
        else:
            counters[0] += b.count[j]
            for child in range(first_b, first_b + b.count[j]):
                nodes[depth, 0], nodes[depth, 1] = i, child
                for r in range(3):
                    at[depth, r] = here[r]
                    at[depth, 3 + r] = place(mb, shift_b, r, q[child, 0], q[child, 1], q[child, 2])
                depth += 1
    return CLEAR


@nb.njit(nogil=True, cache=True)
def touch_pairs(a, b, poses, units, pairs, margin_units, origin, stop, verdict, counters):
    """Decide whether objects pairs[:, 0] of avatar a touch objects pairs[:, 1] of avatar b.

    Neither avatar is empty.
    poses: (n, 4, 4), checked, of all objects.  units: (n,), see `check_poses`, without the
    margin.  pairs: (p, 2) int64.  origin: (3,) of the dataset [m].  stop: (1,) int64, the request's
    stop flag; once it is set, pairs are UNKNOWN.
    Writes verdict (p,) uint8; adds to counters (2,) int64: node visits, pairs of points tested.
    """
    nodes, at = np.empty((STACK, 2), np.int64), np.empty((STACK, 6))
    lanes = np.empty((2, 3, LANES), np.float32)
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
        reach = units[i] + units[j] + margin_units
        verdict[number] = touch_bodies(a, poses[i], b, poses[j], reach, origin, stop, nodes, at, lanes, own)
        counters[0] += own[0]
        counters[1] += own[1]
