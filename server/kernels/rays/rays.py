"""First sphere of the scan that a ray meets, decided by a formula of the ray and one point alone.

Definition. No tree, order, voxel size or thread can change it. All lengths are exact units of
2^-26 m, from the dataset's origin O. The ray starts at o = rint((origin - O) 2^26), int64, half to
even. Its direction u is the given one, divided by its largest component and then by the root of (x
x + y y) + z z, float64. A scan point b is as in NUMERICS.md N5, r is the radius of its own sphere,
and d = b - o in int64, which is exact in float64 within any permitted reach. Then

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

from ....schemas.archive.voxel import MAX_LEVELS
from ....schemas.kernels import compiling as nb
from ..core.kernel_decorators import njit_no_refcount
from ..core.node_boxes import enter_box, has_box
from ..core.node_overlap import U32
from ..core.placed_avatar import lattice_to_units
from ..core.reach import MISSING, NOT_HELD, state_of
from ..core.scene_arrays import COUNT, COUNTED, FIRST, LANES, ROW_WORDS, node_class, point_class, stopped

U = np.uint64  # see placed_avatar.py

# Siblings that a descent of one tree leaves on the stack.
STACK = MAX_LEVELS * 15 + 16


class RayBatch(NamedTuple):
    """Batch of k rays, or of k query points.

    origin: (k, 3) int64.  direction: (k, 3) float64 unit vectors; (0, 3) for points.
    reach, radius: int64, radius of the scan's largest sphere, 0 for points; exact units.
    """

    origin: NDArray[np.int64]
    direction: NDArray[np.float64]
    reach: int
    radius: int


class ClosestHits(NamedTuple):
    """Best results so far of k rays or points, and their cost.

    value: (k,) float64, t of a ray, exact units, inf: none; unused for points.
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


@njit_no_refcount
def first_meeting(dx, dy, dz, ux, uy, uz, radius):
    """Return t of one ray and one sphere by the definition above, inf when missed.

    dx, dy, dz, radius: int64 units.
    """
    inside = (
        abs(dx) <= radius and abs(dy) <= radius and abs(dz) <= radius
    )  # otherwise squares might not fit 63 bits
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
    ray: (12,) float64: origin relative to the voxel's low corner, direction, and two more axes of
    its frame.  radius: of the largest sphere below, inflated by the rounding of this function. The
    ray is clipped by the node's sphere, then by its slab or its box.
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
    nx, ny, nz = (
        np.float64(words[U(row) + U(4)]),
        np.float64(words[U(row) + U(5)]),
        np.float64(words[U(row) + U(6)]),
    )
    slope = nx * ray[3] + ny * ray[4] + nz * ray[5]
    offset = nx * dx + ny * dy + nz * dz
    wide = words[U(row) + U(7)] * radius
    least, most = words[U(row) + U(8)] - wide, words[U(row) + U(9)] + wide
    begin, end = first * slope - offset, last * slope - offset
    if (begin > most and end > most) or (begin < least and end < least):
        return np.inf
    if begin > most:
        first += (last - first) * ((begin - most) / (begin - end))
    elif begin < least:
        first += (last - first) * ((least - begin) / (end - begin))
    return first if first <= limit else np.inf


@njit_no_refcount
def _test_block(scene, voxel, row, ray, radius, rays, i, best):
    """Test all points of a leaf node against ray i: 32 in float32, those within the band exactly.

    The definition decides within the band.  radius: as in `meet_node`. Distances across the ray
    are of coordinates relative to the point of the ray nearest to the node's centre, at most 3 (R +
    radius) large. Their float32 rounding is below 64 U32 of R + radius + 1.
    """
    words, ints, halves = scene.words, scene.ints, scene.halves
    block = ~ints[row + FIRST]
    block_at = scene.where[voxel, 1] + block * scene.block_words
    lane_at = scene.where[voxel, 2] + block * 3 * LANES
    at_x = U(lane_at)
    at_y, at_z = at_x + U(LANES), at_x + U(2 * LANES)
    deficit = scene.radius_deficit
    mask = np.uint64(deficit.shape[0] - 1)
    dx, dy, dz = words[U(row)] - ray[0], words[U(row) + U(1)] - ray[1], words[U(row) + U(2)] - ray[2]
    along = dx * ray[3] + dy * ray[4] + dz * ray[5]
    qx = np.float32(ray[0] + along * ray[3] - ints[block_at])
    qy = np.float32(ray[1] + along * ray[4] - ints[block_at + 1])
    qz = np.float32(ray[2] + along * ray[5] - ints[block_at + 2])
    ax, ay, az = np.float32(ray[6]), np.float32(ray[7]), np.float32(ray[8])
    bx, by, bz = np.float32(ray[9]), np.float32(ray[10]), np.float32(ray[11])
    span = radius + 64.0 * U32 * (words[U(row) + U(3)] + radius + 1.0)
    far = np.float32(span * span * (1.0 + 64.0 * U32))
    met: bool | np.bool_ = False
    for j in range(LANES):
        x = np.float32(halves[at_x + U(j)]) - qx
        y = np.float32(halves[at_y + U(j)]) - qy
        z = np.float32(halves[at_z + U(j)]) - qz
        a, b = x * ax + y * ay + z * az, x * bx + y * by + z * bz
        met |= a * a + b * b <= far
    if not met:
        return
    ux, uy, uz = rays.direction[i, 0], rays.direction[i, 1], rays.direction[i, 2]
    lx = scene.corners[voxel, 0] + np.int64(ints[block_at])
    ly = scene.corners[voxel, 1] + np.int64(ints[block_at + 1])
    lz = scene.corners[voxel, 2] + np.int64(ints[block_at + 2])
    for j in range(ints[block_at + 3]):
        x = np.float32(halves[at_x + U(j)]) - qx
        y = np.float32(halves[at_y + U(j)]) - qy
        z = np.float32(halves[at_z + U(j)]) - qz
        a, b = x * ax + y * ay + z * az, x * bx + y * by + z * bz
        if not a * a + b * b <= far:
            continue
        sx, sy, sz = (
            lx + np.int64(halves[at_x + U(j)]),
            ly + np.int64(halves[at_y + U(j)]),
            lz + np.int64(halves[at_z + U(j)]),
        )
        t = first_meeting(
            lattice_to_units(sx, scene.units_per_step) - rays.origin[i, 0],
            lattice_to_units(sy, scene.units_per_step) - rays.origin[i, 1],
            lattice_to_units(sz, scene.units_per_step) - rays.origin[i, 2],
            ux, uy, uz, rays.radius - deficit[point_class(ints, block_at, j, mask)],
        )  # fmt: skip
        first = t < best.value[i] or (t == best.value[i] and is_less(sx, sy, sz, best.lattice[i]))
        if first and t <= rays.reach:
            best.value[i] = t
            best.lattice[i, 0], best.lattice[i, 1], best.lattice[i, 2] = sx, sy, sz


