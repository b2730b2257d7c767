"""Effect `step`: climb steps of at most `height`, and descend them without falling.

A standing avatar whose motion was stopped moves up by `height`, as far as nothing is touched, then
forward by the rest of the motion command, and down. The result is kept if it led farther along the
motion command than sliding did, ends on ground, and rose by no more than `height`. Otherwise the
frame is restored. The effect `ground` handles steps down: it searches for ground down to `height`.
"""

from typing import Any

from ....schemas.scene.effect_table import Step
from ..world.frame import Frame
from ..world.frame_walk import STEP


class StepRunner:
    """Effect `step`: climbs what obstructed the motion command (kernels/walk/step_up.py)."""

    name, part = "step", STEP

    def run(self, frame: Frame) -> None:
        """Climb the obstacle that stopped the motion command, if possible."""
        frame.world.walker.run(frame, self.part)


def make(effect: Step, world: Any) -> StepRunner:
    """Create the effect of a scene."""
    return StepRunner()
