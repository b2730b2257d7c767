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

from ....schemas.kernels import compiling as nb
from ..core.kernel_decorators import njit_no_refcount
from ..core.node_overlap import U32
from ..core.placed_avatar import MAX_REACH_UNITS, lattice_to_units
from ..core.scene_arrays import COUNT, COUNTED, FIRST, LANES, ROW_WORDS, point_class, stopped
from .rays import STACK, is_less, push_sorted

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
    lx = scene.coordinates[voxel, 0] * scene.voxel_steps + np.int64(ints[block_at])
    ly = scene.coordinates[voxel, 1] * scene.voxel_steps + np.int64(ints[block_at + 1])
    lz = scene.coordinates[voxel, 2] * scene.voxel_steps + np.int64(ints[block_at + 2])
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
def search_voxel(scene, voxel, at_units, i, near, tolerance, share, best, limit, rows, bounds, keys):
    """Search one resident voxel, nearest nodes first; update `best` and return the lowered limit.

    near: exact units, as in VoxelLists. A bound of a node holds for its children.
    """
    words, ints = scene.words, scene.ints
    per_unit = 1.0 / scene.units_per_step
    farthest, x, y, z = 0.0, 0.0, 0.0, 0.0
    for r in range(3):
        corner = scene.coordinates[voxel, r] * scene.voxel_steps
        away = np.float64(at_units[i, r] - lattice_to_units(corner, scene.units_per_step)) * per_unit
        farthest = max(farthest, abs(away), abs(np.float64(corner)))
        if r == 0:
            x = away
        elif r == 1:
            y = away
        else:
            z = away
    error = 2.0 * per_unit + (farthest + scene.voxel_steps) * 2.0**-45
    base = scene.where[voxel, 0]
    spent, tests = np.int64(best.counts[1, i]) + 1, np.int64(best.counts[2, i])
    rows[0], depth = base, 1
    bounds[0] = max(_below_node(words, base, x, y, z, np.inf)[0], near * per_unit + error)
    nearest = math.sqrt(np.float64(limit))
    allowed = max(tolerance, share * nearest) if best.square[i] >= 0 else 0.0
    while depth > 0:
        depth -= 1
        row, above = rows[depth], bounds[depth]
        bound = (above - error) * scene.units_per_step
        if bound > nearest - allowed or stopped(scene.stop):
            if bound <= nearest:
                best.unseen[i] = min(best.unseen[i], max(bound, 0.0))
            continue
        first = ints[row + FIRST]
        if first < 0:
            tests += LANES
            limit = _test_block(scene, voxel, row, x, y, z, error, at_units, i, best, limit)
            nearest = math.sqrt(np.float64(limit))
            allowed = max(tolerance, share * nearest) if best.square[i] >= 0 else 0.0
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
def search_points(at_units, reach, lists, cursor, held, scene, tolerance, share, best):
    """Search for the scan points nearest to k query points, along their lists.

    Each search runs up to the first voxel that is not held.
    at_units: (k, 3) int64.  reach: exact units, at most MAX_REACH_UNITS.  share: of the distance of
    the point found, allowed beside the tolerance. Other arguments as in `rays.follow_rays`.
    """
    rows, bounds, keys = np.empty(STACK, np.int64), np.empty(STACK), np.empty(STACK)
    for i in range(cursor.shape[0]):
        end = lists.starts[i + 1]
        limit = best.square[i] if best.square[i] >= 0 else np.int64(reach) * np.int64(reach)
        while cursor[i] < end:
            at = cursor[i]
            near, voxel = lists.near[at], lists.rows[at]
            nearest = math.sqrt(np.float64(limit)) * (1.0 + 2.0**-52)
            far = near > nearest - (max(tolerance, share * nearest) if best.square[i] >= 0 else 0.0)
            if far or stopped(scene.stop):
                if near <= nearest:
                    best.unseen[i] = min(best.unseen[i], near)
                cursor[i] = end
                break
            if not held[voxel]:
                break
            if scene.where[voxel, 0] < 0:
                best.counts[0, i] += np.uint32(1)
                best.unseen[i] = min(best.unseen[i], near)
            else:
                limit = search_voxel(
                    scene, voxel, at_units, i, near, tolerance, share, best, limit, rows, bounds, keys
                )  # fmt: skip
            cursor[i] = at + 1


