"""Segments of motions: the part of a motion advanced at a time, and the voxels that it reaches."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ....schemas.archive.units import UNITS_PER_METRE
from ....schemas.archive.voxel_grid import KEY_BIAS
from ....schemas.kernels import compiling as nb
from ....schemas.kernels.morton import morton_code
from ..core.kernel_decorators import njit_no_refcount
from ..core.placed_avatar import largest_term, place
from ..core.scene_arrays import stopped
from ..core.voxels_in_reach import find_key, grid_high, grid_low
from .contact_times import INFINITE
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
    """

    at: NDArray[np.float64]
    end: NDArray[np.float64]
    lower: NDArray[np.float64]
    upper: NDArray[np.float64]
    speed: NDArray[np.float64]
    witness: NDArray[np.float64]


class PlanSpace(NamedTuple):
    """Scratch of `plan_segments`: pose, shift, two positions, and the range of cells (2, 3)."""

    pose: NDArray[np.float64]
    shift: NDArray[np.float64]
    begin: NDArray[np.float64]
    end: NDArray[np.float64]
    cells: NDArray[np.int64]


@nb.njit(nogil=True, cache=True)
def make_plan_space():
    """Allocate a `PlanSpace`."""
    return PlanSpace(np.empty((4, 4)), np.empty(3), np.empty(3), np.empty(3), np.empty((2, 3), np.int64))


@nb.njit(nogil=True, cache=True)
def avatar_box(avatar):
    """Return the least and greatest coordinates (2, 3) of an avatar's points, not empty [m]."""
    box = np.empty((2, 3))
    for r in range(3):
        least, most = avatar.points[0, r, 0], avatar.points[0, r, 0]
        for block in range(avatar.points.shape[0]):
            for j in range(avatar.points.shape[2]):
                least = min(least, avatar.points[block, r, j])
                most = max(most, avatar.points[block, r, j])
        box[0, r], box[1, r] = least, most
    return box


@njit_no_refcount
def avatar_size(box, scale, units):
    """Return the size of an avatar with its reach, across [m].

    The result does not depend on the order of its points or on its tree.
    """
    square = 0.0
    for r in range(3):
        square += (box[1, r] - box[0, r]) ** 2
    return math.sqrt(square) * scale + 2.0 * np.float64(units) / UNITS_PER_METRE + 1e-6


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
def place_root_sphere(motion, t, avatar, scale, units, scene, pose, shift, center):
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
    span = (avatar.radius[0] * scale / scene.step + units / scene.units_per_step) * (1.0 + 1e-6) + 1.0
    return span + largest_term(pose, shift, x, y, z) / scene.step * 2.0**-49


@njit_no_refcount
def sagitta_of(motion, length, scene):
    """Return how far points stray from their chords on a part of the motion, at most [steps].

    0 for a motion that stands still.
    """
    if motion.speed == 0.0:
        return 0.0
    return (motion.bend * length * length / 8.0 + 4.0 * motion.slip + 2.0 / UNITS_PER_METRE) / scene.step


@njit_no_refcount
def entry_fraction(begin, end, span, low, high):
    """Return the fraction at which a moving cube (half edge span) first meets the box [low, high].

    begin, end: (3,), its centre. Rounded down; inf if it does not meet the box.
    """
    least, most = 0.0, 1.0
    for r in range(3):
        displacement = end[r] - begin[r]
        near, far = np.float64(low[r]) - span - begin[r], np.float64(high[r]) + span - begin[r]
        if displacement == 0.0:
            if near > 0.0 or far < 0.0:
                return INFINITE
            continue
        first, last = near / displacement, far / displacement
        if displacement < 0.0:
            first, last = last, first
        # near and far are rounded to 2^-52 of terms; `span` is wider than necessary by that much
        # (voxels_in_reach).
        least, most = max(least, first), min(most, last)
    if least > most * (1.0 + 1e-12) + 1e-12:
        return INFINITE
    return max(0.0, least - 1e-9)


@njit_no_refcount
def _still_near(center, span, low, high):
    """Return whether a ball touches a voxel's box, by the test of voxels_in_reach."""
    square = 0.0
    for r in range(3):
        gap = max(np.float64(low[r]) - center[r], center[r] - np.float64(high[r]), 0.0)
        square += gap * gap
    return square <= span * span


@njit_no_refcount
def _list_rows(span, still, scene, index, space, rows, count):
    """Append the voxels that a moving cube meets to rows, from `count` on.

    It moves from space.begin to space.end. Returns the new count, which may exceed the capacity.
    """
    begin, end, first, last = space.begin, space.end, space.cells[0], space.cells[1]
    cells = 1.0
    for r in range(3):
        least = max(min(begin[r], end[r]) - span, grid_low(index.scene_low[r], scene.voxel_steps))
        most = min(max(begin[r], end[r]) + span, grid_high(index.scene_high[r], scene.voxel_steps))
        if least > most:
            return count
        first[r] = np.int64(math.floor(least / scene.voxel_steps))
        last[r] = np.int64(math.floor(most / scene.voxel_steps))
        cells *= np.float64(last[r] - first[r] + 1)
    listed = cells > index.keys.shape[0]
    side_y, side_z = last[1] - first[1] + 1, last[2] - first[2] + 1
    total = index.keys.shape[0] if listed else (last[0] - first[0] + 1) * side_y * side_z
    for n in range(total):
        if stopped(scene.stop):
            return count
        row = n
        if not listed:
            ix, iy, iz = (
                first[0] + n // (side_y * side_z),
                first[1] + n // side_z % side_y,
                first[2] + n % side_z,
            )
            row = find_key(
                index.keys,
                morton_code(np.uint64(ix + KEY_BIAS), np.uint64(iy + KEY_BIAS), np.uint64(iz + KEY_BIAS)),
            )
            if row < 0:
                continue
        low, high = index.low[row], index.high[row]
        if entry_fraction(begin, end, span, low, high) == INFINITE or (
            still and not _still_near(begin, span, low, high)
        ):
            continue
        if count < rows.shape[0]:
            rows[count] = row
        count += 1
    return count


