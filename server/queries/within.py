"""Query `within`: the scan point nearest to each query point."""

import numpy as np
from numpy.typing import ArrayLike

from ...schemas.errors import BadRequestError
from ...schemas.wire.answers import WithinAnswers
from ..kernels.core.placed_avatar import MAX_REACH_UNITS
from ..kernels.rays.hits import HitBatch
from .nearest_hits import find_hits, leaves_scene, make_origins
from .request import EXACT, CostCounter, QueryBudget
from .resolve import Steps, run
from .scene_data import SceneData, to_units


def within(data: SceneData, points: ArrayLike, reach: float, budget: QueryBudget = EXACT) -> WithinAnswers:
    """Answer `within`; see `within_steps`."""
    return run(within_steps(data, points, reach, budget))


def within_steps(
    data: SceneData, points: ArrayLike, reach: float, budget: QueryBudget
) -> Steps[WithinAnswers]:
    """Find the scan point nearest to each of k query points, centre to centre, ignoring radii.

    points: (k, 3) float64, world [m].  reach: inclusive [m], at most 16.
    kernels/rays/hits.py has the definition. A point is `outside` if its reach, a cube of exact
    units, leaves the box of all scan points. Verdicts and bounds are as for `raycast`.
    Raise BadRequestError.
    """
    spent = CostCounter(data)
    _, units = make_origins(data, points, "points")
    reach_units = to_units(reach, "reach")
    if reach_units > MAX_REACH_UNITS:
        raise BadRequestError(f"reach {reach!r}: expected at most 16 m: larger squares do not fit in 63 bits")
    outside = leaves_scene(data, units - reach_units, units + reach_units)
    hits = yield from find_hits(data, HitBatch(units, np.empty((0, 3)), reach_units, 0), budget, spent)
    return WithinAnswers(
        hits.verdict, hits.distance, hits.lower, hits.distance.copy(), hits.exact, hits.cloud, outside,
        *hits.counts, **spent.fields(),
    )  # fmt: skip