@njit_no_refcount
def _bound(scene, voxel, at_units, i, least, below, reach, rows, bounds):
    """Return a lower bound of the distance of point i from one resident voxel of a level of detail.

    Exact units; no more than `below`, which is returned if nothing within reach is nearer. In a
    leaf node, nothing is nearer than the node, which encloses the scene's points themselves, nor
    than the cover of one of its representatives.
    least: cover radius of deficit 0 [exact units].
    """
    words, ints, halves = scene.words, scene.ints, scene.halves
    per_unit = 1.0 / scene.units_per_step
    mask = np.uint64(scene.radius_deficit.shape[0] - 1)
    cx = scene.coordinates[voxel, 0] * scene.voxel_steps
    cy = scene.coordinates[voxel, 1] * scene.voxel_steps
    cz = scene.coordinates[voxel, 2] * scene.voxel_steps
    x = np.float64(at_units[i, 0] - lattice_to_units(cx, scene.units_per_step)) * per_unit
    y = np.float64(at_units[i, 1] - lattice_to_units(cy, scene.units_per_step)) * per_unit
    z = np.float64(at_units[i, 2] - lattice_to_units(cz, scene.units_per_step)) * per_unit
    farthest = max(abs(x), abs(y), abs(z), np.float64(max(abs(cx), abs(cy), abs(cz))))
    error = 2.0 * per_unit + (farthest + scene.voxel_steps) * 2.0**-45
    base = scene.where[voxel, 0]
    rows[0], bounds[0], depth = base, 0.0, 1
    while depth > 0:
        if stopped(scene.stop):
            return 0.0
        depth -= 1
        row, above = rows[depth], bounds[depth]
        bound = max((above - error) * scene.units_per_step, 0.0)
        if bound >= below:
            continue
        first, count = ints[row + FIRST], ints[row + COUNT] & COUNTED
        if first >= 0:
            begin, limit = depth, min(below, reach) * per_unit + error
            for child in range(base + first * ROW_WORDS, base + (first + count) * ROW_WORDS, ROW_WORDS):
                away, _ = _below_node(words, child, x, y, z, limit)
                if away <= limit:
                    push_sorted(rows, bounds, begin, depth, child, max(away, above))
                    depth += 1
            continue
        block_at = scene.where[voxel, 1] + ~first * scene.block_words
        lane_at = scene.where[voxel, 2] + ~first * 3 * LANES
        at_x = U(lane_at)
        at_y, at_z = at_x + U(LANES), at_x + U(2 * LANES)
        for j in range(count):
            dx = np.float64(ints[block_at]) + np.float64(halves[at_x + U(j)]) - x
            dy = np.float64(ints[block_at + 1]) + np.float64(halves[at_y + U(j)]) - y
            dz = np.float64(ints[block_at + 2]) + np.float64(halves[at_z + U(j)]) - z
            apart = (math.sqrt(dx * dx + dy * dy + dz * dz) * (1.0 - 2.0**-50) - error) * scene.units_per_step
            cover = least - np.float64(scene.radius_deficit[point_class(ints, block_at, j, mask)])
            below = min(below, max(apart - cover, bound))
    return below


@nb.njit(nogil=True, cache=True)
def bound_points(at_units, reach, least, lists, cursor, held, scene, best):
    """Lower best.value to lower bounds of the distances of points from a scene, by its level of detail.

    scene: the level, with cover spheres.  least: see `_bound`, the farthest that a point of the
    scene lies outside of the box of its voxel's representatives.  lists: of voxels within reach and
    that. Other arguments as for `search_points`. Only `value` and `unseen` of `best` are written.
    """
    rows, bounds = np.empty(STACK, np.int64), np.empty(STACK)
    limit = np.float64(reach)
    for i in range(cursor.shape[0]):
        end = lists.starts[i + 1]
        while cursor[i] < end and (held[lists.rows[cursor[i]]] or stopped(scene.stop)):
            voxel, near = lists.rows[cursor[i]], max(lists.near[cursor[i]] - least, 0.0)
            if stopped(scene.stop):
                best.unseen[i], cursor[i] = 0.0, end
            elif near > best.value[i]:
                cursor[i] = end
            else:
                if scene.where[voxel, 0] < 0:
                    best.unseen[i] = min(best.unseen[i], near)
                else:
                    best.value[i] = _bound(
                        scene, voxel, at_units, i, least, best.value[i], limit, rows, bounds
                    )  # fmt: skip
                cursor[i] += 1
