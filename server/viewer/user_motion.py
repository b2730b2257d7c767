"""Motion commands from what a user wants: speed and turn from keys and the direction of the view."""

import math

import numpy as np
from numpy.typing import NDArray

from .page_messages import Intent
from .view_frame import ViewFrame

# Speeds of a person who walks and runs [m/s].
WALK_SPEED, RUN_SPEED = 1.6, 4.0
# An avatar turns by this share of the remaining angle in a second, up to a largest speed [rad/s].
_TURN_RATE, _MAX_TURN = 9.0, 7.0
# A direction is held within this angle [rad].
_HELD = 0.01


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
