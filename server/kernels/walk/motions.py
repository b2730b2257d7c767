"""Motions of a walking avatar: as far as nothing is touched.

With the effect `sweep`, a motion stops the skin before the first contact, at a pose that is clear by
`collide`. The sweep proves the pose clear if the pose is one of the sweep's bit for bit; otherwise
`collide` is queried. Without `sweep`, a motion leads to its end or nowhere.
"""

import numpy as np

from ....schemas.runtime import compiling as nb
from ..motion.sweep_resident import MIN_MOTION, skin_fraction
from .queries import (
    farthest_motion,
    first_hit,
    gives_way,
    hit_at,
    is_clear,
    keep_point,
    motion_left,
    pair_of,
    pose_on_way,
    touching_point,
)
from .state import CLEAR, CONTACT, UNKNOWN, blocked_pose, pose_now
from .walk_vectors import copy_pose, same_pose, vector

# First step back from a pose that turns out not to be clear [m], and its growth factor.
FIRST_STEP_BACK, STEP_GROWTH = 1e-7, 4.0
# Limit of pushes of bodies in one motion.
MAX_PUSHES = 4


@nb.njit(nogil=True, cache=True)
def move_to(walk, pose):
    """Set the frame's pose (4, 4)."""
    copy_pose(pose, pose_now(walk))


@nb.njit(nogil=True, cache=True)
def record_hit(walk, hit, to):
    """Record the hit that ended a motion to a pose (4, 4)."""
    memory = walk.memory
    result, state = memory.tape[hit], memory.state[0]
    if result.unloaded:
        result.rest = motion_left(walk, to)
    memory.hits[state.hits].row, memory.hits[state.hits].has_normal = hit, False
    state.hits += 1
    if result.verdict == UNKNOWN and state.verdict == CLEAR:
        state.verdict = UNKNOWN


@nb.njit(nogil=True, cache=True)
def settle_before(walk, to, fraction, proved):
    """Move to the pose at `fraction` of the way to a pose (4, 4), or to a clear one before it.

    proved: fraction before which nothing touches. The avatar stays if the way is shorter than
    MIN_MOTION.
    """
    begin, pose = pose_now(walk), np.empty((4, 4))
    way, back = farthest_motion(walk, begin, to), 0.0
    while (fraction - back) * way >= MIN_MOTION:
        same = pose_on_way(walk, begin, to, fraction - back, pose)
        if is_clear(walk, pose, same and fraction - back < proved):
            move_to(walk, pose)
            return
        back = max(STEP_GROWTH * back, FIRST_STEP_BACK / way)


@nb.njit(nogil=True, cache=True)
def _skin_share(walk, to, hit):
    """Return the share of the motion to a pose (4, 4) by which to stop before a hit, to keep the skin."""
    skin, begin, result = walk.settings[0].skin, pose_now(walk), walk.memory.tape[hit]
    way = farthest_motion(walk, begin, to)
    if way <= 0.0 or skin <= 0.0:
        return 0.0
    if not result.has_pair:
        return skin / way
    point = vector(result.point) if result.has_point else touching_point(walk, to, hit)
    own, cloud = pair_of(walk, hit)
    return skin_fraction(begin, to, own, cloud, point, way, skin)


@nb.njit(nogil=True, cache=True)
def advance(walk, to):
    """Move towards a pose (4, 4) as far as nothing is touched; return the hit that ended the motion."""
    memory, hit = walk.memory, -1
    leaves = memory.state[0].verdict == CONTACT  # the frame began in contact
    if not (walk.settings[0].continuous or leaves):
        return _move_if_clear(walk, to)
    for _ in range(MAX_PUSHES):
        if same_pose(pose_now(walk), to):
            return -1
        hit = first_hit(walk, to, walk.settings[0].tolerance, walk.settings[0].skin, False)
        if hit < 0:
            move_to(walk, to)
            return -1
        result = memory.tape[hit]
        if result.has_end and (leaves or not walk.bodies):
            end = np.empty((4, 4))
            copy_pose(result.end, end)
            if not walk.bodies or is_clear(walk, end, True):
                move_to(walk, end)
        else:
            keep_point(walk, to, hit)
            fraction = result.lower
            settle_before(walk, to, fraction - _skin_share(walk, to, hit), fraction)
        if not gives_way(walk, hit, to):
            break
    record_hit(walk, hit, to)
    return hit


@nb.njit(nogil=True, cache=True)
def _move_if_clear(walk, to):
    """Move to a pose (4, 4) if nothing is touched there; otherwise return the hit."""
    if same_pose(pose_now(walk), to):
        return -1
    memory = walk.memory
    hit = hit_at(walk, to)
    if hit >= 0 and gives_way(walk, hit, to):
        hit = hit_at(walk, to)
    if hit < 0:
        move_to(walk, to)
        memory.state[0].clear = True
        if memory.state[0].verdict == CONTACT:
            memory.state[0].verdict = CLEAR
        return -1
    memory.tape[hit].lower = 1.0
    keep_point(walk, to, hit)
    memory.tape[hit].lower = 0.0
    record_hit(walk, hit, to)
    return hit


@nb.njit(nogil=True, cache=True)
def follow_command(walk):
    """Move towards the commanded pose."""
    memory = walk.memory
    hit = advance(walk, memory.target)
    if hit >= 0 and memory.state[0].verdict == CONTACT:
        hit = _move_before_turn(walk, hit)
    memory.state[0].blocked = hit
    if hit >= 0:
        copy_pose(pose_now(walk), blocked_pose(walk))
    keep_rest(walk, 0.0)


@nb.njit(nogil=True, cache=True)
def _move_before_turn(walk, hit):
    """Follow a motion command of an avatar in contact: move first, then turn.

    hit: that of the whole motion. Returns the hit that ends the motion, -1 for none.
    """
    target, moved = walk.memory.target, pose_now(walk).copy()
    turns = False
    for r in range(3):
        moved[r, 3] = target[r, 3]
        for c in range(3):
            turns |= moved[r, c] != target[r, c]
    if not turns:
        return hit
    walk.memory.state[0].hits -= 1
    hit = advance(walk, moved)
    return hit if hit >= 0 else advance(walk, target)


@nb.njit(nogil=True, cache=True)
def keep_rest(walk, rose):
    """Record what is left of the motion command, after a climb by `rose` [m]."""
    memory = walk.memory
    target, pose = memory.target, pose_now(walk)
    left = memory.state[0].left
    for r in range(3):
        left[r] = target[r, 3] + rose * walk.settings[0].up[r] - pose[r, 3]
