"""Motions through a scene, by segments: the part of a motion advanced at a time, the voxels that it
reaches, and the conservative advancement along it (sweep_interval.py).
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ....schemas.archive.units import UNITS_PER_METRE
from ....schemas.runtime import compiling as nb
from ..core.kernel_decorators import njit_no_refcount
from ..core.placed_avatar import largest_term, to_units
from ..core.reach import INFINITE, MISSING, NOT_HELD, REACH_STACK, entry_fraction, list_item, state_of
from ..core.scene_arrays import stopped
from .moving_avatar import AvatarSweep
from .screw_motion import make_motion, pose_at
from .sweep_interval import found_pair, pair_point, search, touches_at
from .vector_tuples import divided, minus, norm, place_of, placed, plus, point_of, put, times, vector

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
    """Scratch of `plan_segments`: pose, two positions, and that of `list_item`."""

    pose: NDArray[np.float64]
    begin: NDArray[np.float64]
    end: NDArray[np.float64]
    stack: NDArray[np.int64]


@nb.njit(nogil=True, cache=True)
def make_plan_space():
    """Allocate a `PlanSpace`."""
    return PlanSpace(np.empty((4, 4)), np.empty(3), np.empty(3), np.empty(REACH_STACK, np.int64))


@njit_no_refcount
def avatar_size(box, units):
    """Return the size of an avatar with its reach, across [m].

    The result does not depend on the order of its points or on its tree.
    """
    return norm(minus(box[1], box[0])) + 2.0 * np.float64(units) / UNITS_PER_METRE + 1e-6


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
def _place_root(motion, t, avatar, units, scene, pose, center):
    """Place the avatar's root sphere under M(t): center (3,) [steps]; pose is scratch.

    Returns the radius with the reach, widened as in `voxels_in_reach`; a motion that stands still
    therefore reaches what a pose reaches.
    """
    pose_at(motion, t, pose)
    root, shift = vector(avatar.center[0]), minus(place_of(pose), scene.origin)
    put(center, divided(placed(pose, shift, root), scene.step))
    span = (avatar.radius[0] / scene.step + units / scene.units_per_step) * (1.0 + 1e-6) + 1.0
    return span + largest_term(pose, shift, root[0], root[1], root[2]) / scene.step * 2.0**-49


@njit_no_refcount
def _reach_of_part(motion, t0, t1, avatar, units, scene, space):
    """Write the avatar's places at both ends of a part of a motion to space.begin and end [steps].

    Returns the radius of its reach from the chord between them. It includes how far points stray
    from their chords, which is 0 for a motion that stands still.
    """
    span = _place_root(motion, t0, avatar, units, scene, space.pose, space.begin)
    span = max(span, _place_root(motion, t1, avatar, units, scene, space.pose, space.end))
    length = t1 - t0
    if motion.speed == 0.0:
        return span
    return (
        span + (motion.bend * length * length / 8.0 + 4.0 * motion.slip + 2.0 / UNITS_PER_METRE) / scene.step
    )


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
    begin, end, starts = space.begin, space.end, lists.starts
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
            span = _reach_of_part(motion, t, stop, avatar, units[i], scene, space)
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
                progress.end[i], progress.way[i] = stop, norm(minus(end, begin))
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
def find_unknown_regions(box, first, last, avatar, units, scene, tree, until, space, outside, unknown_from):
    """Find where motions leave the scene's bounds or meet unknown boxes, for each over [0, min(until, 1)].

    Writes outside (k,) bool, whether the reach leaves the scene's bounds, and unknown_from (k,)
    float64, the fraction at which it first meets the box of a scan that was left out;
    inf if it never does.
    The reach is the cube around the avatar's root sphere, as in `collide`, along chords; neither
    result depends on voxels. Once the scene's stop flag is set, motions are unknown from their
    beginning; `outside` is then examined only where a contact was found, which may be exact, whatever is
    unknown. until: (k,), inf where no contact was found.  space: scratch.
    """
    begin, end = space.begin, space.end
    for i in range(first.shape[0]):
        motion = make_motion(first[i], last[i], box, scene.origin)
        outside[i], unknown_from[i] = False, INFINITE
        if stopped(scene.stop):
            unknown_from[i] = 0.0
            if until[i] == INFINITE:
                continue
        size, most = avatar_size(box, units[i]), min(until[i], 1.0)
        parts = int(min(1024.0, math.ceil(math.sqrt(motion.bend / size) * most))) + 1
        parts = 1 if motion.bend == 0.0 else parts
        for part in range(parts):
            t0, t1 = most * part / parts, most * (part + 1) / parts
            span = _reach_of_part(motion, t0, t1, avatar, units[i], scene, space)
            for r in range(3):
                outside[i] |= min(begin[r], end[r]) - span < tree.scene[0, r]
                outside[i] |= max(begin[r], end[r]) + span > tree.scene[1, r]
            for u in range(tree.unknown.shape[0]):
                met = entry_fraction(begin, end, span, tree.unknown[u])
                if met < INFINITE:
                    unknown_from[i] = min(unknown_from[i], max(0.0, t0 + met * (t1 - t0) - 2.0**-52))


# Sagitta of a first chord, in avatar sizes: spheres grow by it.
CHORD_BEND = 1.0 / 16.0
# Advances of one segment that settled nothing. Beyond this number, undecided parts stay undecided.
# A full turn 1 um from a wall all the way takes some hundreds.
MAX_REFUSED = 512


@nb.njit(nogil=True, cache=True)
def advance_segments(
    box, first, last, avatar, units, scene, lists, which, cursor, state, tolerance, scratch, progress, counts
):  # fmt: skip
    """Advance the motions numbered in `which` along their segments, each through voxels from its cursor on.

    box, first, last, units: as in `plan_segments`.  lists: the voxels of each motion's segment.
    cursor, state: as in `collide_poses`.  tolerance: [m].  scratch: `make_scratch` of the avatar.
    Lowers progress.lower and upper, sets a witness with upper, of equal ones the first by
    NUMERICS.md N11, and adds to counts (4, k): voxels missing, node visits, point tests, advances.
    A missing voxel makes the motion unknown from where the root sphere's cube reaches it, or from
    progress.floor on if that is later. Once the scene's stop flag is set, motions are not finished.
    """
    moving, rows, near = scratch.moving, lists.rows, lists.near
    for number in range(which.shape[0]):
        i = which[number]
        at, until = cursor[i], lists.starts[i + 1]
        if stopped(scene.stop):
            progress.lower[i] = min(progress.lower[i], progress.at[i])
            continue
        motion = make_motion(first[i], last[i], box, scene.origin)
        t0, t1 = progress.at[i], progress.end[i]
        begin, gap = at, INFINITE
        while at < until and state_of(state, rows[at]) != NOT_HELD:
            if state_of(state, rows[at]) == MISSING:
                counts[0, i] += np.uint32(1)
                gap = min(gap, near[at] / progress.way[i] if progress.way[i] > 0.0 else 0.0)
            at += 1
        moving.counters[0], moving.counters[1] = 0, 0
        sweep = AvatarSweep(motion, avatar, scene, moving, np.int64(units[i]))
        size = avatar_size(box, units[i])
        lower, upper, steps = _advance(
            sweep, t0, t1, progress.upper[i], rows[begin:at], state, size, tolerance
        )
        if gap < INFINITE:
            lower = min(lower, max(t0, t0 + gap * (t1 - t0) - 2.0**-52, progress.floor[i]))
        progress.lower[i] = min(progress.lower[i], lower)
        if upper < INFINITE and upper <= progress.upper[i]:
            _name_witness(sweep, upper, upper == progress.upper[i], progress.witness[i])
            progress.upper[i] = upper
        counts[1, i] += np.uint32(moving.counters[0])
        counts[2, i] += np.uint32(moving.counters[1])
        counts[3, i] += np.uint32(steps)
        if not stopped(scene.stop):
            cursor[i] = at


@njit_no_refcount
def _advance(sweep, start, stop, known, rows, state, size, tolerance):
    """Advance one motion over [start, stop] through some voxels. Return (lower, upper, advances).

    Nothing touches in [start, lower). upper: a contact, confirmed by the integers; inf when none
    was found. lower is `stop` when nothing touches in [start, stop]. A graze fixes lower; the part
    after it is still searched for contacts. known: the earliest contact with other voxels, inf: none;
    the search ends beyond it, and its intervals are the same without it.

    Each round searches [t, after]. `since` is the first fraction at which something may touch,
    `sure` one at which the integers confirm contact. If nothing may touch, t moves to `after` and
    the next interval is longer. Otherwise t moves to `since` and the next interval is shorter;
    `refused` counts these rounds. `lower` is -1 until it is fixed.
    """
    motion, moving = sweep.motion, sweep.moving
    t, lower, upper, refused, steps = start, -1.0, INFINITE, 0, 0
    best = moving.best
    still, begun = motion.speed == 0.0, False
    longest = longest_part(motion, size, CHORD_BEND * size)
    length = longest
    while True:
        after = stop if t + length >= stop else t + length
        steps += 1
        whole, final = search(sweep, t, after, rows, state)
        earliest_possible, earliest_certain = moving.first[0], moving.first[1]
        if final and earliest_certain == 0.0 and after > t:
            # The search ended at the first pair it met that touches at t.
            search(sweep, t, t, rows, state)
        elif earliest_possible == 0.0 and not final:
            # It ended at the first pair it met that may touch at t: in another tree, another pair.
            earliest_certain = INFINITE
            if t == 0.0 and not begun:
                begun = True
                search(sweep, t, t, rows, state)
                earliest_certain = moving.first[1]
        sure = INFINITE
        if earliest_certain < INFINITE:
            sure = after if earliest_certain >= 1.0 else min(after, t + earliest_certain * (after - t))
            if touches_at(sweep, sure, found_pair(moving)):
                upper, stop = sure, sure
                for n in range(6):
                    best[n] = moving.pair[n]
            else:  # the proof requires contact; without it nothing is claimed
                sure, earliest_possible = INFINITE, 0.0
        since = t
        if earliest_possible < INFINITE:
            since = max(t, t + earliest_possible * (after - t) - 2.0**-52)
        if not whole or refused > MAX_REFUSED:
            lower = t if lower < 0.0 else lower
            if not whole:
                break
        if sure < INFINITE:
            if lower >= 0.0 or final or motion.speed * (sure - since) <= tolerance:
                lower = since if lower < 0.0 else lower
                break
            length = max(min(sure - since, 0.5 * (after - t)), 2.0**-52)
            t, refused = since, refused + 1
        elif earliest_possible == INFINITE or still:
            t, length = after, 2.0 * length
        elif final or refused > MAX_REFUSED:
            lower = since if lower < 0.0 else lower
            t, refused = after, refused + 1
            length = 2.0 * length if refused <= MAX_REFUSED else longest
        else:
            length = max(0.25 * (after - t), 2.0**-52)
            t, refused = since, refused + 1
        if t >= stop or t > known:
            break
    for n in range(6):
        moving.pair[n] = best[n]
    return (t if lower < 0.0 else lower), upper, steps


@njit_no_refcount
def _name_witness(sweep, t, equal, witness):
    """Write the centres (2, 3) of moving.pair under M(t), world [m]: the avatar's, then the scan's.

    equal: whether the pair in `witness` touches at the same moment. NUMERICS.md N11 then decides.
    """
    scene, pair, pose = sweep.scene, found_pair(sweep.moving), sweep.moving.pose
    pose_at(sweep.motion, t, pose)
    point = point_of(sweep.avatar.points, pair[0], pair[1])
    x, y, z = placed(pose, minus(place_of(pose), scene.origin), point)
    units = to_units(x), to_units(y), to_units(z)
    own = plus(divided(units, UNITS_PER_METRE), scene.origin)
    cloud = plus(times(scene.step, pair_point(scene, pair)), scene.origin)
    if not equal or cloud + own < vector(witness[1]) + vector(witness[0]):
        put(witness[0], own)
        put(witness[1], cloud)