@nb.njit(nogil=True, cache=True)
def plan_segments(box, first, last, avatar, scales, units, scene, index, which, progress, starts, rows):
    """Plan the next segment of each motion in `which` that reaches any voxel, and list its voxels.

    box: `avatar_box`.  first, last: (k, 4, 4), checked.  scales, units: (k,), the larger value of
    the two ends.
    Reads progress.at and advances it to the start of the segment; everything before is out of reach
    of all voxels. Writes end and speed. `at` becomes 1 for a motion with nothing left in reach,
    which gets no rows. Fills starts (k + 1,) and rows (capacity,) int64, with no rows for motions
    not in `which` (ascending).
    Returns the number of rows; those beyond the capacity are not written, and progress.at is then
    unchanged. Returns -1, with progress.at unchanged, when the scene's stop flag is set.
    """
    return plan_in_space(
        box, first, last, avatar, scales, units, scene, index, which, progress, starts, rows, make_plan_space(),
        np.empty(which.shape[0]),
    )  # fmt: skip


@nb.njit(nogil=True, cache=True)
def plan_in_space(
    box, first, last, avatar, scales, units, scene, index, which, progress, starts, rows, space, moved
):
    """Do the work of `plan_segments`. moved: (w,) float64, one for each of `which`; scratch."""
    pose, shift, begin, end = space.pose, space.shift, space.begin, space.end
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
        size = avatar_size(box, scales[i], units[i])
        most = min(_SEGMENT_SIZES * size + _SEGMENT_MORE, _SEGMENT_STEPS * scene.step)
        segment = longest_part(motion, most, _SEGMENT_BEND * size)
        t, length, before = progress.at[i], 1.0, count
        while t < 1.0 and count == before and not stopped(scene.stop):
            # Far away, the whole remaining way is tried first, then half of it ...
            length = min(max(length, segment), 1.0 - t)
            stop = 1.0 if t + length >= 1.0 - 1e-12 else t + length
            span = place_root_sphere(motion, t, avatar, scales[i], units[i], scene, pose, shift, begin)
            span = max(
                span, place_root_sphere(motion, stop, avatar, scales[i], units[i], scene, pose, shift, end)
            )
            span += sagitta_of(motion, stop - t, scene)
            # Outside the scene's bounds there are only cells of voxels whose own bounds are not
            # proved.
            if (
                entry_fraction(begin, end, span, index.scene_low, index.scene_high) < INFINITE
                or _list_rows(span, motion.speed == 0.0, scene, index, space, rows, count) > count
            ):
                if length > segment * (1.0 + 1e-9):
                    length = length * 0.5
                    continue
                count = _list_rows(span, motion.speed == 0.0, scene, index, space, rows, count)
            if count == before:
                t, length = stop, 2.0 * length
            else:
                progress.end[i] = stop
        moved[number] = t
    if stopped(scene.stop):
        return -1
    for n in range(next_start, starts.shape[0]):
        starts[n] = count
    if count <= rows.shape[0]:
        for number in range(which.shape[0]):
            progress.at[which[number]] = moved[number]
    return count


@nb.njit(nogil=True, cache=True)
def find_unknown_regions(
    box, first, last, avatar, scales, units, scene, index, unknown, until, outside, unknown_from
):
    """Find where motions leave the scene's bounds or meet unknown boxes, for each over [0, until].

    Writes outside (k,) bool, whether the reach leaves the scene's bounds, and unknown_from (k,)
    float64, the fraction at which it first meets one of the boxes unknown (u, 2, 3) int64 [steps];
    inf if it never does.
    The reach is the cube around the avatar's root sphere, as in `collide`, along chords; neither
    result depends on voxels. Once the scene's stop flag is set, motions are unknown from their
    beginning.
    """
    pose, shift, begin, end = np.empty((4, 4)), np.empty(3), np.empty(3), np.empty(3)
    for i in range(first.shape[0]):
        motion = make_motion(first[i], last[i], box, scene.origin)
        outside[i], unknown_from[i] = False, INFINITE
        if stopped(scene.stop):
            unknown_from[i] = 0.0
            continue
        size = avatar_size(box, scales[i], units[i])
        parts = int(min(1024.0, math.ceil(math.sqrt(motion.bend / size) * until[i]))) + 1
        parts = 1 if motion.bend == 0.0 else parts
        for part in range(parts):
            t0, t1 = until[i] * part / parts, until[i] * (part + 1) / parts
            span = place_root_sphere(motion, t0, avatar, scales[i], units[i], scene, pose, shift, begin)
            span = max(
                span, place_root_sphere(motion, t1, avatar, scales[i], units[i], scene, pose, shift, end)
            )
            span += sagitta_of(motion, t1 - t0, scene)
            for r in range(3):
                outside[i] |= min(begin[r], end[r]) - span < index.scene_low[r]
                outside[i] |= max(begin[r], end[r]) + span > index.scene_high[r]
            for u in range(unknown.shape[0]):
                met = entry_fraction(begin, end, span, unknown[u, 0], unknown[u, 1])
                if met < INFINITE:
                    unknown_from[i] = min(unknown_from[i], max(0.0, t0 + met * (t1 - t0) - 2.0**-52))
