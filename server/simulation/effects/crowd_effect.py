"""Effect `crowd`: users do not walk through one another.

The other users are obstacles at their current poses. Users whose turn came earlier in this frame
have already moved; the replay log records the order. A user blocks the others and is not moved by
them. Users that overlap, for example because they entered at the same place, may separate but not
move deeper (body_obstacles.py).
"""

from typing import Any

from ....schemas.errors import BadRequestError
from ....schemas.scene.effect_table import Crowd
from ....schemas.wire.motion_messages import CrowdReport
from ...queries.context.query_context import to_units
from ..world.bodies import USER, Bodies
from ..world.body_obstacles import BodyObstacle, warm_kernels
from ..world.frame import Frame, Hit, Pose

# Largest permitted margin [m].
_MAX_MARGIN = 8.0


def make(effect: Crowd, world: Any) -> "CrowdRunner":
    """Create the effect of a scene."""
    if effect.margin > _MAX_MARGIN:
        raise BadRequestError(f"margin {effect.margin:g} m of crowd: expected at most {_MAX_MARGIN:g} m")
    warm_kernels()
    with world as seen:
        bodies = Bodies(seen[0].data.arrays.origin, world.up)
    return CrowdRunner(bodies, to_units(effect.margin, "margin"))


class CrowdRunner:
    """Effect that adds the other users to the obstacles of a frame.

    bodies: the simulation updates them, and may replace them by those of another effect.
    """

    name = "crowd"

    def __init__(self, bodies: Bodies, margin_units: int) -> None:
        """Create the effect. margin_units: distance between users, exact units."""
        self.bodies, self._margin_units = bodies, margin_units

    def run(self, frame: Frame) -> None:
        """Add the other users to the obstacles; the report counts those that block."""
        self.bodies.begin()
        frame.reports[self.name] = CrowdReport()
        frame.obstacles.append(UserObstacle(self.name, self.bodies, frame, self._margin_units))


class UserObstacle(BodyObstacle):
    """Obstacle formed by the other users; it counts those that ended a motion."""

    def __init__(self, name: str, bodies: Bodies, frame: Frame, margin_units: int) -> None:
        """Create the obstacle for one frame of one user."""
        body, stop = frame.body, frame.budget.stop
        super().__init__(
            name, bodies, USER, body.name, body.avatar, body.pose, margin_units=margin_units, stop=stop
        )
        self._met: set[str] = set()

    def give_way(self, frame: Frame, hit: Hit, to: Pose) -> bool:
        """Count the user that ended the motion; return False, because users do not give way."""
        if self.is_own(hit):
            self._met.add(hit.what)
            frame.reports[self.name] = CrowdReport(len(self._met))
        return False
