"""Meaning of motion commands: how long a frame lasts, and to which pose it leads."""

import math

import numpy as np

from ...schemas.archive.rigid_pose import check_rigid
from ...schemas.errors import UnknownAvatarError
from ...schemas.scene.scene_file import Spawn
from ...schemas.wire.motion_messages import FRAME_SECONDS, Wish
from .world.frame import Pose, Vec
from .world.vectors import multiply, orthonormalize, rotation_matrix

# Limit on the duration of a frame: after a longer pause, a viewer continues as after a short one
# [s].
LONGEST_FRAME = 0.1


def frame_seconds(command: Wish, before: float | None) -> float:
    """Return how long the frame of a motion command lasts [s].

    before: time of the user's previous command, on its clock; None: it is the first.
    """
    if before is None:
        return FRAME_SECONDS
    return min(max(command.time - before, 0.0), LONGEST_FRAME)


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
