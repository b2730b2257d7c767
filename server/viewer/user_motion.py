"""Motion commands from what a user wants: speed and turn from keys and the direction of the view."""

import math

import numpy as np
from numpy.typing import NDArray

from ...schemas.wire.motion_messages import State
from .page_messages import Intent
from .view_frame import ViewFrame

# Speeds of a person who walks and runs [m/s].
WALK_SPEED, RUN_SPEED = 1.6, 4.0
# An avatar turns by this share of the remaining angle in a second, up to a largest speed [rad/s].
_TURN_RATE, _MAX_TURN = 9.0, 7.0
# A direction is held within this angle [rad].
_HELD = 0.01
# A user who goes less than this in a frame at a surface is stuck [m], and then steps off the surface
# with this speed [m/s], if at least this share of its way is along the surface.
_STUCK, _OFF_SPEED, _ALONG = 3e-3, 0.35, 0.35


def velocity(intent: Intent, frame: ViewFrame) -> NDArray[np.float64]:
    """Return the velocity (3,) that a user wants, world [m/s]."""
    c, s = math.cos(intent.yaw), math.sin(intent.yaw)
    way = np.array([intent.forward * c + intent.right * s, intent.forward * s - intent.right * c, intent.up])
    length = float(np.linalg.norm(way))
    # Two keys at once are not faster than one.
    way *= (RUN_SPEED if intent.run else WALK_SPEED) / max(1.0, length)
    return frame.directions_to_world(way)


def turn(intent: Intent, yaw: float) -> float:
    """Return how fast an avatar turns about the up axis [rad/s]. yaw: that it faces now [rad].

    It turns to where it goes; with `face`, to where the user looks.
    """
    if intent.face:
        target = intent.yaw
    elif math.hypot(intent.forward, intent.right) > 0.05:
        target = intent.yaw + math.atan2(-intent.right, intent.forward)
    else:
        return 0.0
    left = math.remainder(target - yaw, 2 * math.pi)
    if abs(left) < _HELD:
        return 0.0
    return max(-_MAX_TURN, min(_MAX_TURN, left * _TURN_RATE))


def eased(wanted: NDArray[np.float64], state: State, moved: float) -> NDArray[np.float64]:
    """Return the velocity (3,) of a user who may be stuck at a surface, world [m/s].

    wanted: that it wants.  state: of the last frame.  moved: way of that frame [m].
    A hand or a foot that reaches ahead can stick between the noisy points of a wall that the user
    walks along: of 15 walks along the wall of the generated façade, at 10 to 80 degrees to it, the
    figure sticks in 9. A person takes the hand off the wall and goes on.
    """
    speed = float(np.linalg.norm(wanted))
    normals = [each.normal for each in state.touched if each.normal is not None]
    if not speed or not normals or moved > _STUCK:
        return wanted
    normal = np.sum(normals, axis=0)
    length = float(np.linalg.norm(normal))
    if length < 1e-6:
        return wanted
    normal /= length
    along = wanted - min(0.0, float(wanted @ normal)) * normal
    if np.linalg.norm(along) < _ALONG * speed:
        return wanted
    off: NDArray[np.float64] = along + _OFF_SPEED * normal
    return off
