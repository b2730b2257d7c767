"""Effect `ground`: gravity; the avatar stands slightly above the ground, or falls.

In each frame, the avatar is swept straight down from the pose that the earlier effects gave it. It
stands on the first surface within reach, if that is no steeper than `slope`. It is held `clearance`
above the ground, so that bumps of a floor do not stop it and it walks over low sills. A steeper
surface is not ground: the avatar slides down along it. Without ground, the avatar falls by
v t + g t^2 / 2 in a frame of duration t, with a speed of at most `fall_speed`. The fall is swept
like any motion, so the avatar lands in the frame in which it reaches the ground.

Scans have holes, above all in floors behind columns and under furniture. An avatar that stood in
the last frame and has no ground below falls only if its feet would land. It keeps its height
instead if nothing below was scanned, or if the rim of a hole, or the ledge just left, would catch
the rest of the body. It then falls or stands again when there is ground or it has left the ledge.

An avatar that pushes against something, and was raised where it is, is not lowered again: it would
rise and sink in turn where the heights of the ground differ nearby, as at the edge of a sheet.

The vertical part of a motion command is ignored, both when standing and when falling. A body whose
top is above the middle of the avatar stands beside it and is no ground: a user pressed between two
others would otherwise fall.
"""

import numpy as np

from ....schemas.scene.effect_table import Ground
from ..world.collision_world import World
from ..world.frame import Frame, Vec
from ..world.frame_walk import GROUND
from ..world.vectors import dot, norm


class GroundRunner:
    """Effect `ground`: stands on the ground or falls (kernels/walk/stand_on_ground.py).

    up: (3,) unit vector.
    """

    name, part = "ground", GROUND

    def __init__(self, up: Vec) -> None:
        along = np.flatnonzero(up)
        self._axis = int(along[0]) if len(along) == 1 else None

    def begin(self, frame: Frame) -> None:
        """Remove the vertical part of the motion command."""
        if self._axis is not None:
            frame.target[self._axis, 3] = frame.body.pose[self._axis, 3]
            return
        up, begin = frame.world.up, frame.body.pose[:3, 3]
        way = frame.target[:3, 3] - begin
        rises = dot(way, up)
        if rises == 0.0:
            return
        level = way - rises * up
        if norm(level) <= 1e-12 * abs(rises):  # rounding alone
            level[:] = 0.0
        frame.target[:3, 3] = begin + level

    def run(self, frame: Frame) -> None:
        """Move the avatar to its height above the ground, or let it fall."""
        frame.world.walker.run(frame, self.part)


def make(effect: Ground, world: World) -> GroundRunner:
    """Create the effect of a scene."""
    return GroundRunner(world.up)
