"""Effect `sweep`: continuous motion; nothing is passed through between two frames at any speed.

The way from one pose to the next is the screw motion of server/queries/sweep.py. What it meets ends it
`skin` before (`stop`), at a pose that is clear by `collide`. The sweep proves that where the pose
is the sweep's bit for bit; otherwise it is queried.
"""

from ....schemas.scene.effect_options import Stop, Sweep
from ..world.collision_world import World
from ..world.frame import Frame, Hit, Pose
from .motion import first_hit, gives_way, note, set_out, settle, way_back

# Largest number of pushes of what gives way, in one motion.
_PUSHES = 4


class Sweeping:
    """Effect `sweep` of one scene. skin, tolerance: of `Stop` and `Sweep`."""

    name = "sweep"

    def __init__(self, skin: float, tolerance: float) -> None:
        self.skin, self.tolerance = skin, tolerance

    def run(self, frame: Frame) -> None:
        """Follow the motion command."""
        frame.go = self.go
        set_out(frame)

    def go(self, frame: Frame, to: Pose) -> Hit | None:
        """Move towards a pose as far as nothing is touched; return what ended the motion."""
        hit: Hit | None = None
        for _ in range(_PUSHES):
            if frame.pose.tobytes() == to.tobytes():
                return None
            hit = first_hit(frame, to, self.tolerance)
            if hit is None:
                frame.pose = to
                return None
            settle(frame, to, hit.fraction - way_back(frame, to, hit, self.skin), hit.fraction)
            if not gives_way(frame, hit, to):
                break
        if hit is not None:
            note(frame, hit)
        return hit


def make(effect: Sweep, world: World) -> Sweeping:
    """Create the effect of a scene."""
    skin = next(each.skin for each in world.file.effects if isinstance(each, Stop))
    return Sweeping(skin, effect.tolerance)
