"""Scan point nearest to a query point, as a k-d tree would find it.

Definition. No tree, order, voxel size or thread can change it. q = rint((point - O) 2^26) in int64,
half to even, O the dataset's origin; b is a scan point as in NUMERICS.md N5. The least integer |q -
b|^2 is within reach when it is at most the square of the reach in units of 2^-26 m. Of several
points at that distance, the least (x, y, z) is returned. The distance is the float64 root of that
square, divided by 2^26.

Everything else here prunes and never decides: node bounds in float64, 32 points at a time in
float32, both inflated.
"""

import math

import numpy as np

from ....schemas.archive.units import UNITS_PER_METRE
from ....schemas.kernels import compiling as nb
from ..core.array_references import with_flag
from ..core.kernel_decorators import njit_no_refcount
from ..core.node_overlap import U32
from ..core.placed_avatar import MAX_REACH_UNITS, lattice_to_units
from ..core.reach import MISSING, NOT_HELD, REACH_STACK, all_resident, list_item, state_of
from ..core.scene_arrays import COUNT, COUNTED, FIRST, LANES, ROW_WORDS, stopped
from .rays import STACK, ClosestHits, is_less

U = np.uint64  # see placed_avatar.py


@njit_no_refcount
def _below_node(words, row, x, y, z, limit):
    """Return a lower bound of the distance [steps] from a point to a node's points.

    x, y, z: float64, relative to the voxel's low corner. Also returns the distance to the node's
    centre. Beyond `limit`, the bound may be as low as that of the sphere alone.
    The node's points lie in its sphere and in its box; or in its sphere and in its slab, and
    therefore in the round disc that contains both. Rounding: less than 2^-24 of the distance to the
    centre, where the root of a small difference magnifies it.
    """
    dx, dy, dz = x - words[U(row)], y - words[U(row) + U(1)], z - words[U(row) + U(2)]
    nx, ny, nz = (
        np.float64(words[U(row) + U(4)]),
        np.float64(words[U(row) + U(5)]),
        np.float64(words[U(row) + U(6)]),
    )
    square = dx * dx + dy * dy + dz * dz
    radius = np.float64(words[U(row) + U(3)])
    length = np.float64(words[U(row) + U(7)])
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
        gap: float = max(along - words[U(row) + U(9)] * inverse, words[U(row) + U(8)] * inverse - along, 0.0)
        gap = gap - (abs(along) + radius) * 2.0**-21
        if gap > 0.0:
            across: float = math.sqrt(max(square - along * along * (1.0 + 2.0**-21), 0.0)) - radius
            across = max(across - slack, 0.0)
            below = max(below, math.sqrt(gap * gap + across * across))
    return max(below - slack, 0.0), middle


