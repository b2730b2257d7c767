"""Doorway error: extra width that a door of the generated façade needs before the figure passes.

The width of the figure includes its own spheres. The error is due to the scan and to the spheres of
the scan's points. It is inferred from one wide door: the narrowest door that lets the figure pass
is narrower than this door by the free play on both sides. The jambs are independent of one another,
and the play is measured for each separately.
"""

import math
from collections.abc import Callable
from functools import lru_cache, partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ....builder.synthetic.figure import figure_points
from ....builder.synthetic.truth import DoorTruth, FacadeTruth
from ....schemas.wire.answers import Verdict
from ...scene import Scene

# Resolution of the play on each side [m]; the width of the door has an uncertainty of twice that,
# half a millimetre.
FINEST = 0.00025
# Distance of poses along the passage [m]. Between two poses, the contact of two spheres is missed
# by up to POSE_SPACING² / 8 divided by the sum of their radii: 0.15 mm with those of figure and façade.
POSE_SPACING = 0.005
# Heights of the soles above the sill [m]. They are large because a jamb, not the floor, must stop
# the figure: spheres thicken the floor as well, and under a tolerance of 10 cm the figure would be
# in contact with it. The result is the mean over several heights: the widest parts of the figure
# meet random points of the jambs, which makes a difference of 5 mm from one height to the next.
SOLE_HEIGHTS = (0.24, 0.28, 0.32, 0.36)
# The search on each side begins this far before the true jamb [m].
OUTSIDE = 0.05
# The search ends this far past the true jamb [m]. It is the limit of a negative error on one side,
# where spheres are so small that the figure slips between them. Farther inside, a wall contains no
# points.
INSIDE = 0.10


class Doorway(NamedTuple):
    """Result of a doorway measurement.

    narrowest: width of the narrowest door that lets the figure pass [m].
    width: of the figure [m].  error: narrowest - width [mm].
    narrowest and error are infinite if the figure cannot even stand in the middle of the door.
    """

    narrowest: float
    width: float
    error: float


@lru_cache(1)
def made_figure() -> NDArray[np.float64]:
    """Return the points (n, 3) of the generated figure [m]; cached, as it takes half a second."""
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
) -> Doorway:
    """Measure the doorway error of a door for the generated figure, upright and along the middle.

    The figure moves straight through the door, shifted to a side. A pose that is not clear stops
    it. The largest shift with which it passes is the play on this side, found by bisection.
    scene: of a scan of the façade.
    avatar_name: of the figure in the scene. It is added if missing; BadRequestError if the name
    belongs to another avatar.
    door: name of the door.  The other parameters are those of `Scene.collide`.
    """
    figure = made_figure()
    radius = scene.add_avatar(avatar_name, figure).radius or 0.0
    frame = facade_truth.door(door)
    ask = partial(scene.collide, avatar_name, radius_model=radius_model, tolerance=tolerance)

    def stops(poses: NDArray[np.float64], x: float) -> NDArray[np.bool_]:
        """Return which of the poses are not clear after a shift by x [m]."""
        moved = poses.copy()
        moved[:, 0, 3] += x
        return np.asarray(ask(moved).verdict != Verdict.CLEAR)

    width = float(np.ptp(figure[:, 0])) + 2 * radius
    play = 0.0
    for lift in SOLE_HEIGHTS:
        poses = passage(frame, lift, facade_truth.origin, figure)
        if stops(poses, 0.0).any():
            return Doorway(math.inf, width, math.inf)
        for side in (-1, 1):
            true_play = frame.width / 2 - float((side * figure[:, 0]).max()) - radius
            play += _play(stops, poses, side, true_play) / len(SOLE_HEIGHTS)
    narrowest = frame.width - play
    return Doorway(narrowest, width, (narrowest - width) * 1000)


def _play(
    stops: Callable[[NDArray[np.float64], float], NDArray[np.bool_]],
    poses: NDArray[np.float64],
    side: int,
    true_play: float,
) -> float:
    """Return the largest shift to one side [m] at which all poses stay clear, by bisection.

    The poses are clear in the middle.  true_play: the play by the door's true width [m].
    """
    free, stopped = 0.0, true_play + INSIDE
    guess = max(true_play - OUTSIDE, 0.0)
    while stopped - free > FINEST:
        stopping = stops(poses, side * guess)
        if stopping.any():
            # A pose that is clear here is also clear farther from this jamb, and is not tested
            # again.
            stopped, poses = guess, poses[stopping]
        else:
            free = guess
        guess = (free + stopped) / 2
    return free


def passage(
    door: DoorTruth, lift: float, origin: tuple[float, float, float], figure: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return poses (k, 4, 4) along the door's middle, from in front of the jambs to behind them.

    The poses are POSE_SPACING apart.
    lift: height of the soles above the sill [m].  origin: of the façade.
    """
    y = np.arange(
        door.y_front - figure[:, 1].max(), door.y_back - figure[:, 1].min() + POSE_SPACING, POSE_SPACING
    )
    poses = np.tile(np.eye(4), (len(y), 1, 1))
    poses[:, 0, 3] = (door.x_left + door.x_right) / 2 + origin[0]
    poses[:, 1, 3] = y + origin[1]
    poses[:, 2, 3] = door.sill + lift + origin[2]
    return poses
