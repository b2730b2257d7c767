"""The doorway's error: how much wider than the figure a door of the made façade must be for it to pass.

The figure is solid as its spheres are, so they count as its own width; what is left is made by the scan and by the
spheres of its points. The door of the façade is wider than the narrowest one that lets the figure pass, by the play
that is left to either side; the jambs are independent of one another, so the play is found for each alone.
"""

import math
from collections.abc import Callable
from functools import lru_cache, partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...builder.made.figure import figure_points
from ...builder.made.truth import DoorTruth, FacadeTruth
from ...schemas.answers import Verdict
from ..scene import Scene

# Each side's play is found to a quarter of a millimetre, the door's width to half of one [m].
FINEST = 0.00025
# Poses this far apart along the passage [m]: between two of them a sphere's side is missed by ALONG² / 8 over the sum
# of two radii, 0.15 mm with those of figure and façade.
ALONG = 0.005
# The soles above the sill [m]. High, for what stops the figure is to be a jamb: spheres thicken the floor as well, and
# under a tolerance of 10 cm the figure would stand in it. Several, and the mean of their doors: which points of the
# jambs its widest parts meet is chance, worth 5 mm from one height to the next.
LIFTS = (0.24, 0.28, 0.32, 0.36)
# How far before the true jamb a side is looked for first [m].
OUTSIDE = 0.05
# How far past the true jamb a side is looked for [m]: where spheres are so small that the figure slips between them,
# its error on this side is this far below zero. Farther, the inside of a wall is empty of points.
INSIDE = 0.10


class Doorway(NamedTuple):
    """The narrowest door that lets the figure pass [m], the figure's own width [m], the former minus the latter [mm].

    Door and error are infinite where the figure cannot even stand in the middle of the door.
    """

    narrowest: float
    width: float
    error: float


@lru_cache(1)
def made_figure() -> NDArray[np.float64]:
    """The made figure (n, 3) [m]; it takes half a second to make."""
    figure = figure_points()
    figure.setflags(write=False)
    return figure


def doorway_error(
    scene: Scene,
    avatar_name: str,
    facade_truth: FacadeTruth,
    *,
    door: str = "main",
    radius_model: str | None = None,
    tolerance: float = 0.0,
    budget_visits: int | None = None,
) -> Doorway:
    """The narrowest door the made figure passes, upright and along the middle, minus its width across.

    scene: of a scan of the façade.  avatar_name: of the made figure in it; added where it is not there yet, otherwise a
    BadRequestError if another figure has the name.  door: which one.  The others as in `Scene.collide`.
    The figure goes straight through, shifted to a side; a pose that is not clear stops it. The shift that just lets it
    pass is its play on this side, found by bisection.
    """
    figure = made_figure()
    radius = scene.add_avatar(avatar_name, figure).radius or 0.0
    frame = facade_truth.door(door)
    ask = partial(
        scene.collide,
        avatar_name,
        radius_model=radius_model,
        tolerance=tolerance,
        budget_visits=budget_visits,
    )

    def stops(poses: NDArray[np.float64], x: float) -> NDArray[np.bool_]:
        """Which of the poses are not clear once moved aside by x [m]."""
        moved = poses.copy()
        moved[:, 0, 3] += x
        return np.asarray(ask(moved).verdict != Verdict.CLEAR)

    width = float(np.ptp(figure[:, 0])) + 2 * radius
    play = 0.0
    for lift in LIFTS:
        poses = passage(frame, lift, facade_truth.origin, figure)
        if stops(poses, 0.0).any():
            return Doorway(math.inf, width, math.inf)
        for side in (-1, 1):
            true_play = frame.width / 2 - float((side * figure[:, 0]).max()) - radius
            play += _play(stops, poses, side, true_play) / len(LIFTS)
    narrowest = frame.width - play
    return Doorway(narrowest, width, (narrowest - width) * 1000)


def _play(
    stops: Callable[[NDArray[np.float64], float], NDArray[np.bool_]],
    poses: NDArray[np.float64],
    side: int,
    true_play: float,
) -> float:
    """How far to a side poses that are clear in the middle can all be moved and stay clear [m], by bisection.

    true_play: what the door's true width leaves.
    """
    free, stopped = 0.0, true_play + INSIDE
    guess = max(true_play - OUTSIDE, 0.0)
    while stopped - free > FINEST:
        stopping = stops(poses, side * guess)
        if stopping.any():
            # A pose that is clear here is clear farther from this jamb too: it need not be asked again.
            stopped, poses = guess, poses[stopping]
        else:
            free = guess
        guess = (free + stopped) / 2
    return free


def passage(
    door: DoorTruth, lift: float, origin: tuple[float, float, float], figure: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Poses (k, 4, 4) along the door's middle, ALONG apart, from before the jambs' fronts to behind their backs.

    lift: of the soles above the sill [m].  origin: of the façade.
    """
    y = np.arange(door.y_front - figure[:, 1].max(), door.y_back - figure[:, 1].min() + ALONG, ALONG)
    poses = np.tile(np.eye(4), (len(y), 1, 1))
    poses[:, 0, 3] = (door.x_left + door.x_right) / 2 + origin[0]
    poses[:, 1, 3] = y + origin[1]
    poses[:, 2, 3] = door.sill + lift + origin[2]
    return poses
