"""Query `within`: the scan point nearest to each query point."""

import math
import time

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...schemas.archive.units import UNITS_PER_METRE
from ...schemas.errors import BadRequestError
from ...schemas.wire.answers import WithinAnswers
from ..kernels.core.placed_avatar import MAX_REACH_UNITS
from ..kernels.core.voxel_tree import VoxelLists
from ..kernels.rays.rays import ClosestHits
from ..kernels.rays.within_point import bound_points, search_points
from .context.front_to_back import make_origins, search_front_to_back, verdict_and_bounds
from .context.level_hits import HitsByLevel, LevelHits, found_units
from .context.level_of_detail import level_budget
from .context.query_budget import EXACT, CostCounter, QueryBudget
from .context.query_context import LevelOfDetail, SceneData, to_units, with_stop


def within(data: SceneData, points: ArrayLike, reach: float, budget: QueryBudget = EXACT) -> WithinAnswers:
    """Find the scan point nearest to each of k query points, centre to centre, ignoring radii.

    points: (k, 3) float64, world [m].  reach: inclusive [m], at most 16.
    kernels/rays/within_point.py has the definition. A point is `outside` if its reach, a cube of
    exact units, leaves the box of all scan points. Verdicts, bounds and budget are as for
    `raycast`. With a tolerance, or a relative one, the scan point found may be farther than the
    nearest one by as much as it allows. Raise BadRequestError.
    """
    spent = CostCounter(time.perf_counter(), data.residency, data.broad.keys)
    data = with_stop(data, budget.stop)
    _, units = make_origins(data, points, "points")
    reach_units = to_units(reach, "reach")
    if reach_units > MAX_REACH_UNITS:
        raise BadRequestError(f"reach {reach!r}: expected at most 16 m: larger squares do not fit in 63 bits")

    def ask(level: LevelOfDetail, which: NDArray[np.int64]) -> LevelHits:
        return ask_level(level, data.radius_units, units[which], reach_units, budget, spent)

    allowed = budget.between_bounds * UNITS_PER_METRE, budget.relative
    level = HitsByLevel(data, len(units), reach_units, budget, allowed, ask)
    best = _nearest(data, units, reach_units, budget, spent, level)
    verdict, lower, upper, exact = verdict_and_bounds(found_units(best), best.unseen, reach_units)
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


def _nearest(
    data: SceneData,
    units: NDArray[np.int64],
    reach_units: int,
    budget: QueryBudget,
    spent: CostCounter,
    level: HitsByLevel | None = None,
) -> ClosestHits:
    """Return the scan points nearest to points (k, 3)."""
    tolerance = budget.between_bounds * UNITS_PER_METRE
    # Nothing nearer than 1 / (1 + e) of a distance: this leaves it within the share e of the nearest.
    share = budget.relative / (1.0 + budget.relative) * (1.0 - 1e-12)

    def kernel(
        first: int,
        last: int,
        lists: VoxelLists,
        cursor: NDArray[np.int64],
        held: NDArray[np.bool_],
        best: ClosestHits,
    ) -> None:
        part = units[first:last]
        search_points(part, reach_units, lists, cursor, held, data.arrays, tolerance, share, best)

    return search_front_to_back(data, units, None, reach_units, 0, budget, kernel, spent, level)


def ask_level(
    level: LevelOfDetail,
    radius_units: int,
    units: NDArray[np.int64],
    reach_units: int,
    budget: QueryBudget,
    spent: CostCounter,
) -> LevelHits:
    """Bound the distances of points (n, 3) from a scene by those from its level.

    radius_units: of the scene's largest sphere, for which the level's cover spheres are made.
    """
    exact, own = level_budget(budget), spent.of_level(level.covers.residency)
    covers, least = level.covers, float(level.covers.radius_units - radius_units)

    def bound(
        first: int,
        last: int,
        lists: VoxelLists,
        cursor: NDArray[np.int64],
        held: NDArray[np.bool_],
        best: ClosestHits,
    ) -> None:
        bound_points(units[first:last], reach_units, least, lists, cursor, held, covers.arrays, best)

    # Points of the scene may lie outside of the boxes around their representatives.
    covered = search_front_to_back(covers, units, None, reach_units + math.ceil(least), 0, exact, bound, own)
    best = _nearest(level.points, units, reach_units, exact, own)
    spent.add_level(own)
    lower = np.minimum(covered.value - 1.0, covered.unseen - least)
    return LevelHits(best, np.maximum(lower, 0.0))
