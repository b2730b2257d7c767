"""Routes through real scans: waypoints chosen by hand on plans of the scans.

Each route passes a real door or passage, or follows a wall. The line from one waypoint to the next
often overlaps a jamb, so that the person must slide off it.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


class Leg(NamedTuple):
    """Part of a route: straight towards a waypoint.

    to: the waypoint, along the two horizontal axes [m].
    lean: angle by which the person walks aside of the waypoint, counterclockwise about the vertical
    axis, to press against a wall beside the way [degrees].
    """

    to: tuple[float, float]
    lean: float = 0.0


class Route(NamedTuple):
    """Walk of a person.

    start: horizontal [m].  floor: its height at the start [m].  speed: [m/s].
    fits: whether the way is wide enough for the person; if not, the walk must end stuck.
    """

    name: str
    start: tuple[float, float]
    floor: float
    legs: tuple[Leg, ...]
    speed: float = 1.2
    fits: bool = True


class Scan(NamedTuple):
    """A scan and its routes.

    file: in the folder of scans.  up: number of the vertical axis.
    step: height that the effect `step` climbs [m].
    """

    file: str
    up: int
    step: float
    routes: tuple[Route, ...]

    def plan(self) -> tuple[int, int]:
        """Return the numbers of the two horizontal axes."""
        right, ahead = (axis for axis in range(3) if axis != self.up)
        return right, ahead

    def up_vector(self) -> Floats:
        """Return the unit vector against gravity (3,)."""
        return np.eye(3)[self.up]

    def place(self, flat: tuple[float, float], height: float) -> Floats:
        """Return a position (3,) [m]."""
        found = np.empty(3)
        found[list(self.plan())], found[self.up] = flat, height
        return found


def _legs(*corners: tuple[float, ...]) -> tuple[Leg, ...]:
    """Return legs. corners: horizontal coordinates [m], and a lean [degrees] if there is one."""
    return tuple(Leg((corner[0], corner[1]), *corner[2:]) for corner in corners)


SCANS = {
    "indoor_atrium": Scan(
        "indoor_atrium.laz",
        1,
        0.25,  # the three steps at the door rise by 0.23 m each
        (
            Route("corridor", (-14.04, 1.5), -1.34, _legs(
                (-12.8, 1.85), (-11.1, 2.05), (-9.9, 2.75), (-8.5, 3.25), (-6.7, 3.35), (-3.0, 3.5),
            )),
            Route("passage", (-3.0, 3.5), -1.34, _legs(
                (-3.84, 3.15), (-2.74, 2.6), (-1.94, 1.75), (-0.69, 1.35), (0.21, 2.1), (1.31, 2.65),
                (1.01, 3.8), (0.26, 4.7),
            )),
            # Through the opening between two parapets, against the end of one, and along the other.
            Route("parapets", (1.0, 1.5), -1.34, _legs(
                (0.6, 4.3), (1.0, 3.9), (1.9, 2.9, -20.0), (1.3, 2.0),
            )),
            # Between a planter and a parapet, which are 0.45 m apart.
            Route("planter", (-0.5, 1.5), -1.34, _legs((0.3, 4.4)), fits=False),
            # Along the wall of the corridor, into the niche and past its parapet.
            Route("corridor wall", (-13.0, 1.2), -1.34, _legs(
                (-12.0, 0.6), (-9.7, 0.7, 20.0), (-9.9, 1.6), (-9.0, 2.2), (-5.5, 2.3, 15.0), (-4.5, 1.2),
            )),
            # On the upper floor: up the three steps in the door, out against its left jamb, and along
            # the wall outside.
            Route("door", (-8.0, 5.2), 4.49, _legs(
                (-9.5, 5.8), (-10.1, 7.5), (-10.6, 5.7), (-13.0, 5.2, 20.0), (-10.2, 5.2),
            )),
            # Against its right jamb, beside the lowest step.
            Route("right jamb", (-8.0, 5.2), 4.49, _legs((-8.6, 6.2), (-10.4, 7.1), (-10.1, 7.5))),
            # The same, so that the step is met head on while the jamb is touched.
            Route("right jamb and step", (-8.0, 5.2), 4.49, _legs((-8.6, 6.2), (-10.1, 7.5))),
            # Around the corner of the gallery, along its railing, and through the door at its end,
            # against its right jamb and back against its left one.
            Route("gallery", (-4.5, 4.0), 4.40, _legs(
                (-2.9, 3.3), (-0.7, -1.2, 15.0), (-1.2, -3.4), (-1.5, -0.6), (-1.0, -0.4),
            )),
        ),
    ),
    "octomap_hall": Scan(
        "octomap_hall.xyz",
        2,
        0.2,
        (
            # Against the left jamb of the portal and through it, back against its right jamb, and
            # along the wall beside it.
            Route("portal", (1.5, 0.0), -0.05, _legs(
                (3.8, 4.0), (5.4, 5.9), (6.6, 5.9), (7.3, 4.2), (5.0, 4.2), (3.7, 4.72, -20.0),
            )),
            # Against the pillar at the end of the wall, and through the opposite portal.
            Route("opposite portal", (1.5, 0.0), -0.05, _legs(
                (1.6, -4.2), (3.4, -5.6), (6.3, -8.4),
            )),
            # Up the stairs along their balustrade, and down.
            Route("stairs", (3.0, -1.5), -0.12, _legs(
                (5.0, -3.2), (7.5, -4.0, -10.0), (7.5, -1.0), (4.0, -1.0),
            )),
        ),
    ),
}  # fmt: skip
