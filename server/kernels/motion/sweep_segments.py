"""Segments of motions: the part of a motion advanced at a time, and the voxels that it reaches."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ....schemas.archive.units import UNITS_PER_METRE
from ....schemas.runtime import compiling as nb
from ..core.kernel_decorators import njit_no_refcount
from ..core.placed_avatar import largest_term, place
from ..core.reach import INFINITE, REACH_STACK, entry_fraction, list_item
from ..core.scene_arrays import stopped
from .screw_motion import make_motion, pose_at

# Extent of a segment, and thereby of what must be resident together: four avatars plus 8 m.
_SEGMENT_SIZES, _SEGMENT_MORE = 4.0, 8.0
# Limit of a segment in lattice steps: float32 is exact up to 2^24 (placed_avatar.py), and an avatar
# may take 2^23.
_SEGMENT_STEPS = 2.0**21
# Sagitta of a segment, in avatar sizes: boxes grow by it.
_SEGMENT_BEND = 0.25


class SweepProgress(NamedTuple):
    """Progress of each of k motions; all arrays (k,) unless stated.

    at, end: float64, the current segment.
    lower: nothing touches on the segment before it; initially `end`; the least over all pieces of
    the segment's voxels.
    upper: the earliest contact found, inf: none.
    speed: upper bound of the speed of the fastest avatar point [m per unit of t].
    witness: (k, 2, 3), the pair's centres, avatar and scan, world [m].
    floor: fraction before which nothing absent touches, as the level of detail proves.
    way: how far the reach of the segment moves [steps], as in `VoxelLists.near`.
    """

    at: NDArray[np.float64]
    end: NDArray[np.float64]
    lower: NDArray[np.float64]
    upper: NDArray[np.float64]
    speed: NDArray[np.float64]
    witness: NDArray[np.float64]
    floor: NDArray[np.float64]
    way: NDArray[np.float64]


class PlanSpace(NamedTuple):
    """Scratch of `plan_segments`: pose, shift, two positions, and that of `list_item`."""

    pose: NDArray[np.float64]
    shift: NDArray[np.float64]
    begin: NDArray[np.float64]
    end: NDArray[np.float64]
    stack: NDArray[np.int64]


@nb.njit(nogil=True, cache=True)
def make_plan_space():
    """Allocate a `PlanSpace`."""
    return PlanSpace(np.empty((4, 4)), np.empty(3), np.empty(3), np.empty(3), np.empty(REACH_STACK, np.int64))


@njit_no_refcount
def avatar_size(box, units):
    """Return the size of an avatar with its reach, across [m].

    The result does not depend on the order of its points or on its tree.
    """
    square = 0.0
    for r in range(3):
        square += (box[1, r] - box[0, r]) ** 2
    return math.sqrt(square) + 2.0 * np.float64(units) / UNITS_PER_METRE + 1e-6


@njit_no_refcount
def longest_part(motion, most, sagitta):
    """Return the longest part of a motion within two limits.

    No point moves farther than `most` on it, or strays from its chord by more than `sagitta` [m].
    """
    length = 1.0
    if motion.speed > most:
        length = most / motion.speed
    if motion.bend * length * length > 8.0 * sagitta:
        length = math.sqrt(8.0 * sagitta / motion.bend)
    return length


@njit_no_refcount
def place_root_sphere(motion, t, avatar, units, scene, pose, shift, center):
    """Place the avatar's root sphere under M(t): center (3,) [steps]; pose and shift are scratch.

    Returns the radius with the reach, widened as in `voxels_in_reach`; a motion that stands still
    therefore reaches what a pose reaches.
    """
    pose_at(motion, t, pose)
    x, y, z = avatar.center[0, 0], avatar.center[0, 1], avatar.center[0, 2]
    for r in range(3):
        shift[r] = pose[r, 3] - scene.origin[r]
    for r in range(3):
        center[r] = place(pose, shift, r, x, y, z) / scene.step
    span = (avatar.radius[0] / scene.step + units / scene.units_per_step) * (1.0 + 1e-6) + 1.0
    return span + largest_term(pose, shift, x, y, z) / scene.step * 2.0**-49


@njit_no_refcount
def sagitta_of(motion, length, scene):
    """Return how far points stray from their chords on a part of the motion, at most [steps].

    0 for a motion that stands still.
    """
    if motion.speed == 0.0:
        return 0.0
    return (motion.bend * length * length / 8.0 + 4.0 * motion.slip + 2.0 / UNITS_PER_METRE) / scene.step


@nb.njit(nogil=True, cache=True)
def plan_segments(box, first, last, avatar, units, scene, tree, which, progress, lists, space, moved):
    """Plan the next segment of each motion in `which` that reaches any voxel, and list its voxels.

    box: (2, 3) around the avatar's points.  first, last: (k, 4, 4), checked.  units: (k,), as
    `check_poses` writes them.
    space: scratch.  moved: (w,) float64, one for each of `which`; scratch.
    Reads progress.at and advances it to the start of the segment; everything before is out of reach
    of all voxels. Writes end, speed and way. `at` becomes 1 for a motion with nothing left in reach,
    which gets no rows. Fills starts, rows and near of `lists`, with no rows for motions not in
    `which` (ascending).
    Returns the number of rows; those beyond the capacity are not written, and progress.at is then
    unchanged. Returns -1, with progress.at unchanged, when the scene's stop flag is set.
    """
    pose, shift, begin, end, starts = space.pose, space.shift, space.begin, space.end, lists.starts
    count, next_start = 0, 0
    for number in range(which.shape[0]):
        if stopped(scene.stop):
            return -1
        i = which[number]
        for n in range(next_start, i + 1):
            starts[n] = count
        next_start = i + 1
        motion = make_motion(first[i], last[i], box, scene.origin)
        progress.speed[i] = motion.speed
        size = avatar_size(box, units[i])
        most = min(_SEGMENT_SIZES * size + _SEGMENT_MORE, _SEGMENT_STEPS * scene.step)
        segment = longest_part(motion, most, _SEGMENT_BEND * size)
        t, length, before = progress.at[i], 1.0, count
        while t < 1.0 and count == before and not stopped(scene.stop):
            # Far away, the whole remaining way is tried first, then half of it ...
            length = min(max(length, segment), 1.0 - t)
            stop = 1.0 if t + length >= 1.0 - 1e-12 else t + length
            span = place_root_sphere(motion, t, avatar, units[i], scene, pose, shift, begin)
            span = max(span, place_root_sphere(motion, stop, avatar, units[i], scene, pose, shift, end))
            span += sagitta_of(motion, stop - t, scene)
            if entry_fraction(begin, end, span, tree.scene) < INFINITE:
                if length > segment * (1.0 + 1e-9):
                    length = length * 0.5
                    continue
                count = list_item(
                    tree, begin, end, span, 0.0, scene.stop, space.stack, lists.rows, lists.near, count
                )
            if count == before:
                t, length = stop, 2.0 * length
            else:
                progress.end[i] = stop
                square = 0.0
                for r in range(3):
                    square += (end[r] - begin[r]) ** 2
                progress.way[i] = math.sqrt(square)
        moved[number] = t
    if stopped(scene.stop):
        return -1
    for n in range(next_start, starts.shape[0]):
        starts[n] = count
    if count <= lists.rows.shape[0]:
        for number in range(which.shape[0]):
            progress.at[which[number]] = moved[number]
    return count


@nb.njit(nogil=True, cache=True)
def find_unknown_regions(box, first, last, avatar, units, scene, tree, until, outside, unknown_from):
    """Find where motions leave the scene's bounds or meet unknown boxes, for each over [0, until].

    Writes outside (k,) bool, whether the reach leaves the scene's bounds, and unknown_from (k,)
    float64, the fraction at which it first meets the box of a scan that was left out;
    inf if it never does.
    The reach is the cube around the avatar's root sphere, as in `collide`, along chords; neither
    result depends on voxels. Once the scene's stop flag is set, motions are unknown from their
    beginning. `outside` is then examined only where a contact was found after a short way: such a
    contact may be exact, whatever is unknown.
    """
    pose, shift, begin, end = np.empty((4, 4)), np.empty(3), np.empty(3), np.empty(3)
    for i in range(first.shape[0]):
        motion = make_motion(first[i], last[i], box, scene.origin)
        outside[i], unknown_from[i] = False, INFINITE
        size = avatar_size(box, units[i])
        parts = int(min(1024.0, math.ceil(math.sqrt(motion.bend / size) * until[i]))) + 1
        parts = 1 if motion.bend == 0.0 else parts
        if stopped(scene.stop):
            unknown_from[i] = 0.0
            if until[i] >= 1.0 or parts > 2:
                continue
        for part in range(parts):
            t0, t1 = until[i] * part / parts, until[i] * (part + 1) / parts
            span = place_root_sphere(motion, t0, avatar, units[i], scene, pose, shift, begin)
            span = max(span, place_root_sphere(motion, t1, avatar, units[i], scene, pose, shift, end))
            span += sagitta_of(motion, t1 - t0, scene)
            for r in range(3):
                outside[i] |= min(begin[r], end[r]) - span < tree.scene[0, r]
                outside[i] |= max(begin[r], end[r]) + span > tree.scene[1, r]
            for u in range(tree.unknown.shape[0]):
                met = entry_fraction(begin, end, span, tree.unknown[u])
                if met < INFINITE:
                    unknown_from[i] = min(unknown_from[i], max(0.0, t0 + met * (t1 - t0) - 2.0**-52))
