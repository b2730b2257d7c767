"""Meaning of motion commands: how long a frame lasts, and to which pose it leads."""

import math
from collections.abc import Callable
from dataclasses import fields, replace
from typing import TYPE_CHECKING

import msgspec
import numpy as np

from ...schemas.archive.rigid_pose import check_rigid
from ...schemas.errors import UnknownAvatarError
from ...schemas.scene.scene_file import Spawn
from ...schemas.wire.motion_messages import FRAME_SECONDS, Moved, Wish
from .world.frame import MAX_TOUCHED, Body, Pose, Vec
from .world.vectors import multiply, orthonormalize, rotation_matrix

if TYPE_CHECKING:  # only scenes whose users can collide import it
    from .world.bodies import Bodies

# Limit on the duration of a frame [s]. A motion command that is due for longer takes several.
LONGEST_FRAME = 0.1
# After a pause of more than this, a viewer continues as after one of LONGEST_FRAME [s]: it stood
# still, and did not send two motion commands a second.
LONGEST_PAUSE = 0.5


def frame_durations(command: Wish, before: float | None) -> list[float]:
    """Return how long each of the frames of a motion command lasts [s]; there is at least one.

    before: time of the user's previous command, on its clock; None: it is the first.
    """
    if before is None:
        return [FRAME_SECONDS]
    seconds = max(command.time - before, 0.0)
    if seconds > LONGEST_PAUSE:
        seconds = LONGEST_FRAME
    count = max(1, math.ceil(seconds / LONGEST_FRAME - 1e-9))  # times of clients are rounded
    return [min(seconds / count, LONGEST_FRAME)] * count


def target_pose(command: Wish, pose: Pose, seconds: float, up: Vec) -> Pose:
    """Return the target pose (4, 4) of a motion command given at `pose`. up: (3,) unit vector.

    A velocity applies for the duration of the frame.
    """
    if command.velocity is None:
        return check_rigid(command.pose[0], "pose")
    there = pose.copy()
    there[:3, 3] += np.array(command.velocity) * seconds
    if command.turn and seconds:
        there[:3, :3] = orthonormalize(multiply(rotation_matrix(up, command.turn * seconds), pose))
    return there


def spawn_pose(spawn: Spawn, up: Vec) -> Pose:
    """Return the pose at which users enter."""
    pose = np.eye(4)
    pose[:3, :3] = rotation_matrix(up, math.radians(spawn.heading))
    pose[:3, 3] = spawn.position
    return pose


def first_pose(command: Wish, spawn: Spawn | None, up: Vec) -> Pose:
    """Return the pose at which a user enters with its first command.

    Raise UnknownAvatarError if neither the scene's spawn nor the command gives one.
    """
    if spawn is not None:
        return spawn_pose(spawn, up)
    if command.velocity is not None:
        raise UnknownAvatarError("the avatar has no pose yet, and the scene has no spawn: begin with a pose")
    return check_rigid(command.pose[0].copy(), "pose")


def run_frames(
    run: Callable[..., Moved],
    command: Wish,
    durations: list[float],
    body: Body,
    up: Vec,
    bodies: "Bodies | None",
) -> Moved:
    """Run the frames of a user's motion command, nearly always one. If one fails, undo those before it.

    run: `Pipeline.run` with a budget.  durations: of `frame_durations`.  bodies: those that may
    meet, or None.
    """
    if len(durations) == 1:
        return run(body, target_pose(command, body.pose, durations[0], up), durations[0])
    body_before = replace(body, effect_state=dict(body.effect_state))
    bodies_before = None if bodies is None else bodies.snapshot()
    moves: list[Moved] = []
    try:
        for seconds in durations:
            moves.append(run(body, target_pose(command, body.pose, seconds, up), seconds))
            if bodies is not None:
                bodies[body.user] = body
    except BaseException:
        for each in fields(body):
            setattr(body, each.name, getattr(body_before, each.name))
        if bodies is not None and bodies_before is not None:
            bodies.restore(bodies_before)
        raise
    touched = {(each.what, each.place): each for moved in moves for each in moved.touched}
    last = moves[-1]
    return msgspec.structs.replace(
        last,
        left=last.left if command.velocity is None else sum(moved.left for moved in moves),
        touched=list(touched.values())[:MAX_TOUCHED],
        stepped=sum(moved.stepped for moved in moves),
        unknown=any(moved.unknown for moved in moves),
    )
