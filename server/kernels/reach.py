"""The broad phase: which voxels a placed avatar could touch, from the index alone."""

import math

import numba as nb
import numpy as np

from ...schemas.kernels.morton import morton_code
from ...schemas.voxel_grid import KEY_BIAS
from .placing import largest_term, place


@nb.njit(nogil=True, cache=True)
def find_key(keys, key):
    """Row of `key` in sorted keys (v,) uint64, or -1."""
    lo, hi = 0, keys.shape[0]
    while lo < hi:
        mid = (lo + hi) // 2
        if keys[mid] < key:
            lo = mid + 1
        else:
            hi = mid
    return lo if lo < keys.shape[0] and keys[lo] == key else -1


@nb.njit(nogil=True, cache=True)
def _near_box(center, reach, low, high):
    """Whether a ball (center (3,), reach) touches the box [low, high] (3,) float64; all [steps]."""
    square = 0.0
    for k in range(3):
        gap = max(low[k] - center[k], center[k] - high[k], 0.0)
        square += gap * gap
    return square <= reach * reach


@nb.njit(nogil=True, cache=True)
def voxels_in_reach(
    poses, scales, reach_units, node_center, node_radius, scene, keys, low, high, scene_low, scene_high,
    starts, rows, boxes, outside,
):  # fmt: skip
    """List, for each pose, the voxels whose points its root sphere could touch.

    poses: (k, 4, 4).  scales: (k,).  reach_units: (k,) int64, r_a + r_b + margin in exact units.
    node_center (a, 3), node_radius (a,): the avatar's nodes, root first [m].  scene: SceneArrays.
    keys (v,) sorted: the voxels that exist; low, high (v, 3) int64: least and greatest lattice coordinates of their
    points.
    scene_low, scene_high (3,) int64: those of all points.
    Writes starts (k + 1,) int64 and rows (capacity,) int64: voxel rows of pose i are rows[starts[i]:starts[i+1]],
    by key; boxes (k, 2, 3) float64: the box of the root sphere and its reach [steps]; outside (k,): whether
    that box leaves the scene's. Returns how many rows are needed; beyond the capacity none are written.
    The reach is widened by more than the rounding of this function: a millionth of itself, a step, and 2^-49 of the
    largest term that was added up.
    """
    step, units_per_step, voxel_steps = scene.step, scene.units_per_step, scene.voxel_steps
    shift, center = np.empty(3), np.empty(3)
    first, last = np.empty(3, np.int64), np.empty(3, np.int64)
    box_low, box_high = np.empty(3), np.empty(3)
    needed = 0
    for i in range(poses.shape[0]):
        m = poses[i]
        for r in range(3):
            shift[r] = m[r, 3] - scene.origin[r]
        x, y, z = node_center[0, 0], node_center[0, 1], node_center[0, 2]
        reach = (node_radius[0] * scales[i] / step + reach_units[i] / units_per_step) * (1.0 + 1e-6) + 1.0
        reach += largest_term(m, shift, x, y, z) / step * 2.0**-49
        cells = 1.0
        outside[i] = False
        for r in range(3):
            center[r] = place(m, shift, r, x, y, z) / step
            boxes[i, 0, r], boxes[i, 1, r] = center[r] - reach, center[r] + reach
            outside[i] |= boxes[i, 0, r] < scene_low[r] or boxes[i, 1, r] > scene_high[r]
            least = max(boxes[i, 0, r], np.float64(scene_low[r]))
            most = min(boxes[i, 1, r], np.float64(scene_high[r]))
            first[r] = np.int64(math.floor(least / voxel_steps))
            last[r] = np.int64(math.floor(most / voxel_steps))
            cells *= max(0.0, np.float64(last[r] - first[r] + 1)) if least <= most else 0.0
        starts[i] = needed
        if cells == 0.0:
            continue
        listed = cells > keys.shape[0]  # cheaper to go through the voxels than through the grid
        ix, iy, iz = first[0], first[1], first[2]
        row = -1
        while True:
            if listed:
                row += 1
                if row == keys.shape[0]:
                    break
            else:
                if ix > last[0]:
                    break
                row = find_key(
                    keys,
                    morton_code(np.uint64(ix + KEY_BIAS), np.uint64(iy + KEY_BIAS), np.uint64(iz + KEY_BIAS)),
                )
                iz += 1
                if iz > last[2]:
                    iz = first[2]
                    iy += 1
                    if iy > last[1]:
                        iy = first[1]
                        ix += 1
                if row < 0:
                    continue
            for r in range(3):
                box_low[r], box_high[r] = np.float64(low[row, r]), np.float64(high[row, r])
            if _near_box(center, reach, box_low, box_high):
                if needed < rows.shape[0]:
                    rows[needed] = row
                needed += 1
    starts[poses.shape[0]] = needed
    return needed
