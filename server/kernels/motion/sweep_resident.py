"""Sweep of one motion in one call, where all voxels in its reach are resident.

The result is that of server/queries/sweep.py. The cost of a motion is then only its search: the
arrays are passed by reference (array_references.py), and each inspection of a result's contents
costs another call.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ....schemas.runtime import compiling as nb
from ....schemas.wire.answers import Verdict
from ..core.array_references import reference
from ..core.kernel_decorators import njit_no_refcount
from ..core.reach import VALID, all_resident, check_poses
from ..core.scene_arrays import SceneArrays, stopped
from .moving_avatar import MovingAvatar, make_moving
from .screw_motion import make_motion, pose_at
from .sweep_segments import (
    PlanSpace,
    SweepProgress,
    advance_segments,
    find_unknown_regions,
    make_plan_space,
    plan_segments,
)
from .vector_tuples import column, copy_pose, dot, minus, norm, place_of, plus, put, times, vector

_CLEAR, _CONTACT, _UNKNOWN = int(Verdict.CLEAR), int(Verdict.CONTACT), int(Verdict.UNKNOWN)

# Result of `sweep_resident` for a motion that it does not answer.
_NOT_ANSWERED = (-1, _UNKNOWN, 0, 0, 0)
# Fields of the output: fractions, upper bound of the distance any point moves [m], the witness's
# centres, world [m], and whether the reach leaves the scene's bounds.
SWEPT = (
    ("lower", "f8"), ("upper", "f8"), ("speed", "f8"), ("avatar", "f8", (3,)), ("cloud", "f8", (3,)),
    ("outside", "?"),
)  # fmt: skip
# Least length of a motion [m]. With shorter ones a pushing avatar would tremble by the error of
# `lower`.
MIN_MOTION = 2e-5
# If a motion is undecided for more than this distance before its contact, it ends where the
# undecided part begins [m].
MAX_UNDECIDED = 1e-4
# Limit on the distance by which a motion stops before a contact, as a multiple of `skin`. In a
# grazing motion, the distance that keeps `skin` from the wall would be long.
MAX_SKIN_FACTOR = 4.0


class OneMotion(NamedTuple):
    """Arrays of one motion, as those of k in sweep_segments.py; scratch.

    first, last: (1, 4, 4).  counts: (4, 1).  which: (1,), zero.  origin: (3,), zero.
    The others are (1,).
    """

    first: NDArray[np.float64]
    last: NDArray[np.float64]
    units: NDArray[np.int64]
    progress: SweepProgress
    counts: NDArray[np.uint32]
    which: NDArray[np.int64]
    cursor: NDArray[np.int64]
    moved: NDArray[np.float64]
    origin: NDArray[np.float64]
    outside: NDArray[np.bool_]
    until: NDArray[np.float64]
    unknown_from: NDArray[np.float64]


@reference
class MotionScratch(NamedTuple):
    """Reference to the scratch of an avatar's motions, see array_references.py."""

    moving: MovingAvatar
    space: PlanSpace
    one: OneMotion


@nb.njit(nogil=True, cache=True)
def make_scratch(avatar):
    """Allocate the scratch for an avatar, not empty. It serves one motion at a time."""
    progress = SweepProgress(
        np.zeros(1), np.ones(1), np.ones(1), np.zeros(1), np.zeros(1), np.zeros((1, 2, 3)), np.zeros(1), np.zeros(1)
    )  # fmt: skip
    one = OneMotion(
        np.empty((1, 4, 4)), np.empty((1, 4, 4)), np.empty(1, np.int64), progress, np.zeros((4, 1), np.uint32),
        np.zeros(1, np.int64), np.zeros(1, np.int64), np.empty(1), np.zeros(3), np.empty(1, np.bool_), np.empty(1),
        np.empty(1),
    )  # fmt: skip
    return MotionScratch(make_moving(avatar), make_plan_space(), one)


@njit_no_refcount
def longest_way(pose_from, pose_to, avatar):
    """Return an approximate bound of the distance that any avatar point moves [m].

    pose_from, pose_to: (4, 4).
    """
    square = 0.0
    for r in range(3):
        for c in range(3):
            turn = pose_to[r, c] - pose_from[r, c]
            square += turn * turn
    center = _moved(pose_from, pose_to, vector(avatar.center[0]))
    return norm(center) + math.sqrt(square) * avatar.radius[0]


@njit_no_refcount
def _moved(pose_from, pose_to, place):
    """Return by how much a place of the avatar's frame is moved from one pose to another [m]."""
    x, y, z = vector(place)
    # Column by column: the differences of the entries come before the products.
    a = times(x, minus(column(pose_to, 0), column(pose_from, 0)))
    b = times(y, minus(column(pose_to, 1), column(pose_from, 1)))
    c = times(z, minus(column(pose_to, 2), column(pose_from, 2)))
    return plus(minus(place_of(pose_to), place_of(pose_from)), plus(plus(a, b), c))


