"""Query `distance`: distance of an avatar from the scene, and the nearest pair.

signed_distance.py has the definition.
"""

import math
import time
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...schemas.archive.units import UNITS_PER_METRE
from ...schemas.wire.answers import DistanceAnswers
from ..avatars.avatar_model import AvatarModel
from ..kernels.core.voxels_in_reach import VoxelsInReach
from ..kernels.nearest.nearest_pair import NearestPairs
from ..kernels.nearest.nearest_search import nearest_poses
from .context.late_voxels import drop_proved_voxels
from .context.level_of_detail import SettledPoses, ask_after_deadline, level_budget
from .context.query_budget import EXACT, CostCounter, QueryBudget
from .context.query_context import (
    LevelOfDetail,
    SceneData,
    as_held,
    find_proved_reach,
    kernel_poses,
    pieces,
    to_units,
    with_voxels,
)
from .context.signed_distance import distance_columns, unknown_gaps
from .context.unloaded_voxels import bound_missing

# Rounding of square roots and of placed points in a bound [exact units].
_ROUNDING = 4.0
# Conversion to metres widens bounds by some exact units; a smaller tolerance has no effect.
_TOLERANCE_SLACK = 8.0


def distance(
    data: SceneData, avatar: AvatarModel, poses: ArrayLike, reach: float, budget: QueryBudget = EXACT
) -> DistanceAnswers:
    """Compute the distance of the avatar from the scene under each pose, up to `reach` [m].

    poses: (k, 4, 4) float64, avatar to world, rigid or with a uniform scale.
    reach: pairs whose spheres are farther apart than this do not count; reach and largest radii
    together are at most 16 m.
    budget: with a tolerance, the pair found may be farther than the nearest one by as much as it
    allows; `lower` and `upper` then bound the distance.
    If a voxel in reach is missing, a scan was left out or the deadline passed, the distance is that
    of the nearest examined pair, and exact only if nothing that was not examined can contain a
    nearer pair. Raise BadRequestError, BadTransformError, TooLargeError.
    """
    begin = time.perf_counter()
    array = kernel_poses(poses)
    reach_units = to_units(reach, "reach")
    spent = CostCounter(begin, data.residency, data.broad.keys)
    found = no_pairs(len(array))

    one_radius = len(data.arrays.radius_deficit) == 1  # the level does not know the radius of its points

    def ask(level: LevelOfDetail, which: NDArray[np.int64]) -> NDArray[np.bool_]:
        if not one_radius:
            return np.zeros(len(which), bool)
        of_level = _search_level(level, avatar, array[which], reach_units, budget, spent)
        settled = _settled(of_level, reach_units, budget)
        for column, own in zip(found, of_level.pairs, strict=True):
            column[which[settled]] = own[settled]
        return settled

    by_level = SettledPoses(data, array, budget, ask)
    settled: Callable[[VoxelsInReach], VoxelsInReach] = by_level.drop
    if budget.late is not None:
        settled = drop_proved_voxels(data, avatar, array, reach_units, budget)
    nearest, counts, around = _pairs(data, avatar, array, reach_units, budget, spent, settled)
    for column, own in zip(nearest, found, strict=True):
        column[by_level.settled] = own[by_level.settled]
    open_ = (nearest.missing_bound < np.inf) & ((counts[0] > 0) | bool(budget.stop))
    which = np.flatnonzero(open_)
    if one_radius and len(which):

        def ask_late(level: LevelOfDetail, own: QueryBudget) -> NearestPairs:
            return _search_level(level, avatar, array[which], reach_units, own, spent).pairs

        late = ask_after_deadline(data, budget, ask_late)
        if late is not None:
            _narrow(nearest, which, late)
    if len(avatar.points):
        np.minimum(nearest.missing_bound, unknown_gaps(data, around), out=nearest.missing_bound)
    return DistanceAnswers(
        **distance_columns(data, around, float(reach), reach_units, nearest, counts),
        **spent.fields(),
    )


def no_pairs(k: int) -> NearestPairs:
    """Return the pairs of k poses before any is found: none, and nothing missing."""
    return NearestPairs(
        np.full(k, -1, np.int64), np.zeros((k, 6), np.int64), np.zeros(k, np.int64), np.full(k, math.inf)
    )