@njit_no_refcount
def _test_block(scene, voxel, row, x, y, z, error, at_units, i, best, limit):
    """Test all points of a leaf node against point i: 32 in float32, those in the band in integers.

    limit: the best square so far, or that of the reach [units^2]. Returns it, lowered.
    Rounding in float32: where a scan point is within the limit, coordinates relative to the block's
    corner are at most its root plus four radii, and the rounding of differences is below 16 U32 of
    that.
    """
    words, ints, halves = scene.words, scene.ints, scene.halves
    block = ~ints[row + FIRST]
    block_at = scene.where[voxel, 1] + block * scene.block_words
    lane_at = scene.where[voxel, 2] + block * 3 * LANES
    at_x = U(lane_at)
    at_y, at_z = at_x + U(LANES), at_x + U(2 * LANES)
    qx = np.float32(x - ints[block_at])
    qy = np.float32(y - ints[block_at + 1])
    qz = np.float32(z - ints[block_at + 2])
    span = math.sqrt(np.float64(limit)) / scene.units_per_step + error
    span += 16.0 * U32 * (span + 4.0 * words[U(row) + U(3)] + 1.0)
    far = np.float32(span * span * (1.0 + 64.0 * U32))
    least = np.float32(np.inf)
    met: bool | np.bool_ = False
    for j in range(LANES):
        dx = np.float32(halves[at_x + U(j)]) - qx
        dy = np.float32(halves[at_y + U(j)]) - qy
        dz = np.float32(halves[at_z + U(j)]) - qz
        met |= dx * dx + dy * dy + dz * dz <= far
    if not met:
        return limit
    for j in range(ints[block_at + 3]):
        dx = np.float32(halves[at_x + U(j)]) - qx
        dy = np.float32(halves[at_y + U(j)]) - qy
        dz = np.float32(halves[at_z + U(j)]) - qz
        least = min(least, dx * dx + dy * dy + dz * dz)
    # No point beyond the least by more than twice the rounding can be nearest.
    nearest = math.sqrt(np.float64(least)) * (1.0 + 8.0 * U32)
    nearest += 2.0 * error + 32.0 * U32 * (nearest + 4.0 * words[U(row) + U(3)] + 1.0)
    far = min(far, np.float32(nearest * nearest * (1.0 + 64.0 * U32)))
    lx = scene.corners[voxel, 0] + np.int64(ints[block_at])
    ly = scene.corners[voxel, 1] + np.int64(ints[block_at + 1])
    lz = scene.corners[voxel, 2] + np.int64(ints[block_at + 2])
    for j in range(ints[block_at + 3]):
        dx = np.float32(halves[at_x + U(j)]) - qx
        dy = np.float32(halves[at_y + U(j)]) - qy
        dz = np.float32(halves[at_z + U(j)]) - qz
        if not dx * dx + dy * dy + dz * dz <= far:
            continue
        sx, sy, sz = (
            lx + np.int64(halves[at_x + U(j)]),
            ly + np.int64(halves[at_y + U(j)]),
            lz + np.int64(halves[at_z + U(j)]),
        )
        ux = lattice_to_units(sx, scene.units_per_step) - at_units[i, 0]
        uy = lattice_to_units(sy, scene.units_per_step) - at_units[i, 1]
        uz = lattice_to_units(sz, scene.units_per_step) - at_units[i, 2]
        if abs(ux) > MAX_REACH_UNITS or abs(uy) > MAX_REACH_UNITS or abs(uz) > MAX_REACH_UNITS:
            continue
        square = ux * ux + uy * uy + uz * uz
        if square > limit:
            continue
        if best.square[i] < 0 or square < limit or is_less(sx, sy, sz, best.lattice[i]):
            best.square[i] = limit = square
            best.lattice[i, 0], best.lattice[i, 1], best.lattice[i, 2] = sx, sy, sz
    return limit


@njit_no_refcount
def _search_voxel(scene, voxel, at_units, i, near, best, limit, rows, bounds, keys):
    """Search one resident voxel, nearest nodes first; update `best` and return the lowered limit.

    near: exact units, as in VoxelLists. A bound of a node holds for its children.
    """
    words, ints = scene.words, scene.ints
    per_unit = 1.0 / scene.units_per_step
    cx = scene.corners[voxel, 0]
    cy = scene.corners[voxel, 1]
    cz = scene.corners[voxel, 2]
    x = np.float64(at_units[i, 0] - lattice_to_units(cx, scene.units_per_step)) * per_unit
    y = np.float64(at_units[i, 1] - lattice_to_units(cy, scene.units_per_step)) * per_unit
    z = np.float64(at_units[i, 2] - lattice_to_units(cz, scene.units_per_step)) * per_unit
    farthest = max(abs(x), abs(y), abs(z), np.float64(max(abs(cx), abs(cy), abs(cz))))
    error = 2.0 * per_unit + (farthest + scene.voxel_steps) * 2.0**-45
    base = scene.where[voxel, 0]
    spent, tests = np.int64(best.counts[1, i]) + 1, np.int64(best.counts[2, i])
    rows[0], depth = base, 1
    bounds[0] = max(_below_node(words, base, x, y, z, np.inf)[0], near * per_unit + error)
    nearest = math.sqrt(np.float64(limit))
    while depth > 0:
        depth -= 1
        row, above = rows[depth], bounds[depth]
        bound = (above - error) * scene.units_per_step
        if bound > nearest:
            continue
        if stopped(scene.stop):
            best.unseen[i] = min(best.unseen[i], max(bound, 0.0))
            continue
        first = ints[row + FIRST]
        if first < 0:
            tests += LANES
            limit = _test_block(scene, voxel, row, x, y, z, error, at_units, i, best, limit)
            nearest = math.sqrt(np.float64(limit))
            continue
        spent += ints[row + COUNT] & COUNTED
        begin = depth
        steps = nearest * per_unit + error
        for child in range(first, first + (ints[row + COUNT] & COUNTED)):
            child_row = base + child * ROW_WORDS
            bound, middle = _below_node(words, child_row, x, y, z, steps)
            # The farthest point of this node is no farther than that: a sibling beyond it cannot
            # hold the nearest point.
            steps = min(steps, (middle + words[child_row + 3]) * (1.0 + 2.0**-24) + 2.0 * error)
            bound = max(bound, above)
            if bound <= steps:
                # Many bounds are 0: among these, the one with the nearest centre comes first.
                key = bound + middle / 16.0
                place = depth
                while place > begin and keys[place - 1] < key:
                    rows[place], bounds[place], keys[place] = (
                        rows[place - 1],
                        bounds[place - 1],
                        keys[place - 1],
                    )
                    place -= 1
                rows[place], bounds[place], keys[place] = child_row, bound, key
                depth += 1
    best.counts[1, i], best.counts[2, i] = spent, tests
    return limit


