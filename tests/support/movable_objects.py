"""Movable objects for tests of the effect `objects`: a crate to push, a leaf of a door to place."""

import numpy as np
from moving_bodies import INTERPRETED, Stage, ball, box, touch
from numpy.typing import NDArray
from solidcloud.schemas.scene.effect_table import AnyEffect, Objects, Stop, Sweep
from solidcloud.schemas.scene.scene_file import ObjectItem
from solidcloud.schemas.wire.answers import Verdict
from solidcloud.server.avatars.avatar_model import make_avatar

USER = ball(0.2, 12 if INTERPRETED else 60)
CRATE = box(0.4, 0.4, 0.4, 0.17 if INTERPRETED else 0.05, 0.1 if INTERPRETED else 0.03)
# A leaf of 2 cm with its hinge at the origin.
LEAF = make_avatar(
    box(0.8, 0.02, 0.8, 0.08 if INTERPRETED else 0.02, 0.01).points + np.array([0.4, 0, 0]),
    0.05 if INTERPRETED else 0.01,
)
AVATARS = {"crate": CRATE, "leaf": LEAF}
MOVING: list[AnyEffect] = [Stop(), Sweep(), Objects()]


def item(name: str, pose: NDArray[np.float64], *, avatar: str = "crate", pushed: bool = True) -> ObjectItem:
    """Return the declaration of an object, pushed or kinematic."""
    return ObjectItem(name=name, avatar=avatar, pose=pose.tolist(), kind="pushed" if pushed else "kinematic")


def where(stage: Stage, name: str) -> NDArray[np.float64]:
    """Return a copy of the current pose of an object."""
    pose: NDArray[np.float64] = stage.bodies.poses[stage.bodies.row_of(name, user=False)].copy()
    return pose


def free_of(stage: Stage, name: str) -> bool:
    """Return whether an object touches neither a user, nor another object, nor the scene."""
    bodies, world = stage.bodies, stage.world
    row = bodies.row_of(name, user=False)
    model, pose = bodies.shapes[row].model, bodies.poses[row]
    if world.collide(model, pose) != Verdict.CLEAR:
        return False
    return not any(
        touch(model, pose, bodies.shapes[other].model, bodies.poses[other], bodies.origin)
        for other in range(len(bodies.names))
        if other != row
    )
