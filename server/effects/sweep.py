"""`sweep`: motion is continuous; nothing is passed through between two frames, however fast.

The way from one pose to the next is the screw motion of server/sweep.py. What it meets ends it `skin` before (`stop`),
at a pose that is clear by `collide`: proved by the sweep where the pose is the sweep's bit for bit, else asked.
"""

from ...schemas.effects import Stop, Sweep
from ..world import World
from .frame import Frame, Hit, Pose
from .going import first_hit, gives_way, note, set_out, settle, way_back

# What gives way is pushed on so often at most in one motion.
_PUSHES = 4


class Sweeping:
    """The effect of one scene. skin, tolerance: as `Stop` and `Sweep` have them."""

    name = "sweep"

    def __init__(self, skin: float, tolerance: float) -> None:
        self.skin, self.tolerance = skin, tolerance

    def run(self, frame: Frame) -> None:
        """Go for the wish."""
        frame.go = self.go
        set_out(frame)

    def go(self, frame: Frame, to: Pose) -> Hit | None:
        """Go towards a pose as far as nothing is touched."""
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
    """The effect of a scene."""
    skin = next(each.skin for each in world.file.effects if isinstance(each, Stop))
    return Sweeping(skin, effect.tolerance)