@nb.njit(nogil=True, cache=True)
def search_points(points, lists, which, cursor, state, scene, best):
    """Search for the scan points nearest to the points numbered in `which`, each from its cursor on.

    points: RayBatch whose reach is at most MAX_REACH_UNITS. Other arguments as in `rays.follow_rays`.
    """
    at_units, reach = points.origin, np.int64(points.reach)
    rows, bounds, keys = np.empty(STACK, np.int64), np.empty(STACK), np.empty(STACK)
    for number in range(which.shape[0]):
        i = which[number]
        end = lists.starts[i + 1]
        limit = best.square[i] if best.square[i] >= 0 else reach * reach
        while cursor[i] < end and not stopped(scene.stop):
            at = cursor[i]
            near, voxel = lists.near[at] * scene.units_per_step, lists.rows[at]
            if near > math.sqrt(np.float64(limit)) * (1.0 + 2.0**-52):
                cursor[i] = end
                break
            may = state_of(state, voxel)
            if may == NOT_HELD:
                break
            if may == MISSING:
                best.counts[0, i] += np.uint32(1)
                best.unseen[i] = min(best.unseen[i], near)
            else:
                limit = _search_voxel(scene, voxel, at_units, i, near, best, limit, rows, bounds, keys)
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
    units, best = np.empty((1, 3), np.int64), ClosestHits(
        np.full(1, np.inf), np.full(1, -1, np.int64), np.zeros((1, 3), np.int64), np.full(1, np.inf),
        np.zeros((3, 1), np.uint32),
    )  # fmt: skip
    for r in range(3):
        away = place[r] - scene.origin[r]
        units[0, r] = np.int64(np.rint(away * UNITS_PER_METRE))
        center[r] = away / scene.step
    limit = np.int64(np.rint(reach * UNITS_PER_METRE))
    limit *= limit
    stack, bounds, order = np.empty(STACK, np.int64), np.empty(STACK), np.empty(STACK)
    span = reach / scene.step + 1.0  # a step more exceeds what rounding loses
    count = list_item(
        held.tree, center, center, span, 0.0, stop, np.empty(REACH_STACK, np.int64), lists.rows, lists.near, 0
    )  # fmt: skip
    if not all_resident(scene.where, lists.rows, count):
        return -1, False, 0
    for voxel in lists.rows[:count]:
        limit = _search_voxel(scene, voxel, units, 0, 0.0, best, limit, stack, bounds, order)
    if stopped(stop):
        return -1, False, 0
    for r in range(3):
        found[r] = best.lattice[0, r] * scene.step + scene.origin[r]
    return count, best.square[0] >= 0, np.int64(best.counts[1, 0])
