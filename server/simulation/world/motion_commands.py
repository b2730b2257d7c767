"""What a wish asks of one frame: the pose it leads to, from where a body is, and how long the frame lasts. Pure."""

import math

import numpy as np
from numpy.typing import NDArray

from ....schemas.errors import BadTransformError, UnknownAvatarError
from ....schemas.scene.scene_file import Spawn
from ....schemas.wire.motion_messages import FRAME_SECONDS, Wish
from .vectors import product, rotation, straightened

Pose = NDArray[np.float64]  # (4, 4) float64, avatar to world, rigid

# What lies farther back than this was no frame: a viewer that stood still goes on as after a pause [s].
LONGEST_FRAME = 0.1
# A pose is rigid within this (NUMERICS.md N6).
_RIGID = 1e-9


def check_rigid(pose: Pose, what: str) -> Pose:
    """The same pose; BadTransformError unless it is a rotation and a translation."""
    # In Python's numbers: of one pose, a fifth of the time that numpy takes.
    (a, b, c, _), (d, e, f, _), (g, h, i, _), last = pose.tolist()
    if last != [0.0, 0.0, 0.0, 1.0]:
        raise BadTransformError(f"{what} has a last row that is not 0 0 0 1: give a row-major 4x4 pose")
    off = max(
        abs(a * a + b * b + c * c - 1), abs(d * d + e * e + f * f - 1), abs(g * g + h * h + i * i - 1),
        abs(a * d + b * e + c * f), abs(a * g + b * h + c * i), abs(d * g + e * h + f * i),
    )  # fmt: skip
    mirrored = a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g) < 0
    if not off <= _RIGID or mirrored:
        raise BadTransformError(
            f"{what} {'mirrors' if mirrored else f'is not rigid (off by {off:g})'}: expected a rotation, within 1e-9, "
            "and a translation: renormalise it"
        )
    return pose


def frame_seconds(wish: Wish, before: float | None) -> float:
    """How long the frame of a wish lasts [s]. before: the time of the user's wish before, on its clock; None: none."""
    if before is None:
        return FRAME_SECONDS
    return min(max(wish.time - before, 0.0), LONGEST_FRAME)


def wished_pose(wish: Wish, pose: Pose, seconds: float, up: NDArray[np.float64]) -> Pose:
    """Where a wish leads from `pose`. up: unit vector.  A velocity lasts for the frame."""
    if wish.velocity is None:
        return check_rigid(wish.pose[0], "pose")
    there = pose.copy()
    there[:3, 3] += np.array(wish.velocity) * seconds
    if wish.turn and seconds:
        there[:3, :3] = straightened(product(rotation(up, wish.turn * seconds), pose))
    return there


def spawn_pose(spawn: Spawn, up: NDArray[np.float64]) -> Pose:
    """Where users begin."""
    pose = np.eye(4)
    pose[:3, :3] = rotation(up, math.radians(spawn.heading))
    pose[:3, 3] = spawn.position
    return pose


def first_pose(wish: Wish, spawn: Spawn | None, up: NDArray[np.float64]) -> Pose:
    """Where a user begins whose first wish this is; UnknownAvatarError where neither scene nor wish says."""
    if spawn is not None:
        return spawn_pose(spawn, up)
    if wish.velocity is not None:
        raise UnknownAvatarError("the avatar is nowhere yet, and the scene has no spawn: begin with a pose")
    return check_rigid(wish.pose[0].copy(), "pose")
