"""How far a wall of scanned points leaks: how deep a round probe gets into it before it is stopped.

The probe is pushed along the normal into places of the made façade's walls, whose true surface is known. With a hole of
radius g between points of radius r, a probe of radius R is first touched where its foremost point is R - sqrt((R +
r)² - g²) past the surface; where g is larger than R + r, it goes through.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...builder.made.places import WallPlaces, wall_places
from ...builder.made.truth import SceneTruth
from ...schemas.answers import Verdict
from ..scene import Scene

PROBE = "leak probe"
RADIUS = 0.05
# The probe's centre starts this far before the wall [m]: so that it is stopped in time by spheres of 25 cm and by
# tolerances of 10 cm with usual spheres. The places are free of all else for 15 cm to the sides.
START = 0.30
# How exactly the first contact is found [m], where no larger tolerance is asked for.
FINEST = 1e-6

__all__ = ["Leak", "WallPlaces", "leak", "leak_places"]


class Leak(NamedTuple):
    """How far the probe's foremost point is past the true surface when it is stopped, over all places.

    p50, p99, worst: [mm], negative before the surface; a probe that goes through counts its diameter, at which all of
    it is past the surface.  passed: the share of places where it goes through.
    """

    p50: float
    p99: float
    worst: float
    passed: float


def leak_places(truth: SceneTruth, places: int = 2000, seed: int = 2012) -> WallPlaces:
    """Where to push: places of the façade's walls, from dense to four times as sparse; see builder/made/places.py."""
    return wall_places(truth, places, seed)


def leak(
    scene: Scene,
    walls: WallPlaces,
    *,
    radius_model: str | None = None,
    tolerance: float = 0.0,
    budget_visits: int | None = None,
) -> Leak:
    """Push a probe of 5 cm radius at every place; the others as in `Scene.sweep`. Adds an avatar, "leak probe"."""
    depth = leak_depths(
        scene, walls, radius_model=radius_model, tolerance=tolerance, budget_visits=budget_visits
    )
    passed = depth >= 2 * RADIUS
    p50, p99 = np.percentile(depth, [50, 99]) * 1000
    return Leak(float(p50), float(p99), float(depth.max()) * 1000, float(passed.mean()))


def leak_depths(
    scene: Scene,
    walls: WallPlaces,
    *,
    radius_model: str | None = None,
    tolerance: float = 0.0,
    budget_visits: int | None = None,
) -> NDArray[np.float64]:
    """How far past the true surface the foremost point of the probe is when it is stopped (k,) [m].

    It is stopped where its way is no longer proved clear. 2 RADIUS where nothing stops it.
    """
    scene.add_avatar(PROBE, [[0.0, 0.0, 0.0]], RADIUS)
    first, last = np.tile(np.eye(4), (2, len(walls.points), 1, 1))
    first[:, :3, 3] = walls.points + START * walls.normals
    last[:, :3, 3] = walls.points - RADIUS * walls.normals
    answers = scene.sweep(
        PROBE,
        first,
        last,
        tolerance=max(tolerance, FINEST),
        budget_visits=budget_visits,
        radius_model=radius_model,
    )
    way = START + RADIUS
    depth: NDArray[np.float64] = RADIUS - START + answers.lower * way
    return np.where(answers.verdict == Verdict.CLEAR, 2 * RADIUS, np.minimum(depth, 2 * RADIUS))