@njit_no_refcount
def skin_fraction(pose_from, pose_to, own, cloud, point, way, skin):
    """Return the share of a motion by which to stop before a contact.

    The avatar is then `skin` [m] away from the tangent plane of the two spheres.
    own, cloud: (3,), their centres, world.  point: (3,), that of the avatar's in its own frame.
    way: `longest_way`.
    """
    if way <= 0.0 or skin <= 0.0:
        return 0.0
    out, moved = minus(own, cloud), _moved(pose_from, pose_to, point)
    length, speed = norm(out), norm(moved)
    if speed <= 1e-9 * way:
        return min(1.0, skin / way)
    into = speed if length == 0.0 else -dot(moved, out) / length
    return skin / max(into, speed / MAX_SKIN_FACTOR)


@nb.njit(nogil=True, cache=True)
def sweep_resident(
    pose_from, pose_to, body, scratch, other_units, held, stop, unknown_everywhere, tolerance, result
):  # fmt: skip
    """Sweep one motion if it is short and all voxels in its reach are resident.

    pose_from, pose_to: (4, 4) world, unchecked.  body, held: references to the arrays of an avatar
    that is not empty, and of the scene.  scratch: `make_scratch` of the avatar.  stop: (1,) int64, the
    request's stop flag.  other_units, tolerance: as in `advance_segments`.  The
    dataset's origin is subtracted from the motion as in server/queries/sweep.py.
    Writes held.one, the voxels in reach, and result, a record with the fields SWEPT; the witness is
    written where the verdict is CONTACT.
    Returns (number of rows, verdict, node visits, point tests, advances). -1 rows: not answered;
    this includes invalid poses.
    """
    avatar, box, scene, tree, lists = body.avatar, body.box, held.scene, held.tree, held.one.reach.lists
    one, origin = scratch.one, scene.origin
    first, last, units, progress, counts = one.first, one.last, one.units, one.progress, one.counts
    copy_pose(pose_from, first[0])
    copy_pose(pose_to, last[0])
    for poses in (first, last):
        fault, _, _ = check_poses(poses, avatar.radius, body.radius, other_units, scene, units)
        if fault != VALID:
            return _NOT_ANSWERED
    for r in range(3):
        first[0, r, 3] -= origin[r]
        last[0, r, 3] -= origin[r]
    from_zero = SceneArrays(
        scene.words, scene.ints, scene.halves, scene.where, scene.corners, one.origin, scene.step,
        scene.units_per_step, scene.voxel_steps, scene.block_words, scene.radius_deficit, stop,
    )  # fmt: skip
    progress.at[0], progress.end[0], progress.lower[0], progress.speed[0] = 0.0, 1.0, 1.0, 0.0
    progress.upper[0], progress.floor[0] = np.inf, 0.0
    for n in range(4):
        counts[n, 0] = np.uint32(0)
    needed = plan_segments(
        box, first, last, avatar, units, from_zero, tree, one.which, progress, lists, scratch.space, one.moved,
    )  # fmt: skip
    if not all_resident(scene.where, lists.rows, needed) or (needed > 0 and progress.end[0] < 1.0):
        return _NOT_ANSWERED
    proved = 1.0
    if needed > 0:
        progress.lower[0], one.cursor[0] = progress.end[0], 0
        advance_segments(
            box, first, last, avatar, units, from_zero, lists, one.which,
            one.cursor, held.one.all_held, tolerance, scratch, progress, counts,
        )  # fmt: skip
        if stopped(stop):
            return _NOT_ANSWERED
        proved = progress.lower[0]
    upper, until, outside, unknown_from = progress.upper[0], one.until, one.outside, one.unknown_from
    until[0] = upper
    find_unknown_regions(
        box, first, last, avatar, units, from_zero, tree, until, scratch.space, outside, unknown_from
    )
    if unknown_everywhere:
        proved = 0.0
    elif unknown_from[0] <= min(upper, 1.0):
        proved = min(proved, unknown_from[0])
    result.lower, result.upper, result.speed, result.outside = proved, upper, progress.speed[0], outside[0]
    verdict = _CLEAR if proved >= 1.0 else _UNKNOWN
    if upper < np.inf:
        verdict = _CONTACT
        put(result.avatar, plus(progress.witness[0, 0], origin))
        put(result.cloud, plus(progress.witness[0, 1], origin))
    return needed, verdict, np.int64(counts[1, 0]), np.int64(counts[2, 0]), np.int64(counts[3, 0])


@nb.njit(nogil=True, cache=True)
def pose_between(pose_from, pose_to, fraction, box, origin, pose):
    """Write the pose at a fraction of a motion to pose (4, 4), world.

    The motion is given as for `sweep_resident`. Returns whether subtracting the origin again gives
    the sweep's pose bit for bit, so that a proof of the sweep holds for this pose.
    """
    poses = np.empty((2, 4, 4))
    copy_pose(pose_from, poses[0])
    copy_pose(pose_to, poses[1])
    for r in range(3):
        poses[0, r, 3] -= origin[r]
        poses[1, r, 3] -= origin[r]
    pose_at(make_motion(poses[0], poses[1], box, np.zeros(3)), fraction, pose)
    same = True
    for r in range(3):
        there = pose[r, 3]
        pose[r, 3] = there + origin[r]
        same &= pose[r, 3] - origin[r] == there
    return same
