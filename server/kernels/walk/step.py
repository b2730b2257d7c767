"""Climb a step; see effects/motion_effects.py."""

import numpy as np

from ....schemas.runtime import compiling as nb
from ..motion.sweep_resident import MIN_MOTION
from .ground import DEAD_BAND, lower_by, move_by, search_below
from .motions import keep_rest, move_to
from .queries import pair_of
from .state import blocked_pose, pose_now
from .walk_vectors import copy_pose, divided, dot, lowest_height, minus, norm, place_of, times, vector

# The climb must lead this much farther than sliding [m], and by this share of the remainder.
MIN_CLIMB_GAIN, MIN_CLIMB_GAIN_SHARE = 2e-4, 0.02
# If sliding led along this share of the motion command, only its first obstacle may be a step.
SLID_SHARE = 0.5


@nb.njit(nogil=True, cache=True)
def step_up(walk):
    """Climb the obstacle that stopped the motion command, if possible."""
    memory, settings, state = walk.memory, walk.settings[0], walk.memory.state[0]
    up, hit = vector(settings.up), state.blocked
    if hit < 0 or not memory.before[0].stood or not memory.tape[hit].has_pair:
        return
    begin = place_of(memory.begin)
    command = minus(place_of(memory.target), begin)
    length = norm(command)
    if length < MIN_MOTION:
        return
    along = divided(command, length)
    so_far = dot(minus(place_of(pose_now(walk)), begin), along)
    feet = lowest_height(walk.avatar.points, walk.avatar.radius, blocked_pose(walk), up)
    top = feet + settings.step
    low = _is_low(walk, hit, top)
    if not so_far > SLID_SHARE * length:
        # Beside a wall that is touched first, a step is touched while sliding.
        for n in range(state.hits):
            low |= _is_low(walk, memory.hits[n].row, top)
    least = so_far + max(MIN_CLIMB_GAIN, MIN_CLIMB_GAIN_SHARE * (length - so_far))
    if not low or least >= length:  # walls
        return
    before, hits, verdict = np.empty((4, 4)), state.hits, state.verdict
    copy_pose(pose_now(walk), before)
    move_to(walk, blocked_pose(walk))
    climbed, rose = _climb(walk, along, length, least)
    if climbed:
        state.stepped = max(rose, 0.0)
        keep_rest(walk, rose)
    else:
        move_to(walk, before)
        state.verdict = verdict
    state.hits = hits


@nb.njit(nogil=True, cache=True)
def _is_low(walk, hit, top):
    """Return whether a hit is at most at the height `top` [m], or without a place it is not."""
    if not walk.memory.tape[hit].has_pair:
        return False
    _, cloud = pair_of(walk, hit)
    return not dot(cloud, vector(walk.settings[0].up)) > top


@nb.njit(nogil=True, cache=True)
def _climb(walk, along, length, least):
    """Move up, forward and down from the frame's pose.

    along: unit vector, horizontal direction.  length: [m].  least: least gain along it [m].
    Return whether the motion ends on ground that is not too high, and the height gained [m].
    """
    settings, begin = walk.settings[0], place_of(walk.memory.begin)
    up, start = vector(settings.up), place_of(pose_now(walk))
    move_by(walk, times(settings.step, up), False)  # sliding avoids the bumps of the riser
    rose = dot(minus(place_of(pose_now(walk)), start), up)
    if rose < MIN_MOTION:
        return False, rose
    gone = dot(minus(place_of(pose_now(walk)), begin), along)
    move_by(walk, times(length - gone, along), True)  # along a jamb beside the step
    if dot(minus(place_of(pose_now(walk)), begin), along) < least:
        return False, rose
    below = search_below(walk, rose + 2.0 * settings.clearance, False, -1)
    if not below.stands:
        return False, rose
    lower = below.free - settings.clearance
    if rose - lower > settings.step + DEAD_BAND:
        return False, rose
    lower_by(walk, below, lower)
    # Sliding down along a surface may have moved the avatar back.
    if dot(minus(place_of(pose_now(walk)), begin), along) < least:
        return False, rose
    return True, dot(minus(place_of(pose_now(walk)), start), up)
