"""Poses of a request: their checks, and the voxels that the avatar could touch under each."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ....schemas.archive.rigid_pose import RIGID_TOLERANCE
from ....schemas.archive.units import UNITS_PER_METRE
from ....schemas.archive.voxel_grid import MAX_COORDINATE
from ....schemas.runtime import compiling as nb
from .kernel_decorators import njit_no_refcount
from .placed_avatar import MAX_REACH_UNITS, largest_term, place
from .reach import REACH_STACK, VoxelLists, list_item, unknown_near
from .scene_arrays import stopped

# Poses checked between two checks of the stop flag.
POSES_AT_ONCE = 64
# Voxels in reach of a query of one item that is answered in one call.
MAX_ROWS_OF_ONE = 64

# Coordinates near a pose must be exact in float32, with a bit to spare (collide_poses.py).
MAX_FRAME_STEPS = 1 << 23
VALID, NOT_FINITE, BAD_LAST_ROW, MIRRORED, SHEARED, SCALED, TOO_FAR, LONG_REACH, LARGE_AVATAR = range(9)


class VoxelsInReach(NamedTuple):
    """Voxels that k poses could touch.

    units: (k,) int64, r_a + r_b + margin in exact units.
    lists: the voxels; `near` bounds the distance between centres, and `unseen` is that of scans that
    were left out.
    outside: (k,) bool, whether the box of the root sphere and its reach extends beyond the scene's box.
    """

    units: NDArray[np.int64]
    lists: VoxelLists
    outside: NDArray[np.bool_]


class OneReach(NamedTuple):
    """Scratch for the reach of one pose or point: reach, with space for MAX_ROWS_OF_ONE rows.

    which, cursor: (1,) int64, zero, and entries examined.  all_held: (0,) uint8, states.  never: (1,)
    int64, a stop flag that is not set.
    """

    reach: VoxelsInReach
    which: NDArray[np.int64]
    cursor: NDArray[np.int64]
    all_held: NDArray[np.uint8]
    never: NDArray[np.int64]


def make_reach(k: int, rows: int) -> VoxelsInReach:
    """Return an empty `VoxelsInReach` for k poses, with space for `rows` voxel rows."""
    lists = VoxelLists(
        np.zeros(k + 1, np.int64), np.empty(rows, np.int64), np.empty(rows), np.full(k, np.inf)
    )
    return VoxelsInReach(np.empty(k, np.int64), lists, np.zeros(k, bool))


def make_one_reach() -> OneReach:
    """Allocate the scratch for one pose or point."""
    which, cursor, never = np.zeros(1, np.int64), np.zeros(1, np.int64), np.zeros(1, np.int64)
    return OneReach(make_reach(1, MAX_ROWS_OF_ONE), which, cursor, np.empty(0, np.uint8), never)


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


@nb.njit(nogil=True, cache=True)
def find_reach(poses, avatar, radius, other_units, scene, tree, reach):
    """Check poses and list the voxels in reach of each: `check_poses`, then `voxels_in_reach`.

    radius: of the avatar's points [m].  other_units: radius of the scan's points plus the margin,
    exact units. Fills `reach`.
    Returns (fault, pose, value found), as `check_poses` does, and the number of rows needed.
    """
    fault, pose, found = check_poses(poses, avatar.radius, radius, other_units, scene, reach.units)
    if fault != VALID or avatar.radius.shape[0] == 0:
        return fault, pose, found, 0
    return fault, pose, found, voxels_in_reach(poses, avatar, scene, tree, reach)


@nb.njit(nogil=True, cache=True)
def voxels_in_reach(poses, avatar, scene, tree, reach):
    """List, for each pose, the voxels whose points the avatar's root sphere could touch, nearest first.

    poses: (k, 4, 4), checked.  avatar: not empty.  scene: SceneArrays.
    Fills lists and outside of `reach` from its units. Returns how many rows are needed; those
    beyond the capacity are not written. Returns -1 when the scene's stop flag is set; `reach` is then
    not filled.
    The reach is widened by more than the rounding of this function: a millionth of itself, one
    step, and 2^-49 of the largest term of the sums.
    """
    outside, lists, stack = reach.outside, reach.lists, np.empty(REACH_STACK, np.int64)
    x, y, z = avatar.center[0, 0], avatar.center[0, 1], avatar.center[0, 2]
    shift, center = np.empty(3), np.empty(3)
    needed = 0
    for i in range(poses.shape[0]):
        m = poses[i]
        for r in range(3):
            shift[r] = m[r, 3] - scene.origin[r]
        rounding = largest_term(m, shift, x, y, z) / scene.step * 2.0**-49
        root = avatar.radius[0] / scene.step
        span = (root + reach.units[i] / scene.units_per_step) * (1.0 + 1e-6) + 1.0 + rounding
        outside[i] = False
        for r in range(3):
            center[r] = place(m, shift, r, x, y, z) / scene.step
            outside[i] |= center[r] - span < tree.scene[0, r] or center[r] + span > tree.scene[1, r]
        own = root * (1.0 + 1e-6) + 1.0 + rounding
        lists.starts[i] = needed
        needed = list_item(tree, center, center, span, own, scene.stop, stack, lists.rows, lists.near, needed)
        lists.unseen[i] = unknown_near(tree, center, center, span, own)
        if stopped(scene.stop):
            return -1
    lists.starts[poses.shape[0]] = needed
    return needed