def _pairs(
    data: SceneData,
    avatar: AvatarModel,
    poses: NDArray[np.float64],
    reach_units: int,
    budget: QueryBudget,
    spent: CostCounter,
    settled: Callable[[VoxelsInReach], VoxelsInReach] = lambda reach: reach,
) -> tuple[NearestPairs, NDArray[np.uint32], VoxelsInReach]:
    """Return nearest pairs, counts (3, k) and reach of poses (k, 4, 4).

    Regions that were left out are not considered. settled: see `find_proved_reach`.
    """
    k, residency = len(poses), data.residency
    around = find_proved_reach(data, avatar, poses, data.radius_units + reach_units, budget, spent, settled)
    nearest, counts = no_pairs(k), np.zeros((3, k), np.uint32)
    tolerance = max(0.0, budget.between_bounds * UNITS_PER_METRE - _TOLERANCE_SLACK)
    if not len(avatar.points):
        return nearest, counts, around
    for which, rows, part in pieces(around, residency, budget.share, budget.stop):
        if budget.stop:
            nearest.missing_bound[with_voxels(part, which)] = 0.0
            continue
        with residency.hold(rows, budget.loads_until(), scan=budget.scan, stop=budget.stop) as held:
            seen = as_held(data, held, budget)
            own = bound_missing(seen, held, avatar, poses, part, which, nearest.missing_bound, counts, budget)
            nearest_poses(
                poses,
                avatar.arrays,
                seen.arrays,
                data.broad,
                own,
                reach_units,
                which,
                budget.relative,
                tolerance,
                nearest,
                counts,
            )
        spent.add(held)
    return nearest, counts, around


class _LevelDistances(NamedTuple):
    """Result of a search of the level for k poses.

    pairs: the nearest representatives; their `missing_bound` is `lower` in steps.
    nearest, lower: (k,) float64, upper and lower bound of the distance between the avatar's centres
    and those of the scene [exact units]; inf: no pair within reach.
    radii: (k,) int64, sum of the radii of avatar and scene, exact units.
    reach: of the cover spheres.
    """

    pairs: NearestPairs
    nearest: NDArray[np.float64]
    lower: NDArray[np.float64]
    radii: NDArray[np.int64]
    reach: VoxelsInReach


def _search_level(
    level: LevelOfDetail,
    avatar: AvatarModel,
    poses: NDArray[np.float64],
    reach_units: int,
    budget: QueryBudget,
    spent: CostCounter,
) -> _LevelDistances:
    """Search the level of a scene with a single radius under poses (k, 4, 4)."""
    exact, own = level_budget(budget), spent.of_level(level.covers.residency)
    covered, _, reach = _pairs(level.covers, avatar, poses, reach_units, exact, own)
    np.minimum(covered.missing_bound, unknown_gaps(level.covers, reach), out=covered.missing_bound)
    pairs, _, _ = _pairs(level.points, avatar, poses, reach_units, exact, own)
    spent.add_level(own)
    # All points lie within the cover radius of a representative, also those of voxels of the level
    # that are missing.
    covers, scene = level.covers.radius_units, level.points.radius_units
    beyond, nearest = _lengths(covered), _lengths(pairs)
    lower = beyond - (covers - covered.deficit) + scene
    missing = covered.missing_bound * level.covers.arrays.units_per_step - covers + scene
    lower = np.maximum(np.minimum(lower, missing) - _ROUNDING, 0.0)
    pairs.deficit[:] = 0
    pairs.missing_bound[:] = lower / level.covers.arrays.units_per_step * (1.0 - 1e-12)
    radii = reach.units - reach_units - covers + scene
    return _LevelDistances(pairs, nearest, lower, radii, reach)


def _lengths(pairs: NearestPairs) -> NDArray[np.float64]:
    """Return the distances of pairs (k,) [exact units]; inf for none."""
    square = np.where(pairs.square >= 0, pairs.square.astype(np.float64), np.inf)
    return np.asarray(np.sqrt(square), np.float64)


def _settled(found: _LevelDistances, reach_units: int, budget: QueryBudget) -> NDArray[np.bool_]:
    """Return which poses (k,) the level answers within the tolerance, or without any pair in reach."""
    with np.errstate(invalid="ignore"):  # no pair within reach: inf - inf, or no share of inf
        allowed = np.fmax(budget.between_bounds * UNITS_PER_METRE, budget.relative * found.lower)
        near = found.nearest - found.lower <= allowed - _TOLERANCE_SLACK
    return np.where(np.isfinite(found.nearest), near, found.lower > found.radii + reach_units)


def _narrow(nearest: NearestPairs, which: NDArray[np.int64], found: NearestPairs) -> None:
    """Narrow the bounds of the poses `which` by what the level knows of them; one radius."""
    known = nearest.square[which]
    nearer = (found.square >= 0) & ((known < 0) | (found.square < known))
    nearest.square[which[nearer]] = found.square[nearer]
    nearest.pair[which[nearer]] = found.pair[nearer]
    nearest.missing_bound[which] = np.maximum(nearest.missing_bound[which], found.missing_bound)
