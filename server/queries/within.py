"""Query `within`: the scan point nearest to each query point."""

import time
from functools import cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...schemas.archive.units import UNITS_PER_METRE
from ...schemas.errors import BadRequestError
from ...schemas.wire.answers import WithinAnswers
from ..avatars.avatar_model import AvatarModel, make_avatar
from ..kernels.core.placed_avatar import MAX_REACH_UNITS
from ..kernels.core.voxel_tree import VoxelLists
from ..kernels.rays.rays import ClosestHits
from ..kernels.rays.within_point import search_points
from .context.front_to_back import make_best, make_origins, search_front_to_back, verdict_and_bounds
from .context.level_hits import HitsByLevel, LevelHits, found_units
from .context.level_of_detail import without_radii
from .context.query_budget import EXACT, CostCounter, QueryBudget
from .context.query_context import LevelOfDetail, SceneData, to_units
from .distance import search_level


def within(data: SceneData, points: ArrayLike, reach: float, budget: QueryBudget = EXACT) -> WithinAnswers:
    """Find the scan point nearest to each of k query points, centre to centre, ignoring radii.

    points: (k, 3) float64, world [m].  reach: inclusive [m], at most 16.
    kernels/rays/within_point.py has the definition. A point is `outside` if its reach, a cube of
    exact units, leaves the box of all scan points. Verdicts, bounds and budget are as for
    `raycast`. With a tolerance, or a relative one, the scan point found may be farther than the
    nearest one by as much as it allows. Raise BadRequestError.
    """
    spent = CostCounter(time.perf_counter(), data.residency, data.broad.keys)
    world, units = make_origins(data, points, "points")
    reach_units = to_units(reach, "reach")
    if reach_units > MAX_REACH_UNITS:
        raise BadRequestError(f"reach {reach!r}: expected at most 16 m: larger squares do not fit in 63 bits")
    tolerance = budget.between_bounds * UNITS_PER_METRE
    # Nothing nearer than a share 1 / (1 + e) of a distance: this leaves it within e of the nearest.
    share = budget.relative / (1.0 + budget.relative) * (1.0 - 1e-12)

    def kernel(
        first: int,
        last: int,
        lists: VoxelLists,
        cursor: NDArray[np.int64],
        held: NDArray[np.bool_],
        best: ClosestHits,
    ) -> None:
        search_points(
            units[first:last],
            reach_units,
            lists,
            cursor,
            held,
            data.arrays,
            tolerance,
            share,
            budget.visits,
            best,
        )

    def ask(level: LevelOfDetail, which: NDArray[np.int64]) -> LevelHits:
        return ask_level(data, level, world[which], units[which], reach_units, budget, spent)

    level = HitsByLevel(data, len(units), reach_units, budget, (tolerance, budget.relative), ask)
    best = search_front_to_back(data, units, None, reach_units, 0, budget, kernel, spent, level)
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


def ask_level(
    data: SceneData,
    level: LevelOfDetail,
    world: NDArray[np.float64],
    units: NDArray[np.int64],
    reach_units: int,
    budget: QueryBudget,
    spent: CostCounter,
) -> LevelHits:
    """Bound the distances of points from the scene by those from its level, as of an avatar of one point.

    world, units: (n, 3) points, world [m] and exact units.
    """
    poses = np.tile(np.eye(4), (len(world), 1, 1))
    poses[:, :3, 3] = world
    bare = without_radii(level, data.radius_units)
    near = min(reach_units, MAX_REACH_UNITS - bare.covers.radius_units)
    found = search_level(bare, _one_point(), poses, near, budget, spent)
    best = make_best(len(world))
    best.lattice[:] = found.pairs.pair[:, :3]
    away = np.rint(best.lattice * data.arrays.units_per_step).astype(np.int64) - units
    square = (away * away).sum(axis=1)
    near_enough = (found.pairs.square >= 0) & (square <= reach_units**2)
    best.square[near_enough] = square[near_enough]
    return LevelHits(best, found.lower)


@cache
def _one_point() -> AvatarModel:
    return make_avatar(np.zeros((1, 3)), 0.0)
