"""Motion commands from what a user wants: speed and turn from keys and the direction of the view."""

import math
from collections import deque

import numpy as np
from numpy.typing import NDArray

from ....schemas.wire.motion_messages import State
from ..page.page_messages import Intent
from ..page.view_frame import ViewFrame

# Speeds of a person who walks and runs [m/s].
WALK_SPEED, RUN_SPEED = 1.6, 4.0
# An avatar turns by this share of the remaining angle in a second, up to a largest speed [rad/s].
_TURN_RATE, _MAX_TURN = 9.0, 7.0
# A direction is held within this angle [rad].
_HELD = 0.01
# A user who goes less than this [m] in so many frames at a surface is stuck, if at least this share of
# its way is along the surface.
_STUCK, _STUCK_FRAMES, _ALONG = 0.05, 4, 0.35
# It then steps off the surface with this speed [m/s], for so many frames.
_OFF_SPEED, _OFF_FRAMES = 0.2, 20
# A user slides if it moves farther than this in a frame [m]; share of such a frame in the wall's normal.
_SLID, _SHARE = 5e-3, 0.15


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


class Easing:
    """Change of the motion commands of a user who is stuck at a surface.

    A hand or a foot that reaches ahead can stick between the points of a wall along which the user
    walks, the sooner the more thinly the wall is scanned. A person takes the hand off the wall and
    goes on.
    """

    def __init__(self) -> None:
        """Begin with a user who is not stuck."""
        self._places: deque[NDArray[np.float64]] = deque(maxlen=_STUCK_FRAMES)
        self._normal: NDArray[np.float64] | None = None  # of the surface last touched
        self._frames = 0  # for which it still steps off

    def ease(self, wanted: NDArray[np.float64], state: State) -> tuple[NDArray[np.float64], bool]:
        """Return the velocity (3,) to command [m/s], and whether it steps off a surface.

        wanted: velocity that the user wants, world [m/s].  state: of its last frame. Call it for
        each motion command.
        """
        speed = float(np.linalg.norm(wanted))
        normals = [each.normal for each in state.touched if each.normal is not None]
        place = state.pose[0, :3, 3]
        if normals:
            self._learn(np.sum(normals, axis=0), place)
        if not speed or self._normal is None:
            self.reset()
            return wanted, False
        self._places.append(place)
        along = wanted - min(0.0, float(wanted @ self._normal)) * self._normal
        if self._frames == 0 and normals and self._is_stuck() and np.linalg.norm(along) >= _ALONG * speed:
            self._frames = _OFF_FRAMES
        if self._frames == 0:
            return wanted, False
        self._frames -= 1
        if self._frames == 0:
            self._places.clear()
        off: NDArray[np.float64] = along + _OFF_SPEED * self._normal
        return off, True

    def _learn(self, touched: NDArray[np.float64], place: NDArray[np.float64]) -> None:
        """Take the normals of a frame.

        Where the user sticks, the normal is that of a bump, often opposite to its way. That of the
        wall is the mean of the frames before, in which it slid.
        """
        length = float(np.linalg.norm(touched))
        if length < 1e-6:
            return
        normal = touched / length
        slid = len(self._places) > 0 and float(np.linalg.norm(place - self._places[-1])) > _SLID
        if self._normal is None:
            self._normal = normal
        elif slid:
            mean = (1 - _SHARE) * self._normal + _SHARE * normal
            self._normal = mean / max(1e-6, float(np.linalg.norm(mean)))

    def reset(self) -> None:
        """Forget what was touched."""
        self._places.clear()
        self._normal, self._frames = None, 0

    def _is_stuck(self) -> bool:
        """Return whether the user has hardly moved in the last frames."""
        if len(self._places) < _STUCK_FRAMES:
            return False
        return float(np.linalg.norm(self._places[-1] - self._places[0])) < _STUCK
