"""Query `within`: the scan point nearest to each query point."""

import time

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...schemas.errors import BadRequestError
from ...schemas.wire.answers import WithinAnswers
from ..kernels.core.placed_avatar import MAX_REACH_UNITS
from .context.front_to_back import make_origins, search_front_to_back, verdict_and_bounds
from .context.query_budget import EXACT, CostCounter, QueryBudget
from .context.query_context import SceneData, to_units


def within(data: SceneData, points: ArrayLike, reach: float, budget: QueryBudget = EXACT) -> WithinAnswers:
    """Find the scan point nearest to each of k query points, centre to centre, ignoring radii.

    points: (k, 3) float64, world [m].  reach: inclusive [m], at most 16.
    kernels/rays/points.py has the definition. A point is `outside` if its reach, a cube of
    exact units, leaves the box of all scan points. Verdicts, bounds and budget are as for
    `raycast`. Raise BadRequestError.
    """
    spent = CostCounter(time.perf_counter(), data.residency, data.broad.keys)
    _, units = make_origins(data, points, "points")
    reach_units = to_units(reach, "reach")
    if reach_units > MAX_REACH_UNITS:
        raise BadRequestError(f"reach {reach!r}: expected at most 16 m: larger squares do not fit in 63 bits")
    best = search_front_to_back(data, units, None, reach_units, budget, spent)
    verdict, lower, upper, exact = verdict_and_bounds(best, reach_units)
    cloud: NDArray[np.float64] = np.full((len(units), 3), np.nan)
    touched = best.square >= 0
    cloud[touched] = best.lattice[touched] * data.arrays.step + data.arrays.origin
    low, high = (
        np.rint(b * data.arrays.units_per_step).astype(np.int64)
        for b in (data.broad.scene_low, data.broad.scene_high)
    )
    outside = ((units - reach_units < low) | (units + reach_units > high)).any(axis=1)
    return WithinAnswers(
        verdict, upper, lower, upper.copy(), exact, cloud, outside, *best.counts,
        **spent.fields(),
    )  # fmt: skip
