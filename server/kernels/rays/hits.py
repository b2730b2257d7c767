"""First sphere of the scan that a ray meets, and the scan point nearest to a point.

Definitions. No tree, order, voxel size or thread can change them. All lengths are exact units of
2^-26 m, from the dataset's origin O. A ray or a query point starts at o = rint((origin - O) 2^26),
int64, half to even. A scan point b is as in NUMERICS.md N5, and d = b - o in int64.

Of a query point: the least integer |d|^2 is within reach when it is at most the square of the reach.
Of several points at that distance, the least (x, y, z) is returned. The distance is the float64 root
of that square, divided by 2^26.

Of a ray: its direction u is the given one, divided by its largest component and then by the root of
(x x + y y) + z z, float64. r is the radius of the scan point's own sphere, and d is exact in float64
within any permitted reach. Then

- |d|^2 <= r^2 in int64: the ray starts inside, t = 0;
- else, in float64 in the order written: s = (dx ux + dy uy) + dz uz; the sphere lies behind unless
  s > 0; m = |d x u| = the root of (cx cx + cy cy) + cz cz, cx = dy uz - dz uy, cy = dz ux - dx uz,
  cz = dx uy - dy ux; m > r: missed; else t = max(s - the root of ((r - m) (r + m)), 0).

It is a hit when t <= reach. The first hit is that of least t; among equal ones, that of the least
point (x, y, z). The cross product does not cancel as the textbook's b^2 - 4ac does. Compared with
the ideal (exact o, b, r and the direction as given), m and s are off by less than 2^-49 |d|. No
sphere is therefore judged wrongly unless the ray passes its surface within that, 0.01 units at 100
km. t is off by less than 2^-48 |d| + sqrt(2^-47 r |d|), the second term where the ray grazes.

Everything else here prunes and never decides: node bounds in float64, 32 points at a time in
float32, both inflated.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ....schemas.archive.units import UNITS_PER_METRE
from ....schemas.archive.voxel import MAX_LEVELS
from ....schemas.runtime import compiling as nb
from ..core.array_references import with_flag
from ..core.kernel_decorators import njit_no_refcount
from ..core.node_bounds import U32, enter_box, has_box, write_squares
from ..core.placed_avatar import MAX_REACH_UNITS, lattice_to_units
from ..core.reach import MISSING, NOT_HELD, REACH_STACK, all_resident, list_item, state_of
from ..core.scene_arrays import COUNT, COUNTED, FIRST, LANES, ROW_WORDS, node_class, point_class, stopped

U = np.uint64  # see placed_avatar.py

# Siblings that a descent of one tree leaves on the stack.
STACK = MAX_LEVELS * 15 + 16


class HitBatch(NamedTuple):
    """Batch of k rays, or of k query points.

    origin: (k, 3) int64.  direction: (k, 3) float64 unit vectors; (0, 3) for points.
    reach, radius: int64, radius of the scan's largest sphere, 0 for points; exact units.
    """

    origin: NDArray[np.int64]
    direction: NDArray[np.float64]
    reach: int | np.int64
    radius: int


class ClosestHits(NamedTuple):
    """Best results so far of k rays or points, and their cost.

    value: (k,) float64, t of a ray, distance of a point, exact units; inf: none.
    square: (k,) int64, of points, -1: none; unused for rays.
    lattice: (k, 3) int64 [steps].
    unseen: (k,) float64, exact units: nothing nearer than this was skipped.
    counts: (3, k) uint32, voxels missing, node visits, point tests.
    """

    value: NDArray[np.float64]
    square: NDArray[np.int64]
    lattice: NDArray[np.int64]
    unseen: NDArray[np.float64]
    counts: NDArray[np.uint32]


class HitScratch(NamedTuple):
    """Scratch of one call.

    line: (12,) float64: origin relative to the voxel's low corner; of a ray also the direction, and
    two more axes of its frame.
    rows: (STACK,) int64, nodes still to examine.  bounds, keys: (STACK,) float64, the lower bound of
    each [steps], and its rank among its siblings.
    squares: (LANES,) float32, of a block's points.
    deficits: `SceneArrays.radius_deficit` in float64 [steps].
    """

    line: NDArray[np.float64]
    rows: NDArray[np.int64]
    bounds: NDArray[np.float64]
    keys: NDArray[np.float64]
    squares: NDArray[np.float32]
    deficits: NDArray[np.float64]


@nb.njit(nogil=True, cache=True)
def _make_scratch(scene):
    """Allocate the scratch."""
    return HitScratch(
        np.empty(12), np.empty(STACK, np.int64), np.empty(STACK), np.empty(STACK), np.empty(LANES, np.float32),
        scene.radius_deficit.astype(np.float64) / scene.units_per_step,
    )  # fmt: skip


@njit_no_refcount
def first_meeting(dx, dy, dz, ux, uy, uz, radius):
    """Return t of one ray and one sphere by the definition above, inf when missed.

    dx, dy, dz, radius: int64 units.
    """
    # Otherwise squares might not fit 63 bits.
    inside = abs(dx) <= radius and abs(dy) <= radius and abs(dz) <= radius
    if inside and dx * dx + dy * dy + dz * dz <= radius * radius:
        return 0.0
    x, y, z, r = np.float64(dx), np.float64(dy), np.float64(dz), np.float64(radius)
    along = (x * ux + y * uy) + z * uz
    if not along > 0.0:
        return np.inf
    cx, cy, cz = y * uz - z * uy, z * ux - x * uz, x * uy - y * ux
    miss = math.sqrt((cx * cx + cy * cy) + cz * cz)
    if miss > r:
        return np.inf
    return max(along - math.sqrt((r - miss) * (r + miss)), 0.0)


@njit_no_refcount
def meet_node(words, row, ray, radius, limit):
    """Return a lower bound of t [steps] for the spheres of a node's points, inf if none is met.

    limit: spheres beyond it count as not met.
    ray: `HitScratch.line`.  radius: of the largest sphere below, inflated by the rounding of this
    function. The ray is clipped by the node's sphere, then by its slab or its box.
    """
    dx, dy, dz = words[U(row)] - ray[0], words[U(row) + U(1)] - ray[1], words[U(row) + U(2)] - ray[2]
    a = dx * ray[6] + dy * ray[7] + dz * ray[8]
    b = dx * ray[9] + dy * ray[10] + dz * ray[11]
    both = words[U(row) + U(3)] + radius
    half = both * both - (a * a + b * b)
    if half < 0.0:
        return np.inf
    half = math.sqrt(half)
    along = dx * ray[3] + dy * ray[4] + dz * ray[5]
    first, last = along - half, along + half
    if last < 0.0 or first > limit:
        return np.inf
    first = max(first, 0.0)
    if has_box(words, row):
        return enter_box(words, row, ray, radius, first, min(last, limit))
    w = U(row)
    nx, ny, nz = np.float64(words[w + U(4)]), np.float64(words[w + U(5)]), np.float64(words[w + U(6)])
    slope = nx * ray[3] + ny * ray[4] + nz * ray[5]
    offset = nx * dx + ny * dy + nz * dz
    wide = words[w + U(7)] * radius
    least, most = words[w + U(8)] - wide, words[w + U(9)] + wide
    begin, end = first * slope - offset, last * slope - offset
    if (begin > most and end > most) or (begin < least and end < least):
        return np.inf
    if begin > most:
        first += (last - first) * ((begin - most) / (begin - end))
    elif begin < least:
        first += (last - first) * ((least - begin) / (end - begin))
    return first if first <= limit else np.inf


@njit_no_refcount
def _below_node(words, row, x, y, z, limit):
    """Return a lower bound of the distance [steps] from a point to a node's points.

    x, y, z: float64, relative to the voxel's low corner. Also returns the distance to the node's
    centre. Beyond `limit`, the bound may be as low as that of the sphere alone.
    The node's points lie in its sphere and in its box; or in its sphere and in its slab, and
    therefore in the round disc that contains both. Rounding: less than 2^-24 of the distance to the
    centre, where the root of a small difference magnifies it.
    """
    w = U(row)
    dx, dy, dz = x - words[w], y - words[w + U(1)], z - words[w + U(2)]
    nx, ny, nz = np.float64(words[w + U(4)]), np.float64(words[w + U(5)]), np.float64(words[w + U(6)])
    square = dx * dx + dy * dy + dz * dz
    radius, length = np.float64(words[w + U(3)]), np.float64(words[w + U(7)])
    middle = math.sqrt(square)
    slack = middle * 2.0**-24
    below: float = middle - radius
    if length < 0.0 and below <= limit:
        ex, ey, ez = max(abs(dx) - nx, 0.0), max(abs(dy) - ny, 0.0), max(abs(dz) - nz, 0.0)
        below = max(below, math.sqrt(ex * ex + ey * ey + ez * ez))
    if length > 0.0 and below <= limit:
        inverse = 1.0 / length
        along = (nx * dx + ny * dy + nz * dz) * inverse
        # The length is rounded up; offsets divided by it are too short by at most 2^-23, which the
        # slack covers.
        gap: float = max(along - words[w + U(9)] * inverse, words[w + U(8)] * inverse - along, 0.0)
        gap = gap - (abs(along) + radius) * 2.0**-21
        if gap > 0.0:
            across: float = math.sqrt(max(square - along * along * (1.0 + 2.0**-21), 0.0)) - radius
            across = max(across - slack, 0.0)
            below = max(below, math.sqrt(gap * gap + across * across))
    return max(below - slack, 0.0), middle


@njit_no_refcount
def _squares_across(halves, lane_at, qx, qy, qz, ray, squares):
    """Write the squared distances (LANES,) of a block's points from a ray, and return the least.

    q: a point of the ray, relative to the block's corner. Otherwise as `write_squares`.
    """
    at_x = U(lane_at)
    at_y, at_z = at_x + U(LANES), at_x + U(2 * LANES)
    ax, ay, az = np.float32(ray[6]), np.float32(ray[7]), np.float32(ray[8])
    bx, by, bz = np.float32(ray[9]), np.float32(ray[10]), np.float32(ray[11])
    least = np.int32(0x7F800000)
    for lane in range(LANES):
        j = U(lane)
        x = np.float32(halves[at_x + j]) - qx
        y = np.float32(halves[at_y + j]) - qy
        z = np.float32(halves[at_z + j]) - qz
        a, b = x * ax + y * ay + z * az, x * bx + y * by + z * bz
        square = np.float32(a * a + b * b)
        squares[j] = square
        least = min(least, square.view(np.int32))
    return np.int32(least).view(np.float32)


@njit_no_refcount
def _test_block(scene, voxel, row, batch, i, error, best, scratch):
    """Test all points of a leaf node: 32 in float32, those within the band by the definition.

    Rounding in float32. Across a ray, distances are of coordinates relative to the point of the ray
    nearest to the node's centre, at most 3 (R + radius) large, and off by less than 64 U32 of R +
    radius + 1. Of a scan point within the limit of a query point, coordinates relative to the
    block's corner are at most the limit plus four R, and differences are off by less than 16 U32 of
    that.
    """
    words, ints, halves, line, squares = scene.words, scene.ints, scene.halves, scratch.line, scratch.squares
    block = ~ints[row + FIRST]
    block_at = scene.where[voxel, 1] + block * scene.block_words
    lane_at = scene.where[voxel, 2] + block * 3 * LANES
    per_step, mask = scene.units_per_step, np.uint64(scratch.deficits.shape[0] - 1)
    rays, radius = batch.direction.shape[0] > 0, np.float64(words[U(row) + U(3)])
    low_x, low_y, low_z = ints[block_at], ints[block_at + 1], ints[block_at + 2]
    limit = np.int64(0)
    ux, uy, uz = line[3], line[4], line[5]
    if rays:
        dx, dy, dz = words[U(row)] - line[0], words[U(row) + U(1)] - line[1], words[U(row) + U(2)] - line[2]
        along = dx * ux + dy * uy + dz * uz
        reach = batch.radius / per_step + error - scratch.deficits[node_class(ints, row, mask)]
        span = reach + 64.0 * U32 * (radius + reach + 1.0)
        x, y, z = line[0] + along * ux, line[1] + along * uy, line[2] + along * uz
        qx, qy, qz = np.float32(x - low_x), np.float32(y - low_y), np.float32(z - low_z)
        least = _squares_across(halves, lane_at, qx, qy, qz, line, squares)
        far = np.float32(span * span * (1.0 + 64.0 * U32))
    else:
        limit = best.square[i] if best.square[i] >= 0 else np.int64(batch.reach) * np.int64(batch.reach)
        span = min(best.value[i], np.float64(batch.reach)) / per_step + error
        span += 16.0 * U32 * (span + 4.0 * radius + 1.0)
        qx, qy, qz = np.float32(line[0] - low_x), np.float32(line[1] - low_y), np.float32(line[2] - low_z)
        least = write_squares(halves, lane_at, qx, qy, qz, squares)
        # No point beyond the least by more than twice the rounding can be nearest.
        nearest = math.sqrt(np.float64(least)) * (1.0 + 8.0 * U32)
        nearest += 2.0 * error + 32.0 * U32 * (nearest + 4.0 * radius + 1.0)
        far = np.float32(span * span * (1.0 + 64.0 * U32))
        if least <= far:
            far = min(far, np.float32(nearest * nearest * (1.0 + 64.0 * U32)))
    if not least <= far:
        return
    at_x = U(lane_at)
    at_y, at_z = at_x + U(LANES), at_x + U(2 * LANES)
    lx, ly = scene.corners[voxel, 0] + np.int64(low_x), scene.corners[voxel, 1] + np.int64(low_y)
    lz = scene.corners[voxel, 2] + np.int64(low_z)
    for j in range(ints[block_at + 3]):
        if not squares[U(j)] <= far:
            continue
        sx, sy = lx + np.int64(halves[at_x + U(j)]), ly + np.int64(halves[at_y + U(j)])
        sz = lz + np.int64(halves[at_z + U(j)])
        dx = lattice_to_units(sx, per_step) - batch.origin[i, 0]
        dy = lattice_to_units(sy, per_step) - batch.origin[i, 1]
        dz = lattice_to_units(sz, per_step) - batch.origin[i, 2]
        if rays:
            own = batch.radius - scene.radius_deficit[point_class(ints, block_at, j, mask)]
            value = first_meeting(dx, dy, dz, ux, uy, uz, own)
            if value > batch.reach or value > best.value[i]:
                continue
            nearer = value < best.value[i]
        else:
            if abs(dx) > MAX_REACH_UNITS or abs(dy) > MAX_REACH_UNITS or abs(dz) > MAX_REACH_UNITS:
                continue
            square = dx * dx + dy * dy + dz * dz
            if square > limit:
                continue
            nearer = square < limit or best.square[i] < 0
            best.square[i] = limit = square
            value = math.sqrt(np.float64(square))
        lattice = best.lattice
        if nearer or (sx, sy, sz) < (lattice[i, 0], lattice[i, 1], lattice[i, 2]):
            best.value[i] = value
            lattice[i, 0], lattice[i, 1], lattice[i, 2] = sx, sy, sz


@njit_no_refcount
def set_frame(ray, direction):
    """Fill ray[3:12] with the direction and two perpendicular unit vectors.

    They are off by a few roundings of float64.
    """
    ux, uy, uz = direction[0], direction[1], direction[2]
    # Perpendicular to the axis the direction is least aligned with: the cross product is then far
    # from zero.
    if abs(ux) <= abs(uy) and abs(ux) <= abs(uz):
        ax, ay, az = 0.0, uz, -uy
    elif abs(uy) <= abs(uz):
        ax, ay, az = -uz, 0.0, ux
    else:
        ax, ay, az = uy, -ux, 0.0
    length = math.sqrt(ax * ax + ay * ay + az * az)
    ax, ay, az = ax / length, ay / length, az / length
    ray[3], ray[4], ray[5], ray[6], ray[7], ray[8] = ux, uy, uz, ax, ay, az
    ray[9], ray[10], ray[11] = uy * az - uz * ay, uz * ax - ux * az, ux * ay - uy * ax


@njit_no_refcount
def _search_voxel(scene, voxel, batch, i, near, best, scratch):
    """Search one resident voxel for ray or point i, nearest nodes first; update `best`.

    near: exact units, as in VoxelLists. A bound of a node holds for its children.
    """
    words, ints, line, deficits = scene.words, scene.ints, scratch.line, scratch.deficits
    rows, bounds, keys = scratch.rows, scratch.bounds, scratch.keys
    per_unit, rays = 1.0 / scene.units_per_step, batch.direction.shape[0] > 0
    farthest = 0.0
    for r in range(3):
        corner = scene.corners[voxel, r]
        from_corner = batch.origin[i, r] - lattice_to_units(corner, scene.units_per_step)
        line[r] = np.float64(from_corner) * per_unit
        farthest = max(farthest, abs(line[r]), abs(np.float64(corner)))
    x, y, z = line[0], line[1], line[2]
    # Rounding to units, the voxel's corner and the point; float64 of all coordinates here, with a
    # wide margin.
    error = 2.0 * per_unit + (farthest + scene.voxel_steps) * 2.0**-45
    largest, reach = np.float64(batch.radius) * per_unit + error, np.float64(batch.reach)
    base, mask = scene.where[voxel, 0], np.uint64(deficits.shape[0] - 1)
    spent, tests, depth = np.int64(best.counts[1, i]), np.int64(best.counts[2, i]), 0
    first, count, above = np.int64(0), np.int64(1), near * per_unit + error  # the root
    while count > 0:
        spent += count
        begin, limit = depth, min(best.value[i], reach) * per_unit + error
        for child in range(first, first + count):
            row = base + child * ROW_WORDS
            if rays:
                bound = max(
                    meet_node(words, row, line, largest - deficits[node_class(ints, row, mask)], limit), above
                )
                key = bound
            else:
                bound, middle = _below_node(words, row, x, y, z, limit)
                # The farthest point of this node is no farther than that: a sibling beyond it cannot
                # hold the nearest point.
                limit = min(limit, (middle + words[row + 3]) * (1.0 + 2.0**-24) + 2.0 * error)
                bound = max(bound, above)
                # Many bounds are 0: among these, the one with the nearest centre comes first.
                key = bound + middle / 16.0
            if bound <= limit:
                place = depth
                while place > begin and keys[place - 1] < key:
                    above_it = place - 1
                    rows[place], bounds[place], keys[place] = rows[above_it], bounds[above_it], keys[above_it]
                    place = above_it
                rows[place], bounds[place], keys[place] = row, bound, key
                depth += 1
        count = np.int64(0)
        while depth > 0 and count == 0:
            depth -= 1
            row, above = rows[depth], bounds[depth]
            bound = (above - error) * scene.units_per_step
            if bound > best.value[i]:
                continue
            if stopped(scene.stop):
                best.unseen[i] = min(best.unseen[i], max(bound, 0.0))
                continue
            first = np.int64(ints[row + FIRST])
            if first < 0:
                tests += LANES
                _test_block(scene, voxel, row, batch, i, error, best, scratch)
            else:
                count = np.int64(ints[row + COUNT] & COUNTED)
    best.counts[1, i], best.counts[2, i] = spent, tests


@nb.njit(nogil=True, cache=True)
def search_hits(batch, lists, which, cursor, state, scene, best):
    """Search the voxels of rays or points along their lists, each from its cursor on; update `best`.

    batch: HitBatch, for points with a reach of at most MAX_REACH_UNITS.  lists: their VoxelLists.
    which: the numbers of those to search.  cursor, state: as in `collide_poses`. Once the scene's
    stop flag is set, the others are not searched.
    """
    scratch, reach = _make_scratch(scene), np.float64(batch.reach)
    for number in range(which.shape[0]):
        if stopped(scene.stop):
            return
        i = which[number]
        end = lists.starts[i + 1]
        if batch.direction.shape[0] > 0:
            set_frame(scratch.line, batch.direction[i])
        while cursor[i] < end and not stopped(scene.stop):
            at = cursor[i]
            near, voxel = lists.near[at] * scene.units_per_step, lists.rows[at]
            if near > min(best.value[i], reach) * (1.0 + 2.0**-52):
                cursor[i] = end
                break
            may = state_of(state, voxel)
            if may == NOT_HELD:
                break
            if may == MISSING:
                best.counts[0, i] += np.uint32(1)
                best.unseen[i] = min(best.unseen[i], near)
            else:
                _search_voxel(scene, voxel, batch, i, near, best, scratch)
            cursor[i] = at + 1


@nb.njit(nogil=True, cache=True)
def nearest_in_memory(held, place, reach, stop, found):
    """Find the scan point nearest to a place, where all voxels in reach are resident.

    held: reference to the scene's arrays.  place: (x, y, z), world [m].  reach: at most 16 m.
    stop: (1,) int64, the request's stop flag.  found: (3,) float64, set to the point's centre, world
    [m]. Writes held.one, the voxels in reach.
    Returns the number of rows, -1: not answered; whether a point is in reach; and node visits.
    """
    scene, lists, center = with_flag(held.scene, stop), held.one.reach.lists, np.empty(3)
    units, scratch, best = np.empty((1, 3), np.int64), _make_scratch(scene), ClosestHits(
        np.full(1, np.inf), np.full(1, -1, np.int64), np.zeros((1, 3), np.int64), np.full(1, np.inf),
        np.zeros((3, 1), np.uint32),
    )  # fmt: skip
    for r in range(3):
        away = place[r] - scene.origin[r]
        units[0, r] = np.int64(np.rint(away * UNITS_PER_METRE))
        center[r] = away / scene.step
    batch = HitBatch(units, np.empty((0, 3)), int(np.rint(reach * UNITS_PER_METRE)), 0)
    span = reach / scene.step + 1.0  # a step more exceeds what rounding loses
    count = list_item(
        held.tree, center, center, span, 0.0, stop, np.empty(REACH_STACK, np.int64), lists.rows, lists.near, 0
    )  # fmt: skip
    if not all_resident(scene.where, lists.rows, count):
        return -1, False, 0
    for voxel in lists.rows[:count]:
        _search_voxel(scene, voxel, batch, 0, 0.0, best, scratch)
    if stopped(stop):
        return -1, False, 0
    for r in range(3):
        found[r] = best.lattice[0, r] * scene.step + scene.origin[r]
    return count, best.square[0] >= 0, np.int64(best.counts[1, 0])
