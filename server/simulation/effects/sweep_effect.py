"""Effect `sweep`: continuous motion, so that no avatar passes through anything at any speed.

The avatar follows the screw motion of server/queries/sweep.py from one pose to the next. It stops
`skin` (of `stop`) before the first contact, at a pose that is clear by `collide`. The sweep proves
the pose clear if the pose is one of the sweep's bit for bit; otherwise `collide` is queried.
"""

from ....schemas.scene.effect_table import Stop, Sweep
from ....schemas.scene.scene_file import sweep_tolerance
from ..world.collision_world import World
from ..world.frame import (
    Frame,
    Hit,
    Pose,
    find_first_hit,
    follow_command,
    pushes_on,
    record_hit,
    settle_before,
    skin_fraction,
    with_point,
)

# Limit of pushes of obstacles in one motion.
_MAX_PUSHES = 4


class SweepRunner:
    """Effect `sweep` of one scene. skin, tolerance: as in `Stop` and `Sweep` [m]."""

    name = "sweep"

    def __init__(self, skin: float, tolerance: float) -> None:
        self.skin, self.tolerance = skin, tolerance

    def run(self, frame: Frame) -> None:
        """Follow the motion command."""
        frame.advance = self.sweep_towards
        follow_command(frame)

    def sweep_towards(self, frame: Frame, to: Pose) -> Hit | None:
        """Move towards a pose as far as nothing is touched; return the hit that ended it."""
        hit: Hit | None = None
        for _ in range(_MAX_PUSHES):
            if frame.pose.tobytes() == to.tobytes():
                return None
            first = to is frame.target and frame.pose is frame.body.pose
            swept = frame.walked[0] if first else None
            hit = find_first_hit(frame, to, self.tolerance, self.skin, swept=swept)
            if hit is None:
                frame.pose = to
                return None
            if hit.end is not None and not frame.obstacles:
                frame.pose = hit.end
            else:
                hit = with_point(frame, to, hit)
                settle_before(
                    frame, to, hit.fraction - skin_fraction(frame, to, hit, self.skin), hit.fraction
                )
            if not pushes_on(frame, hit, to):
                break
        if hit is not None:
            record_hit(frame, hit, to)
        return hit


def make(effect: Sweep, world: World) -> SweepRunner:
    """Create the effect of a scene."""
    skin = next(each.skin for each in world.file.effects if isinstance(each, Stop))
    return SweepRunner(skin, sweep_tolerance(world.file))
