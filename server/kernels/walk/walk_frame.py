"""Parts of a user's frame in one call: the motion command, `slide`, `step` and `ground`."""

import numpy as np

from ....schemas.runtime import compiling as nb
from .ground import stand_on_ground
from .motions import follow_command
from .slide import slide_command
from .state import FOLLOW, GROUND, PARTS, SLIDE, STEP, Walk
from .step import step_up
from .walk_vectors import copy_pose


@nb.njit(nogil=True, cache=True)
def walk_frame(
    parts, starts, begin, target, pose, seconds, fell, stood, verdict, clear, settings, avatar, scratch, memory, held,
    stop, unknown_everywhere, alone, native, bodies, other_units, least_tolerance, tolerance_units, squares, bounds,
    kinds, bounds_origin, wanted, own, margin,
):  # fmt: skip
    """Run parts of a frame of one user, or raise AskedError for Python to answer a query.

    parts: bits of FOLLOW to GROUND.  starts: whether the frame begins; if not, the arguments up to
    `clear` are those of the first call.  begin, target, pose: (4, 4), where the frame began, the commanded
    pose, and the pose reached.  seconds: duration of the frame.  fell: speed of falling [m/s].
    stood: whether the avatar stood.  verdict: of the frame.  clear: whether `pose` is known to be clear.
    settings, memory: see state.py.  avatar: reference to its arrays.  scratch: of its motions.
    held: reference to the scene's arrays.  stop, unknown_everywhere, other_units: as for
    `sweep_resident`.  alone: whether the scene is one archive at the identity.  native: whether queries
    may be answered here: it is alone, and the avatar is small and not empty.  bodies: whether other bodies
    are obstacles.  least_tolerance, tolerance_units: of the frame's budget [m], [exact units].
    squares: (3,) int64, the normal reach, thrice and nine times that, squared [steps^2]; 0 if invalid.
    bounds, kinds, bounds_origin, wanted, own: of the bodies that may be in the way, as for
    `find_near_bodies`.  margin: distance to keep from them [m].
    """
    walk = Walk(
        settings, avatar, scratch, memory, held, stop, unknown_everywhere, alone, native, bodies,
        other_units, least_tolerance, tolerance_units, squares, bounds, kinds, bounds_origin, wanted,
        own, margin,
    )  # fmt: skip
    if memory.log[0].repeats:
        _copy(memory.saved_bytes, memory.bytes, memory.saved_poses, memory.poses)
    else:
        _clear_log(memory.log[0])
        if starts:
            _start(memory, begin, target, pose, seconds, fell, stood, verdict, clear)
        _copy(memory.bytes, memory.saved_bytes, memory.poses, memory.saved_poses)
    state = memory.state[0]
    if parts & FOLLOW:
        state.part = 0
        follow_command(walk)
    if parts & SLIDE:
        state.part = 1
        slide_command(walk)
    if parts & STEP:
        state.part = 2
        step_up(walk)
    if parts & GROUND:
        state.part = 3
        stand_on_ground(walk)


@nb.njit(nogil=True, cache=True)
def _clear_log(log):
    """Clear what a call counts anew."""
    log.used, log.missed, log.apart = 0, False, 0
    for part in range(PARTS):
        log.visits[part] = 0


@nb.njit(nogil=True, cache=True)
def _start(memory, begin, target, pose, seconds, fell, stood, verdict, clear):
    """Write the state of a frame at its beginning, but for its hits, which are on the tape."""
    before, state, known = memory.before[0], memory.state[0], memory.log[0].known
    copy_pose(begin, memory.begin)
    copy_pose(target, memory.target)
    copy_pose(pose, memory.poses[0])
    before.seconds, before.fall_speed, before.stood = seconds, fell, stood
    memory.bytes[:] = 0
    state.row, state.hits = known, known
    for n in range(known):
        memory.hits[n].row, memory.hits[n].has_normal = n, False
    state.blocked, state.verdict, state.clear, state.stepped = -1, verdict, clear, np.nan


@nb.njit(nogil=True, cache=True)
def _copy(values, to_values, poses, to_poses):
    """Save what a part changes, or restore it. Hits are restored by their number."""
    for n in range(values.shape[0]):
        to_values[n] = values[n]
    for n in range(poses.shape[0]):
        copy_pose(poses[n], to_poses[n])
