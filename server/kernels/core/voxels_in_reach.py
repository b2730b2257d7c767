"""Broad phase: check poses, and list the voxels that the avatar could touch under each.

A voxel is listed by the box around its points (server/residency/index_proof.py).
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ....schemas.archive.rigid_pose import RIGID_TOLERANCE
from ....schemas.archive.units import UNITS_PER_METRE
from ....schemas.archive.voxel_grid import KEY_BIAS, MAX_COORDINATE
from ....schemas.kernels import compiling as nb
from ....schemas.kernels.morton import morton_code
from .kernel_decorators import njit_no_refcount
from .placed_avatar import MAX_REACH_UNITS, largest_term, place
from .scene_arrays import stopped

# Poses checked, and cells or voxels examined, between two checks of the stop flag.
POSES_AT_ONCE = 64
CELLS_AT_ONCE = 1024

# Coordinates near a pose must be exact in float32, with a bit to spare (collide_poses.py).
MAX_FRAME_STEPS = 1 << 23
VALID, NOT_FINITE, BAD_LAST_ROW, MIRRORED, SHEARED, SCALED, TOO_FAR, LONG_REACH, LARGE_AVATAR = range(9)


class SceneIndex(NamedTuple):
    """Arrays of a scene's v voxels that the broad phase reads.

    keys: (v,) uint64, sorted.
    low, high: (v, 3) int64, least and greatest lattice coordinates of a box around a voxel's
    points. It is the box of the voxel's cell until the voxel's record proves what the index states.
    scene_low, scene_high: (3,) int64, those of all points, as the index states them. They decide
    only what lies outside and which cells exist.
    """

    keys: NDArray[np.uint64]
    low: NDArray[np.int64]
    high: NDArray[np.int64]
    scene_low: NDArray[np.int64]
    scene_high: NDArray[np.int64]


class VoxelsInReach(NamedTuple):
    """Voxels that k poses could touch.

    units: (k,) int64, r_a + r_b + margin in exact units.
    starts: (k + 1,), rows: int64: the voxel rows of pose i are rows[starts[i]:starts[i + 1]].
    boxes: (k, 2, 3) float64, the box of the root sphere and its reach [steps].
    outside: (k,) bool, whether that box extends beyond the scene's box.
    """

    units: NDArray[np.int64]
    starts: NDArray[np.int64]
    rows: NDArray[np.int64]
    boxes: NDArray[np.float64]
    outside: NDArray[np.bool_]


@njit_no_refcount
def check_poses(poses, node_radius, radius, other_units, scene, units):
    """Check that poses (k, 4, 4) float64 are rigid (N6); compute reaches.

    Writes units (k,) int64, the reach of each pose in exact units.
    node_radius: (a,) of the avatar's nodes, root first, may be empty.  radius: of its points [m].
    other_units: the scan's radius plus the margin, exact units.  scene: SceneArrays.
    Returns (GOOD, 0, 0.0), or the first fault, its pose and the value found. Once scene.stop is
    set, it also returns (GOOD, 0, 0.0), with the output incomplete: the caller must then check the
    stop flag.
    """
    reach = np.rint(radius * UNITS_PER_METRE) + float(other_units)
    extent = reach / UNITS_PER_METRE + (node_radius[0] if node_radius.shape[0] else 0.0)
    for i in range(poses.shape[0]):
        if i % POSES_AT_ONCE == 0 and stopped(scene.stop):
            break
        m = poses[i]
        for r in range(4):
            for c in range(4):
                if not math.isfinite(m[r, c]):
                    return NOT_FINITE, i, m[r, c]
        if m[3, 0] != 0.0 or m[3, 1] != 0.0 or m[3, 2] != 0.0 or m[3, 3] != 1.0:
            return BAD_LAST_ROW, i, m[3, 3]
        for r in range(3):
            if not abs(m[r, 3]) <= MAX_COORDINATE:
                return TOO_FAR, i, m[r, 3]
        minor0 = m[1, 1] * m[2, 2] - m[1, 2] * m[2, 1]
        minor1 = m[1, 0] * m[2, 2] - m[1, 2] * m[2, 0]
        minor2 = m[1, 0] * m[2, 1] - m[1, 1] * m[2, 0]
        volume = m[0, 0] * minor0 - m[0, 1] * minor1 + m[0, 2] * minor2
        square = 0.0
        for r in range(3):
            for c in range(3):
                square += m[r, c] * m[r, c]
        square /= 3.0
        worst = 0.0
        for a in range(3):
            for b in range(3):
                dot = m[0, a] * m[0, b] + m[1, a] * m[1, b] + m[2, a] * m[2, b]
                worst = max(worst, abs(dot - (square if a == b else 0.0)))
        # Factor 2: an entry that is off by the tolerance changes a product of two entries by twice
        # that.
        if worst > 2.0 * RIGID_TOLERANCE * square:
            return SHEARED, i, worst / square
        if volume < 0.0:
            return MIRRORED, i, volume
        scale = math.sqrt(square)
        if not abs(scale - 1.0) <= RIGID_TOLERANCE:
            return SCALED, i, scale
        if reach > MAX_REACH_UNITS:
            return LONG_REACH, i, reach / UNITS_PER_METRE
        units[i] = np.int64(reach)
        if extent / scene.step + scene.voxel_steps > MAX_FRAME_STEPS:
            return LARGE_AVATAR, i, extent
    return VALID, 0, 0.0


@njit_no_refcount
def find_key(keys, key):
    """Return the row of `key` in sorted keys (v,) uint64, or -1."""
    lo, hi = 0, keys.shape[0]
    while lo < hi:
        mid = (lo + hi) // 2
        if keys[mid] < key:
            lo = mid + 1
        else:
            hi = mid
    return lo if lo < keys.shape[0] and keys[lo] == key else -1


@njit_no_refcount
def grid_low(scene_low, voxel_steps):
    """Return the lowest lattice coordinate along an axis of the grid cells that hold points.

    float64, exact.
    """
    return np.float64(scene_low // voxel_steps * voxel_steps)


@njit_no_refcount
def grid_high(scene_high, voxel_steps):
    """Return the highest lattice coordinate along an axis of the grid cells that hold points.

    float64, exact.
    """
    return np.float64((scene_high // voxel_steps + 1) * voxel_steps - 1)


@njit_no_refcount
def _near_box(center, reach, low, high):
    """Return whether a ball (center (3,), reach) touches a box.

    low, high: (3,) float64; all [steps].
    """
    square = 0.0
    for k in range(3):
        gap = max(low[k] - center[k], center[k] - high[k], 0.0)
        square += gap * gap
    return square <= reach * reach


@nb.njit(nogil=True, cache=True)
def find_reach(poses, avatar, radius, other_units, scene, index, reach):
    """Check poses and list the voxels in reach of each: `check_poses`, then `voxels_in_reach`.

    radius: of the avatar's points [m].  other_units: radius of the scan's points plus the margin,
    exact units. Fills `reach`.
    Returns (fault, pose, value found), as `check_poses` does, and the number of rows needed.
    """
    fault, pose, found = check_poses(poses, avatar.radius, radius, other_units, scene, reach.units)
    if fault != VALID or avatar.radius.shape[0] == 0:
        return fault, pose, found, 0
    return fault, pose, found, voxels_in_reach(poses, avatar, scene, index, reach)


@nb.njit(nogil=True, cache=True)
def voxels_in_reach(poses, avatar, scene, index, reach):
    """List, for each pose, the voxels whose points the avatar's root sphere could touch.

    The order depends on the positions alone.
    poses: (k, 4, 4), checked.  avatar: not empty.  scene: SceneArrays.
    Fills starts, rows, boxes and outside of `reach` from its units. Returns how many
    rows are needed; those beyond the capacity are not written. Returns -1 when the scene's stop
    flag is set; `reach` is then not filled.
    The reach is widened by more than the rounding of this function: a millionth of itself, one
    step, and 2^-49 of the largest term of the sums.
    """
    step, units_per_step, voxel_steps = scene.step, scene.units_per_step, scene.voxel_steps
    keys, scene_low, scene_high = index.keys, index.scene_low, index.scene_high
    boxes, outside = reach.boxes, reach.outside
    x, y, z = avatar.center[0, 0], avatar.center[0, 1], avatar.center[0, 2]
    shift, center = np.empty(3), np.empty(3)
    first, last = np.empty(3, np.int64), np.empty(3, np.int64)
    box_low, box_high = np.empty(3), np.empty(3)
    needed = 0
    for i in range(poses.shape[0]):
        if stopped(scene.stop):
            return -1
        m = poses[i]
        for r in range(3):
            shift[r] = m[r, 3] - scene.origin[r]
        span = (avatar.radius[0] / step + reach.units[i] / units_per_step) * (1.0 + 1e-6) + 1.0
        span += largest_term(m, shift, x, y, z) / step * 2.0**-49
        cells = 1.0
        outside[i] = False
        for r in range(3):
            center[r] = place(m, shift, r, x, y, z) / step
            boxes[i, 0, r], boxes[i, 1, r] = center[r] - span, center[r] + span
            outside[i] |= boxes[i, 0, r] < scene_low[r] or boxes[i, 1, r] > scene_high[r]
            least = max(boxes[i, 0, r], grid_low(scene_low[r], voxel_steps))
            most = min(boxes[i, 1, r], grid_high(scene_high[r], voxel_steps))
            first[r] = np.int64(math.floor(least / voxel_steps))
            last[r] = np.int64(math.floor(most / voxel_steps))
            cells *= max(0.0, np.float64(last[r] - first[r] + 1)) if least <= most else 0.0
        reach.starts[i] = needed
        if cells == 0.0:
            continue
        listed = cells > keys.shape[0]  # cheaper to test every voxel than every cell of the grid
        ix, iy, iz = first[0], first[1], first[2]
        row, looked = -1, 0
        while True:
            looked += 1
            if looked % CELLS_AT_ONCE == 0 and stopped(scene.stop):
                return -1
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
                box_low[r], box_high[r] = np.float64(index.low[row, r]), np.float64(index.high[row, r])
            if _near_box(center, span, box_low, box_high):
                if needed < reach.rows.shape[0]:
                    reach.rows[needed] = row
                needed += 1
    reach.starts[poses.shape[0]] = needed
    return needed
