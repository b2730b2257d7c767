"""Query `raycast`: the first scan point's sphere that each ray hits."""

import time

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...schemas.archive.units import UNITS_PER_METRE
from ...schemas.errors import BadRequestError
from ...schemas.wire.answers import RaycastAnswers
from ...schemas.wire.requests import make_vectors
from ..kernels.core.placed_avatar import MAX_REACH_UNITS
from ..kernels.core.voxel_tree import VoxelLists
from ..kernels.rays.level_rays import bound_rays
from ..kernels.rays.rays import ClosestHits, RayBatch, follow_rays
from .context.front_to_back import make_origins, search_front_to_back, verdict_and_bounds
from .context.level_hits import HitsByLevel, LevelHits
from .context.level_of_detail import level_budget
from .context.query_budget import EXACT, CostCounter, QueryBudget
from .context.query_context import LevelOfDetail, SceneData, to_units, with_stop

# A cover sphere is larger by this [exact units]: more than the rounding of m on any ray (rays.py), so
# that the first of them is hit no later than any sphere within it, but for the rounding of s.
_ROUNDING = 8
# Differences within this reach [m] are exact in float64: 2^53 units are 134,000 km.
MAX_RAY_REACH = 1e6


def make_directions(values: ArrayLike) -> NDArray[np.float64]:
    """Normalize vectors (k, 3) in float64.

    Each is divided by its largest component, then by the square root of (x x + y y) + z z. Raise
    BadRequestError for a vector that is zero or not finite.
    """
    array = make_vectors(values, "directions")
    largest = np.abs(array).max(axis=1, initial=0.0)
    if (largest == 0.0).any():
        raise BadRequestError(f"direction {int(np.argmin(largest))} is zero: expected a vector of any length")
    scaled = array / largest[:, None]
    x, y, z = scaled.T
    return np.ascontiguousarray(scaled / np.sqrt((x * x + y * y) + z * z)[:, None])


def raycast(
    data: SceneData, origins: ArrayLike, directions: ArrayLike, reach: float, budget: QueryBudget = EXACT
) -> RaycastAnswers:
    """Find the first sphere of the scan that each ray hits; the radius model gives each radius.

    origins: (k, 3) float64, world [m].  directions: (k, 3), of any length except zero.
    reach: length of the rays [m], at most MAX_RAY_REACH.
    kernels/rays/rays.py has the definition. A ray is `outside` if either of its ends, o or
    o + reach u in exact units, leaves the box of all scan points.
    The verdict is CONTACT if a sphere is hit, CLEAR if none is, and UNKNOWN if none was found but
    something in reach could not be examined in time. If that could hide a nearer
    hit, `exact` is false and `lower` bounds its distance. With a tolerance, `lower` may be below
    `upper` by at most the tolerance, and the scene's level of detail answers rays whose voxels are
    not in memory, if it knows them that well. Raise BadRequestError.
    """
    spent = CostCounter(time.perf_counter(), data.residency, data.broad.keys)
    data = with_stop(data, budget.stop)
    world, units = make_origins(data, origins, "origins")
    unit = make_directions(directions)
    if len(world) != len(unit):
        raise BadRequestError(f"{len(world)} origins and {len(unit)} directions: expected equal numbers")
    if not 0 <= reach <= MAX_RAY_REACH:
        raise BadRequestError(f"reach {reach!r}: expected 0 to {MAX_RAY_REACH:g} metres")
    reach_units = to_units(reach, "reach")

    def ask(level: LevelOfDetail, which: NDArray[np.int64]) -> LevelHits:
        return ask_level(level, units[which], unit[which], reach_units, budget, spent)

    allowed = budget.tolerance * UNITS_PER_METRE, 0.0
    level = HitsByLevel(data, len(units), reach_units, budget, allowed, ask)
    best = _first_hits(data, units, unit, reach_units, budget, spent, level)
    verdict, lower, upper, exact = verdict_and_bounds(best.value, best.unseen, reach_units)
    hit, cloud, normal = _where(data, world, units, unit, best)
    ends = np.stack([units.astype(np.float64), units + float(reach_units) * unit])
    low, high = (
        np.rint(b * data.arrays.units_per_step) for b in (data.broad.scene_low, data.broad.scene_high)
    )
    return RaycastAnswers(
        verdict, upper, lower, upper.copy(), exact, hit, cloud, normal,
        ((ends < low) | (ends > high)).any(axis=(0, 2)), *best.counts,
        **spent.fields(),
    )  # fmt: skip


