"""Query `raycast`: the first scan point's sphere that each ray hits."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...schemas.archive.units import UNITS_PER_METRE
from ...schemas.errors import BadRequestError
from ...schemas.wire.answers import RaycastAnswers
from ...schemas.wire.requests import make_vectors
from ..kernels.core.placed_avatar import MAX_REACH_UNITS
from ..kernels.rays.rays import ClosestHits, follow_rays
from .nearest_hits import find_hits, make_origins, verdict_and_bounds
from .request import EXACT, CostCounter, QueryBudget
from .resolve import Steps, run
from .scene_data import SceneData, to_units

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
    """Answer `raycast`; see `raycast_steps`."""
    return run(raycast_steps(data, origins, directions, reach, budget))


def raycast_steps(
    data: SceneData, origins: ArrayLike, directions: ArrayLike, reach: float, budget: QueryBudget
) -> Steps[RaycastAnswers]:
    """Find the first sphere of the scan that each ray hits; the radius model gives each radius.

    origins: (k, 3) float64, world [m].  directions: (k, 3), of any length except zero.
    reach: length of the rays [m], at most MAX_RAY_REACH.
    kernels/rays/rays.py has the definition. A ray is `outside` if either of its ends, o or
    o + reach u in exact units, leaves the box of all scan points.
    The verdict is CONTACT if a sphere is hit, CLEAR if none is, and UNKNOWN if none was found but
    something in reach was not examined. If that could hide a nearer hit, `exact` is false and `lower`
    bounds its distance. Raise BadRequestError.
    """
    spent = CostCounter(data)
    world, units = make_origins(data, origins, "origins")
    unit = make_directions(directions)
    if len(world) != len(unit):
        raise BadRequestError(f"{len(world)} origins and {len(unit)} directions: expected equal numbers")
    if not 0 <= reach <= MAX_RAY_REACH:
        raise BadRequestError(f"reach {reach!r}: expected 0 to {MAX_RAY_REACH:g} metres")
    if data.radius_units > MAX_REACH_UNITS:
        raise BadRequestError("the scan's radius is over 16 m: rays cannot be tested exactly against it")
    reach_units = to_units(reach, "reach")
    best = yield from find_hits(data, follow_rays, units, unit, reach_units, data.radius_units, budget, spent)
    verdict, lower, upper, exact = verdict_and_bounds(best.value, best.unseen, reach_units)
    hit, cloud, normal = _where(data, world, units, unit, best)
    ends = np.stack([units.astype(np.float64), units + float(reach_units) * unit])
    low, high = np.rint(data.tree.scene * data.arrays.units_per_step)
    return RaycastAnswers(
        verdict, upper, lower, upper.copy(), exact, hit, cloud, normal,
        ((ends < low) | (ends > high)).any(axis=(0, 2)), *best.counts,
        **spent.fields(),
    )  # fmt: skip


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