@njit_no_refcount
def is_less(x, y, z, other):
    """Return whether a lattice point precedes another (3,), by x, then y, then z."""
    if x != other[0]:
        return x < other[0]
    if y != other[1]:
        return y < other[1]
    return z < other[2]


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
def push_sorted(rows, bounds, begin, depth, row, bound):
    """Push a node onto a stack whose entries [begin, depth] are popped by ascending bound."""
    at = depth
    while at > begin and bounds[at - 1] < bound:
        rows[at], bounds[at] = rows[at - 1], bounds[at - 1]
        at -= 1
    rows[at], bounds[at] = row, bound


@njit_no_refcount
def _follow(scene, voxel, rays, i, ray, near, best, rows, bounds, deficits):
    """Follow ray i through the tree of one resident voxel, front to back; update `best`.

    deficits: `scene.radius_deficit` in float64 [steps].  near: exact units, as in VoxelLists. A
    bound of a node holds for its children.
    """
    words, ints = scene.words, scene.ints
    per_unit = 1.0 / scene.units_per_step
    farthest = 0.0
    for r in range(3):
        corner = scene.corners[voxel, r]
        from_corner = rays.origin[i, r] - lattice_to_units(corner, scene.units_per_step)
        ray[r] = np.float64(from_corner) * per_unit
        farthest = max(farthest, abs(ray[r]), abs(np.float64(corner)))
    # Rounding to units, the voxel's corner and the point; float64 of all coordinates here, with a
    # wide margin.
    error = 2.0 * per_unit + (farthest + scene.voxel_steps) * 2.0**-45
    largest = np.float64(rays.radius) * per_unit + error
    base, mask = scene.where[voxel, 0], np.uint64(deficits.shape[0] - 1)
    radius = largest - deficits[node_class(ints, base, mask)]
    reach = np.float64(rays.reach)
    spent, tests = np.int64(best.counts[1, i]) + 1, np.int64(best.counts[2, i])
    rows[0], depth = base, 0
    bounds[0] = meet_node(words, base, ray, radius, min(best.value[i], reach) * per_unit + error)
    if bounds[0] < np.inf:
        bounds[0], depth = max(bounds[0], near * per_unit + error), 1
    while depth > 0:
        depth -= 1
        row, above = rows[depth], bounds[depth]
        bound = (above - error) * scene.units_per_step
        if bound > best.value[i]:
            continue
        if stopped(scene.stop):
            best.unseen[i] = min(best.unseen[i], max(bound, 0.0))
            continue
        first = ints[row + FIRST]
        if first < 0:
            tests += LANES
            radius = largest - deficits[node_class(ints, row, mask)]
            _test_block(scene, voxel, row, ray, radius, rays, i, best)
            continue
        spent += ints[row + COUNT] & COUNTED
        begin = depth
        limit = min(best.value[i], reach) * per_unit + error
        for child in range(first, first + (ints[row + COUNT] & COUNTED)):
            child_row = base + child * ROW_WORDS
            radius = largest - deficits[node_class(ints, child_row, mask)]
            bound = meet_node(words, child_row, ray, radius, limit)
            if bound < np.inf:
                push_sorted(rows, bounds, begin, depth, child_row, max(bound, above))
                depth += 1
    best.counts[1, i], best.counts[2, i] = spent, tests


@nb.njit(nogil=True, cache=True)
def follow_rays(rays, lists, which, cursor, state, scene, best):
    """Follow the rays numbered in `which` along their lists, each from its cursor on; update `best`.

    lists: VoxelLists of these rays.  cursor, state: as in `collide_poses`.
    """
    ray, per_step = np.empty(12), scene.units_per_step
    rows, bounds = np.empty(STACK, np.int64), np.empty(STACK)
    deficits = scene.radius_deficit.astype(np.float64) / per_step
    for number in range(which.shape[0]):
        i = which[number]
        end = lists.starts[i + 1]
        set_frame(ray, rays.direction[i])
        while cursor[i] < end and not stopped(scene.stop):
            at = cursor[i]
            near, voxel = lists.near[at] * per_step, lists.rows[at]
            if near > best.value[i]:
                cursor[i] = end
                break
            may = state_of(state, voxel)
            if may == NOT_HELD:
                break
            if may == MISSING:
                best.counts[0, i] += np.uint32(1)
                best.unseen[i] = min(best.unseen[i], near)
            else:
                _follow(scene, voxel, rays, i, ray, near, best, rows, bounds, deficits)
            cursor[i] = at + 1
