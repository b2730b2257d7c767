"""Conservative advancement of many motions through a scene, each along its current segment."""

import numpy as np

from ....schemas.archive.units import UNITS_PER_METRE
from ....schemas.runtime import compiling as nb
from ..core.kernel_decorators import njit_no_refcount
from ..core.placed_avatar import place, to_units
from ..core.reach import INFINITE, MISSING, NOT_HELD, state_of
from ..core.scene_arrays import stopped
from .contact_times import scan_coordinate, touches_at
from .moving_avatar import AvatarSweep
from .screw_motion import make_motion, pose_at
from .sweep_interval import search
from .sweep_segments import avatar_size, longest_part

# Sagitta of a first chord, in avatar sizes: spheres grow by it.
_CHORD_BEND = 1.0 / 16.0
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
    longest = longest_part(motion, size, _CHORD_BEND * size)
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
            if touches_at(sweep, sure, moving.pair):
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
    scene, moving, points = sweep.scene, sweep.moving, sweep.avatar.points
    pair = moving.pair
    pose_at(sweep.motion, t, moving.pose)
    x, y, z = points[pair[0], 0, pair[1]], points[pair[0], 1, pair[1]], points[pair[0], 2, pair[1]]
    for n in (1, 0):
        for r in range(3):
            if n == 1:
                value = np.float64(scan_coordinate(scene, pair, r)) * scene.step + scene.origin[r]
            else:
                moving.shift[r] = moving.pose[r, 3] - scene.origin[r]
                units = to_units(place(moving.pose, moving.shift, r, x, y, z))
                value = np.float64(units) / UNITS_PER_METRE + scene.origin[r]
            if equal:
                if value > witness[n, r]:
                    return
                equal = value == witness[n, r]
            witness[n, r] = value
