"""Effect `sweep`: continuous motion, so that no avatar passes through anything at any speed.

The avatar follows the screw motion of server/queries/sweep.py from one pose to the next. It stops
`skin` (of `stop`) before the first contact, at a pose that is clear by `collide`. The sweep proves
the pose clear if the pose is one of the sweep's bit for bit; otherwise `collide` is queried.
"""

from typing import Any

from ....schemas.scene.effect_table import Sweep
from ..world.frame import Frame
from ..world.frame_walk import FOLLOW


class SweepRunner:
    """Effect `sweep`: follows the motion command (kernels/walk/walk_motions.py)."""

    name, part = "sweep", FOLLOW

    def run(self, frame: Frame) -> None:
        """Follow the motion command."""
        frame.world.walker.run(frame, self.part)


def make(effect: Sweep, world: Any) -> SweepRunner:
    """Create the effect of a scene."""
    return SweepRunner()