def _first_hits(
    data: SceneData,
    units: NDArray[np.int64],
    unit: NDArray[np.float64],
    reach_units: int,
    budget: QueryBudget,
    spent: CostCounter,
    level: HitsByLevel | None = None,
    covers: bool = False,
) -> ClosestHits:
    """Return the first hits of rays from `units` (k, 3) along unit vectors (k, 3).

    covers: the data are cover spheres, and `value` of the result bounds the hits from below.
    """
    if data.radius_units > MAX_REACH_UNITS:
        raise BadRequestError("the scan's radius is over 16 m: rays cannot be tested exactly against it")
    tolerance = budget.tolerance * UNITS_PER_METRE

    def kernel(
        first: int,
        last: int,
        lists: VoxelLists,
        cursor: NDArray[np.int64],
        held: NDArray[np.bool_],
        best: ClosestHits,
    ) -> None:
        rays = RayBatch(units[first:last], unit[first:last], reach_units, data.radius_units)
        if covers:
            bound_rays(rays, lists, cursor, held, data.arrays, best)
        else:
            follow_rays(rays, lists, cursor, held, data.arrays, tolerance, best)

    return search_front_to_back(
        data, units, unit, reach_units, data.radius_units, budget, kernel, spent, level
    )


def ask_level(
    level: LevelOfDetail,
    units: NDArray[np.int64],
    unit: NDArray[np.float64],
    reach_units: int,
    budget: QueryBudget,
    spent: CostCounter,
) -> LevelHits:
    """Bound the first hits of rays by those of the level's cover spheres and representatives.

    A ray hits a representative's own sphere no later than the smallest sphere of the scene around
    it: all values of the definition rise or fall with the radius, rounded or not.
    """
    exact, own = level_budget(budget), spent.of_level(level.covers.residency)
    covers = level.covers._replace(radius_units=level.covers.radius_units + _ROUNDING)
    covered = _first_hits(covers, units, unit, reach_units, exact, own, covers=True)
    best = _first_hits(level.points, units, unit, reach_units, exact, own)
    spent.add_level(own)
    lower = np.minimum(covered.value - 1.0, covered.unseen)
    return LevelHits(best, np.maximum(lower, 0.0))


def _where(
    data: SceneData,
    world: NDArray[np.float64],
    units: NDArray[np.int64],
    unit: NDArray[np.float64],
    best: ClosestHits,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return hit, cloud_point and normal (k, 3); NaN for rays that hit nothing.

    hit: origin + distance u, world [m].
    normal: along t u - d in exact units, from the sphere's centre to the hit; opposite to the ray
    if they coincide.
    """
    touched = np.isfinite(best.value)
    hit, cloud, normal = (np.full((len(world), 3), np.nan) for _ in range(3))
    t, u, lattice = best.value[touched][:, None], unit[touched], best.lattice[touched]
    hit[touched] = world[touched] + (t / UNITS_PER_METRE) * u
    cloud[touched] = lattice * data.arrays.step + data.arrays.origin
    d = np.rint(lattice * data.arrays.units_per_step).astype(np.int64) - units[touched]
    away = t * u - d
    length = np.sqrt((away * away).sum(axis=1))[:, None]
    normal[touched] = np.where(length > 0, away / np.where(length > 0, length, 1.0), -u)
    return hit, cloud, normal
