"""Sample places on the walls of a generated façade, with the scan density there, from the truth alone.

The density on a wall decreases from near to far and from perpendicular to grazing incidence.
`wall_places` draws places with sparse and dense ones equally represented, and omits places that no
station sees: no radius closes a shadow.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...schemas.errors import BadDataError
from .facade import build_facade
from .scanner import GRAZING, HIGHEST, LOWEST, RayScene, ScannerPose
from .truth import FacadeTruth, SceneTruth, StationTruth, WallTruth

# Ratio of the largest to the smallest spacing: 24 to 96 mm on the façade of the paper's size.
# Sparser places are seen only through the doors, at a grazing angle.
SPACING_RATIO = 4.0
# A wall counts as seen where it is visible all around at this distance [m]: a probe of 5 cm then
# meets this wall and nothing else.
RING_RADIUS = 0.15
# Places drawn on each wall to compute their density: enough for 2,000 distinct ones among the few
# sparsest.
WALL_SAMPLES = 40_000
# Candidates per wanted place, because the wall is hidden around some of them.
DRAWS_A_PLACE = 3
# Maximum distance between a ray's hit and the place it is cast at [m]: rays are cast in float32.
HIT_TOLERANCE = 0.003


class WallPlaces(NamedTuple):
    """Places on walls, world frame.

    points: (k, 3) on the true surface [m].
    normals: (k, 3), outward.
    spacing: (k,) the spacing of scan points that the scanner's geometry gives there [m]: 1 over the
    square root of the points per square metre.
    """

    points: NDArray[np.float64]
    normals: NDArray[np.float64]
    spacing: NDArray[np.float64]


def wall_places(truth: SceneTruth, places: int = 2000, seed: int = 2012) -> WallPlaces:
    """Return exactly `places` places on the walls of the first façade.

    Their spacings are distributed evenly by logarithm, up to SPACING_RATIO times the least. The same truth
    and seed give the same places. Raises BadDataError where the stations see too few places on the
    walls.
    """
    facade = truth.facades[0]
    rays = RayScene(build_facade(facade.seed, facade.door("main").width).mesh)
    rng = np.random.default_rng([seed, 0x9A7E])
    samples = [_visible_samples(rays, facade, truth.stations, wall, rng) for wall in facade.walls]
    points, normals, spacing = (np.concatenate(column) for column in zip(*samples, strict=True))
    order = np.argsort(spacing, kind="stable")
    if len(order):
        wanted = spacing[order[0]] * SPACING_RATIO ** rng.uniform(size=DRAWS_A_PLACE * places)
        drawn = order[np.searchsorted(spacing[order], wanted, side="right") - 1]
        # Each once, in the order drawn.
        drawn = drawn[np.sort(np.unique(drawn, return_index=True)[1])]
        ring = points[drawn, None] + _ring(normals[drawn])
        axes = np.abs(normals[drawn]).argmax(axis=1)[:, None]
        around = np.zeros(ring.shape[:2])
        for station in truth.stations:
            around += _density(rays, facade, station, ring, axes)
        order = drawn[(around > 0).all(axis=1)][:places]
    if len(order) < places:
        raise BadDataError(
            f"the stations of the façade see {len(order)} places on its walls: expected {places}: request fewer"
        )
    return WallPlaces(points[order] + np.asarray(facade.origin), normals[order], spacing[order])


def _visible_samples(
    rays: RayScene,
    facade: FacadeTruth,
    stations: tuple[StationTruth, ...],
    wall: WallTruth,
    rng: np.random.Generator,
) -> WallPlaces:
    """Draw places evenly over one wall, in the façade's frame; return those that a station sees."""
    axis = "xy".index(wall.axis)
    points = np.empty((WALL_SAMPLES, 3))
    points[:, axis] = wall.offset
    points[:, 1 - axis] = rng.uniform(wall.low + RING_RADIUS, wall.high - RING_RADIUS, WALL_SAMPLES)
    points[:, 2] = rng.uniform(wall.z_low + RING_RADIUS, wall.z_high - RING_RADIUS, WALL_SAMPLES)
    density = np.zeros((WALL_SAMPLES, 1))
    for station in stations:
        density += _density(rays, facade, station, points[:, None], np.array([[axis]]))
    seen = density[:, 0] > 0
    normal = np.zeros(3)
    normal[axis] = wall.facing
    return WallPlaces(points[seen], np.tile(normal, (int(seen.sum()), 1)), density[seen, 0] ** -0.5)


def _ring(normals: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return eight offsets (k, 8, 3) [m] of length RING_RADIUS in the planes of normals (k, 3) along x or y."""
    turn = np.arange(8) * np.pi / 4
    level = np.stack([-normals[:, 1], normals[:, 0], np.zeros(len(normals))], axis=1)
    up = np.array([0.0, 0.0, 1.0])
    return RING_RADIUS * (np.cos(turn)[:, None] * level[:, None] + np.sin(turn)[:, None] * up)


def _density(
    rays: RayScene,
    facade: FacadeTruth,
    station: StationTruth,
    points: NDArray[np.float64],
    axes: NDArray[np.int64],
) -> NDArray[np.float64]:
    """Return the points per square metre (c, e) of a station at points (c, e, 3); 0 where hidden.

    axes: (c, 1) or (1, 1), the axis perpendicular to the plane of a point.
    """
    position = np.subtract(station.position, facade.origin)
    x, y, z = position.tolist()
    displacement = points - position
    reach = np.linalg.norm(displacement, axis=-1)
    elevation = np.arcsin(displacement[..., 2] / reach)
    azimuth = np.arctan2(displacement[..., 1], displacement[..., 0]) - station.yaw
    returns = rays.cast(ScannerPose((x, y, z), station.yaw), azimuth, elevation)
    cosine = np.abs(np.take_along_axis(displacement, axes[..., None], axis=2)[..., 0]) / reach
    seen = (np.abs(returns.range - reach) < HIT_TOLERANCE) & (cosine > GRAZING)
    seen &= (elevation > LOWEST) & (elevation < HIGHEST)
    # A ray covers a solid angle of step² cos(elevation); a square metre at this place covers cosine
    # / reach² of it.
    return np.where(seen, cosine / (reach * reach * station.step**2 * np.cos(elevation)), 0.0)
