"""Parts of a user's frame in one call: the motion command, `slide`, `step` and `ground`."""

import numpy as np

from ....schemas.kernels import compiling as nb
from ..motion.sweep_resident import make_scratch
from .slide_along import slide_command
from .stand_on_ground import stand_on_ground
from .step_up import step_up
from .walk_motions import follow_command
from .walk_state import (
    AT,
    BEGIN,
    BLOCKED,
    FELL,
    FOLLOW,
    FRAME_VERDICT,
    GROUND,
    HITS,
    IS_CLEAR,
    KNOWN,
    PART,
    POSE,
    POSES,
    REPEATS,
    SECONDS,
    SLIDE,
    STEP,
    STEPPED,
    STOOD,
    TARGET,
    USED,
    Walk,
)
from .walk_vectors import copy_pose


@nb.njit(nogil=True, cache=True)
def walk_frame(
    parts, starts, begin, target, pose, seconds, fell, stood, verdict, clear, settings, avatar, memory, held, stop,
    unknown_everywhere, alone, native, bodies, other_units, least_tolerance, tolerance_units, squares,
    standing, own,
):  # fmt: skip
    """Run parts of a frame of one user, or raise AskedError for Python to answer a query.

    parts: bits of FOLLOW to GROUND.  starts: whether the frame begins; if not, the arguments up to
    `clear` are those of the first call.  begin, target, pose: (4, 4), where the frame began, the commanded
    pose, and the pose reached.  seconds: duration of the frame.  fell: speed of falling [m/s].
    stood: whether the avatar stood.  verdict: of the frame.  clear: whether `pose` is known to be clear.
    settings, avatar, memory: references, see walk_state.py.
    held: reference to the scene's arrays.  stop, unknown_everywhere, other_units: as for
    `sweep_resident`.  alone: whether the scene is one archive at the identity.  native: whether queries
    may be answered here: it is alone, and the avatar is small and not empty.  bodies: whether other bodies
    are obstacles.  least_tolerance, tolerance_units: of the frame's budget [m], [exact units].
    squares: (3,) int64, the normal reach, thrice and nine times that, squared [steps^2]; 0 if invalid.
    standing: the bodies that may be in the way, see walk_bodies.py; None in a scene without `crowd`.
    own: the avatar's row of them, -1 if it has none; ASKS if Python answers about bodies.
    """
    walk = Walk(
        settings, avatar, make_scratch(avatar.avatar), memory, held, stop, unknown_everywhere, alone, native, bodies,
        other_units, least_tolerance, tolerance_units, squares, standing, own,
    )  # fmt: skip
    log = memory.log
    if log[REPEATS] != 0:
        _copy_state(memory, memory.saved_numbers, memory.numbers, memory.saved_values, memory.values, False)
    else:
        for n in range(USED, log.shape[0]):
            log[n] = 0
        if starts:
            _start(memory, begin, target, pose, seconds, fell, stood, verdict, clear)
        _copy_state(memory, memory.numbers, memory.saved_numbers, memory.values, memory.saved_values, True)
    if parts & FOLLOW:
        memory.numbers[PART] = 0
        follow_command(walk)
    if parts & SLIDE:
        memory.numbers[PART] = 1
        slide_command(walk)
    if parts & STEP:
        memory.numbers[PART] = 2
        step_up(walk)
    if parts & GROUND:
        memory.numbers[PART] = 3
        stand_on_ground(walk)


@nb.njit(nogil=True, cache=True)
def _start(memory, begin, target, pose, seconds, fell, stood, verdict, clear):
    """Write the state of a frame at its beginning, but for its hits, which are on the tape."""
    numbers, inputs = memory.numbers, memory.inputs
    copy_pose(begin, memory.poses[BEGIN])
    copy_pose(target, memory.poses[TARGET])
    copy_pose(pose, memory.poses[POSE])
    inputs[SECONDS], inputs[FELL], inputs[STOOD] = seconds, fell, 1.0 if stood else 0.0
    known = memory.log[KNOWN]
    for n in range(numbers.shape[0]):
        numbers[n] = 0
    numbers[AT] = numbers[HITS] = known
    for n in range(known):
        memory.hits[n], memory.normals[n, 0] = n, 0.0
    numbers[BLOCKED], numbers[FRAME_VERDICT], numbers[IS_CLEAR] = -1, verdict, 1 if clear else 0
    memory.values[STEPPED] = np.nan


@nb.njit(nogil=True, cache=True)
def _copy_state(memory, numbers, to_numbers, values, to_values, saves):
    """Save what a part changes, or restore it. Hits are restored by their number."""
    for n in range(numbers.shape[0]):
        to_numbers[n] = numbers[n]
    for n in range(values.shape[0]):
        to_values[n] = values[n]
    for n in range(POSE, POSES):
        if saves:
            copy_pose(memory.poses[n], memory.saved_poses[n])
        else:
            copy_pose(memory.saved_poses[n], memory.poses[n])
