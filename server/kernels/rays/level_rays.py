"""Lower bounds of the hits of rays, by the cover spheres of a level of detail.

schemas/archive/level.py says what a level is. rays.py finds the hits of a scene's own points.
"""

import numpy as np

from ....schemas.kernels import compiling as nb
from ..core.kernel_decorators import njit_no_refcount
from ..core.placed_avatar import lattice_to_units
from ..core.scene_arrays import COUNT, COUNTED, FIRST, LANES, ROW_WORDS, node_class, point_class, stopped
from .rays import STACK, first_meeting, meet_node, push_sorted, set_frame


@njit_no_refcount
def _bound(scene, voxel, rays, i, ray, near, best, rows, bounds, deficits):
    """Lower best.value[i] to where ray i may first be hit in one resident voxel of a level of detail.

    Arguments as for `_follow`. In a leaf node, nothing is hit before the ray meets the node, which
    encloses the scene's points themselves, nor before it meets one of the cover spheres.
    """
    words, ints, halves = scene.words, scene.ints, scene.halves
    per_unit = 1.0 / scene.units_per_step
    farthest = 0.0
    for r in range(3):
        corner = scene.coordinates[voxel, r] * scene.voxel_steps
        from_corner = rays.origin[i, r] - lattice_to_units(corner, scene.units_per_step)
        ray[r] = np.float64(from_corner) * per_unit
        farthest = max(farthest, abs(ray[r]), abs(np.float64(corner)))
    error = 2.0 * per_unit + (farthest + scene.voxel_steps) * 2.0**-45
    largest, reach = np.float64(rays.radius) * per_unit + error, np.float64(rays.reach)
    base, mask = scene.where[voxel, 0], np.uint64(deficits.shape[0] - 1)
    rows[0], bounds[0], depth = base, near * per_unit + error, 1
    while depth > 0:
        if stopped(scene.stop):
            best.value[i] = 0.0
            return
        depth -= 1
        row, above = rows[depth], bounds[depth]
        bound = max((above - error) * scene.units_per_step, 0.0)
        if bound >= best.value[i]:
            continue
        first, count = ints[row + FIRST], ints[row + COUNT] & COUNTED
        if first >= 0:
            begin, limit = depth, min(best.value[i], reach) * per_unit + error
            for child in range(base + first * ROW_WORDS, base + (first + count) * ROW_WORDS, ROW_WORDS):
                radius = largest - deficits[node_class(ints, child, mask)]
                entered = meet_node(words, child, ray, radius, limit)
                if entered < np.inf:
                    push_sorted(rows, bounds, begin, depth, child, max(entered, above))
                    depth += 1
            continue
        block_at = scene.where[voxel, 1] + ~first * scene.block_words
        lane_at = scene.where[voxel, 2] + ~first * 3 * LANES
        x = scene.coordinates[voxel, 0] * scene.voxel_steps + np.int64(ints[block_at])
        y = scene.coordinates[voxel, 1] * scene.voxel_steps + np.int64(ints[block_at + 1])
        z = scene.coordinates[voxel, 2] * scene.voxel_steps + np.int64(ints[block_at + 2])
        for j in range(lane_at, lane_at + count):
            t = first_meeting(
                lattice_to_units(x + np.int64(halves[j]), scene.units_per_step) - rays.origin[i, 0],
                lattice_to_units(y + np.int64(halves[j + LANES]), scene.units_per_step) - rays.origin[i, 1],
                lattice_to_units(z + np.int64(halves[j + 2 * LANES]), scene.units_per_step) - rays.origin[i, 2],
                rays.direction[i, 0], rays.direction[i, 1], rays.direction[i, 2],
                rays.radius - scene.radius_deficit[point_class(ints, block_at, j - lane_at, mask)],
            )  # fmt: skip
            if t <= reach:
                best.value[i] = min(best.value[i], max(t, bound))


@nb.njit(nogil=True, cache=True)
def bound_rays(rays, lists, cursor, held, scene, best):
    """Lower best.value to where rays may first be hit, by the cover spheres of a level of detail.

    scene: the level, with those spheres.  Other arguments as for `follow_rays`.
    """
    ray = np.empty(12)
    rows, bounds = np.empty(STACK, np.int64), np.empty(STACK)
    deficits = scene.radius_deficit.astype(np.float64) / scene.units_per_step
    for i in range(cursor.shape[0]):
        end = lists.starts[i + 1]
        if cursor[i] < end:
            set_frame(ray, rays.direction[i])
        while cursor[i] < end and (held[lists.rows[cursor[i]]] or stopped(scene.stop)):
            near, voxel = lists.near[cursor[i]], lists.rows[cursor[i]]
            if stopped(scene.stop):
                best.unseen[i], cursor[i] = 0.0, end
            elif near > best.value[i]:
                cursor[i] = end
            else:
                if scene.where[voxel, 0] < 0:
                    best.unseen[i] = min(best.unseen[i], near)
                else:
                    _bound(scene, voxel, rays, i, ray, near, best, rows, bounds, deficits)
                cursor[i] += 1
