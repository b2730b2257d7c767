"""`crowd`: users do not walk through one another.

The others stand where they are now: those whose turn came before in this frame have moved already, in the order that
the simulation has, which its log keeps. Who is met blocks, and does not move. Users that overlap, as those who began in
one place, are let apart and not deeper (blocking.py).
"""

from typing import Any

from ...schemas.effects import Crowd
from ...schemas.errors import BadRequestError
from ...schemas.moves import CrowdReport
from ..request import to_units
from .blocking import Blocking, warm
from .bodies import USER, Bodies
from .frame import Frame, Hit, Pose

# Users farther apart than this do not meet [m].
_MOST_MARGIN = 8.0


def make(effect: Crowd, world: Any) -> "CrowdRunner":
    """The effect of a scene."""
    if effect.margin > _MOST_MARGIN:
        raise BadRequestError(f"margin {effect.margin:g} m of crowd: expected at most {_MOST_MARGIN:g} m")
    warm()
    with world as seen:
        bodies = Bodies(seen[0].data.arrays.origin, world.up)
    return CrowdRunner(bodies, to_units(effect.margin, "margin"))


class CrowdRunner:
    """Puts the other users in a frame's way. bodies: the simulation keeps them up to date, and may put others there."""

    name = "crowd"

    def __init__(self, bodies: Bodies, margin_units: int) -> None:
        """margin_units: users stay so far apart, exact units."""
        self.bodies, self._margin_units = bodies, margin_units

    def run(self, frame: Frame) -> None:
        """Add the others to what blocks; the report counts those that do."""
        self.bodies.begin()
        frame.reports[self.name] = CrowdReport()
        frame.obstacles.append(Others(self.name, self.bodies, frame, self._margin_units))


class Others(Blocking):
    """The other users; counts those that ended a motion."""

    def __init__(self, name: str, bodies: Bodies, frame: Frame, margin_units: int) -> None:
        """frame: whose way they are in."""
        body, stop = frame.body, frame.effort.stop
        super().__init__(
            name, bodies, USER, body.name, body.avatar, body.pose, margin_units=margin_units, stop=stop
        )
        self._met: set[str] = set()

    def give_way(self, frame: Frame, hit: Hit, to: Pose) -> bool:
        """They stand."""
        if self.is_own(hit):
            self._met.add(hit.what)
            frame.reports[self.name] = CrowdReport(len(self._met))
        return False
