"""Query `raycast`: the first scan point's sphere that each ray hits."""

import math
import time

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...schemas.archive.units import UNITS_PER_METRE
from ...schemas.errors import BadRequestError
from ...schemas.wire.answers import RaycastAnswers
from ...schemas.wire.requests import make_vectors
from ..kernels.core.placed_avatar import MAX_REACH_UNITS
from ..kernels.rays.hits import ClosestHits, HitBatch
from .context.query_budget import EXACT, CostCounter, QueryBudget
from .context.query_context import SceneData, to_units
from .nearest_hits import find_hits, leaves_scene, make_origins
from .resolve import Steps, run

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
    kernels/rays/hits.py has the definition. A ray is `outside` if either of its ends, o or
    o + reach u in exact units, leaves the box of all scan points.
    The verdict is CONTACT if a sphere is hit, CLEAR if none is, and UNKNOWN if none was found but
    something in reach was not examined. If that could hide a nearer hit, `exact` is false and `lower`
    bounds its distance. Raise BadRequestError.
    """
    spent = CostCounter(time.perf_counter(), data.residency, data.keys)
    world, units = make_origins(data, origins, "origins")
    unit = make_directions(directions)
    if len(world) != len(unit):
        raise BadRequestError(f"{len(world)} origins and {len(unit)} directions: expected equal numbers")
    if not 0 <= reach <= MAX_RAY_REACH:
        raise BadRequestError(f"reach {reach!r}: expected 0 to {MAX_RAY_REACH:g} metres")
    if data.radius_units > MAX_REACH_UNITS:
        raise BadRequestError("the scan's radius is over 16 m: rays cannot be tested exactly against it")
    reach_units = to_units(reach, "reach")
    hit: NDArray[np.float64] = np.full((len(world), 3), math.nan)
    normal: NDArray[np.float64] = np.full((len(world), 3), math.nan)

    def on_hits(which: NDArray[np.int64], best: ClosestHits) -> None:
        """Write origin + distance u, and the normal along t u - d, from the sphere's centre to the hit.

        It is opposite to the ray if these coincide.
        """
        t, u = best.value[:, None], unit[which]
        hit[which] = world[which] + (t / UNITS_PER_METRE) * u
        d = np.rint(best.lattice * data.arrays.units_per_step).astype(np.int64) - units[which]
        away = t * u - d
        length = np.sqrt((away * away).sum(axis=1))[:, None]
        normal[which] = np.where(length > 0, away / np.where(length > 0, length, 1.0), -u)

    outside = leaves_scene(data, units.astype(np.float64), units + float(reach_units) * unit)
    rays = HitBatch(units, unit, reach_units, data.radius_units)
    hits = yield from find_hits(data, rays, budget, spent, on_hits)
    return RaycastAnswers(
        hits.verdict, hits.distance, hits.lower, hits.distance.copy(), hits.exact, hit, hits.cloud, normal, outside,
        *hits.counts, **spent.fields(),
    )  # fmt: skip
