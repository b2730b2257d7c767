"""Leak of a wall of scanned points: the depth that a spherical probe reaches before it is stopped.

The probe is pushed along the normal into places of the generated façade's walls, whose true surface
is known. At a hole of radius g between points of radius r, a probe of radius R touches first when
its foremost point is R - sqrt((R + r)² - g²) past the surface. If g is larger than R + r, it passes
through.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ....builder.synthetic.places import WallPlaces, wall_places
from ....builder.synthetic.truth import SceneTruth
from ....schemas.wire.answers import Verdict
from ...scene import Scene

PROBE = "leak probe"
RADIUS = 0.05
# Distance of the probe's centre from the wall at the start [m]: large enough for point radii of 25
# cm, and for tolerances of 10 cm with usual radii. The places are free of other surfaces for 15 cm
# to the sides.
START = 0.30
# Resolution of the first contact [m], unless a larger tolerance is given.
FINEST = 1e-6

__all__ = ["Leak", "WallPlaces", "leak", "leak_places"]


class Leak(NamedTuple):
    """Distribution over all places of the depth of the probe past the true surface.

    p50, p99, worst: [mm], negative before the surface. A probe that passes through counts as its
    diameter, the depth at which all of it is past the surface.
    passed: share of places where it passes through.
    """

    p50: float
    p99: float
    worst: float
    passed: float


def leak_places(truth: SceneTruth, places: int = 2000, seed: int = 2012) -> WallPlaces:
    """Return places on the façade's walls, from dense to four times as sparse.

    See builder/synthetic/places.py.
    """
    return wall_places(truth, places, seed)


def leak(
    scene: Scene,
    walls: WallPlaces,
    *,
    radius_model: str | None = None,
    tolerance: float = 0.0,
) -> Leak:
    """Measure the leak with a probe of 5 cm radius at every place.

    Adds the avatar "leak probe" to the scene. The other parameters are those of `Scene.sweep`.
    """
    depth = leak_depths(scene, walls, radius_model=radius_model, tolerance=tolerance)
    passed = depth >= 2 * RADIUS
    p50, p99 = np.percentile(depth, [50, 99]) * 1000
    return Leak(float(p50), float(p99), float(depth.max()) * 1000, float(passed.mean()))


def leak_depths(
    scene: Scene,
    walls: WallPlaces,
    *,
    radius_model: str | None = None,
    tolerance: float = 0.0,
) -> NDArray[np.float64]:
    """Return the depths (k,) past the true surface at which the probe is stopped [m].

    A depth is that of its foremost point.

    The probe is stopped where its motion is no longer proved clear. 2 RADIUS if nothing stops it.
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
        radius_model=radius_model,
    )
    way = START + RADIUS
    depth: NDArray[np.float64] = RADIUS - START + answers.lower * way
    return np.where(answers.verdict == Verdict.CLEAR, 2 * RADIUS, np.minimum(depth, 2 * RADIUS))
