"""Meaning of motion commands: how long a frame lasts, and to which pose it leads."""

import math

import numpy as np

from ...schemas.archive.rigid_pose import check_rigid
from ...schemas.errors import UnknownAvatarError
from ...schemas.scene.scene_file import Spawn
from ...schemas.wire.motion_messages import FRAME_SECONDS, Wish
from .world.frame import Pose, Vec
from .world.vectors import multiply, orthonormalize, rotation_matrix

# Limit on the duration of a frame [s]. A motion command that is due for longer takes several.
LONGEST_FRAME = 0.1
# After a pause of more than this, a viewer continues as after one of LONGEST_FRAME [s]: it stood still,
# and did not send two motion commands a second.
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
