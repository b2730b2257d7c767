"""Query `distance`: distance of an avatar from the scene, and the nearest pair.

The definition uses the integers of NUMERICS.md N5. Let D2 = |a - b|^2 and r = r_a + r_b for a pair
of placed avatar centre a and scan point b, with the pair's own radii, each rounded once to exact
units. Of all pairs, take the one with the least separation sqrt(D2) - r, compared exactly. Its
signed distance is

    (D2 - r^2) / (sqrt(D2) + r) / 2^26 m

with the difference in int64 and the rest in float64, in this order; it is 0 if D2 and r are 0. This
equals sqrt(D2) - r without cancellation. It is negative if the spheres overlap, zero if they touch
and positive if they do neither. No pair has a smaller separation, so the signed distance is
positive exactly if no pair of spheres is in contact. If all scan points have the same radius, the
pair is that with the least D2.
"""

import math
import time

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...schemas.archive.units import UNITS_PER_METRE
from ...schemas.wire.answers import DistanceAnswers, Verdict
from ..avatars.avatar_model import AvatarModel
from ..kernels.core.reach import VoxelLists
from ..kernels.nearest.nearest_pair import NearestPairs
from ..kernels.nearest.nearest_search import (
    AVATAR,
    CLOUD,
    COLUMNS,
    LOWER,
    NORMAL,
    SIGNED,
    nearest_poses,
    nearest_resident,
    write_results,
)
from .collide import MAX_FAST_POINTS, search_resident
from .level_of_detail import ask_level, below, find_level, search_level
from .load_and_search import Search, Slices, answered, drop_items, next_near, resolve
from .query_inputs import (
    EXACT,
    LevelOfDetail,
    PoseQuery,
    QueryBudget,
    SceneData,
    has_unknown,
    kernel_poses,
    make_query,
    refuse,
    to_units,
)

# Rounding of square roots and of placed points in a bound [exact units].
_ROUNDING = 4.0
# Conversion to metres widens bounds by some exact units; a smaller tolerance has no effect.
TOLERANCE_SLACK = 8.0
# Limit of the reach in `search_resident` [m]: with nothing near, the time grows with the number of voxels.
MAX_FAST_REACH = 2.0
_CLEAR, _CONTACT = int(Verdict.CLEAR), int(Verdict.CONTACT)


def distance_slices(
    data: SceneData, avatar: AvatarModel, poses: ArrayLike, reach: float, budget: QueryBudget = EXACT
) -> Slices[DistanceAnswers]:
    """Compute the distance of the avatar from the scene under each pose, up to `reach` [m].

    poses: (k, 4, 4) float64, avatar to world, rigid.
    reach: pairs whose spheres are farther apart than this do not count; reach and largest radii
    together are at most 16 m.
    budget: with a tolerance, the pair found may be farther than the nearest one by as much as it
    allows; `lower` and `upper` then bound the distance.
    If a voxel in reach was not examined or a scan was left out, the distance is that of the nearest
    examined pair, and exact only if nothing else can contain a nearer pair.
    Raise BadRequestError, BadTransformError, TooLargeError.
    """
    reach_units = to_units(reach, "reach")
    query = make_query(data, avatar, poses, reach_units, budget)
    k, per_step = len(query.poses), data.arrays.units_per_step
    nearest, counts = no_pairs(k), np.zeros((3, k), np.uint32)
    # A level does not know the radii of a scene with several.
    level = find_level(data, budget) if len(data.arrays.radius_deficit) == 1 else None

    # Of what absent voxels hold, by the level; of those that need not be loaded; of the others [steps].
    absent_bound, settled_bound = np.zeros(k), np.full(k, np.inf)
    resident_bound = np.full(k, np.inf)

    def settle(lists: VoxelLists) -> VoxelLists:
        lists = _drop_farther(data, lists, nearest)
        resident_bound[:], nearest.missing_bound[:] = nearest.missing_bound, np.inf
        which = np.flatnonzero(np.diff(lists.starts))
        if level is None or not len(which):
            return lists
        absent_bound[which] = _bound_by_level(level, query, which, lists.rows[: lists.starts[-1]], nearest)
        settled = _is_within(nearest, absent_bound * per_step, query.around.units, budget)
        settled_bound[which] = np.where(settled, absent_bound, np.inf)[which]
        return drop_items(lists, settled)

    left = yield from resolve(
        query.data, query.around.lists, _search(query, nearest, counts), budget, query.spent, settle
    )
    missing = np.maximum(np.minimum(nearest.missing_bound, left), absent_bound)
    missing = np.minimum(missing, settled_bound)
    nearest.missing_bound[:] = np.minimum(np.minimum(missing, resident_bound), query.unseen)
    results, exact = np.empty((k, COLUMNS)), np.empty(k, bool)
    write_results(nearest, query.radii, float(reach), data.arrays, results, exact)
    signed, lower = results[:, SIGNED].copy(), results[:, LOWER].copy()
    clear = np.where(exact | (lower > 0), Verdict.CLEAR, Verdict.UNKNOWN)
    return DistanceAnswers(
        verdict=np.where(signed <= 0, Verdict.CONTACT, clear).astype(np.uint8), signed_distance=signed,
        lower=lower, upper=signed.copy(), exact=exact, witness_avatar=results[:, AVATAR:CLOUD].copy(),
        witness_cloud=results[:, CLOUD:].copy(), normal=results[:, NORMAL:AVATAR].copy(),
        outside=query.around.outside, voxels_missing=counts[0], node_visits=counts[1], point_tests=counts[2],
        **query.spent.fields(),
    )  # fmt: skip


distance = answered(distance_slices)


def distance_fast(
    data: SceneData, avatar: AvatarModel, poses: ArrayLike, reach: float, budget: QueryBudget = EXACT
) -> DistanceAnswers:
    """Answer `distance`, in one kernel call if there is one pose and the fast path applies."""
    begin = time.perf_counter()
    poses = kernel_poses(poses)
    if (
        len(poses) != 1
        or not 0.0 <= reach <= MAX_FAST_REACH
        or not 0 < len(avatar.points) <= MAX_FAST_POINTS
        or has_unknown(data)
    ):
        return distance(data, avatar, poses, reach, budget)
    reach_units = to_units(reach, "reach")
    result = np.empty(COLUMNS)
    before = poses, avatar.reference, avatar.radius, data.radius_units, reach_units, float(reach)
    (fault, found, needed, visits, tests), outside = search_resident(
        data, budget, nearest_resident, before, (result,)
    )
    refuse(fault, 0, found)
    if needed < 0:
        return distance(data, avatar, poses, reach, budget)
    # The columns of `distance`, made for many poses, would take half as long again as the search.
    signed, row, residency = result[SIGNED:LOWER], result[None], data.residency
    return DistanceAnswers(
        verdict=np.array([_CONTACT if signed[0] <= 0.0 else _CLEAR], np.uint8), signed_distance=signed,
        lower=result[LOWER:NORMAL], upper=signed.copy(), exact=np.ones(1, bool), witness_avatar=row[:, AVATAR:CLOUD],
        witness_cloud=row[:, CLOUD:], normal=row[:, NORMAL:AVATAR], outside=outside,
        voxels_missing=np.zeros(1, np.uint32), node_visits=np.array([visits], np.uint32),
        point_tests=np.array([tests], np.uint32), engine_seconds=time.perf_counter() - begin, hits=needed,
        resident=residency.resident, resident_bytes=residency.resident_bytes,
    )  # fmt: skip


def no_pairs(k: int) -> NearestPairs:
    """Return the pairs of k poses before any is found: none, and nothing missing."""
    return NearestPairs(
        np.full(k, -1, np.int64), np.zeros((k, 6), np.int64), np.zeros(k, np.int64), np.full(k, math.inf)
    )


def _search(query: PoseQuery, nearest: NearestPairs, counts: NDArray[np.uint32]) -> Search:
    """Return the search of `resolve`: it writes `nearest` and counts (3, k)."""
    budget = query.budget
    tolerance = max(0.0, budget.between_bounds * UNITS_PER_METRE - TOLERANCE_SLACK)

    def search(
        lists: VoxelLists, which: NDArray[np.int64], cursor: NDArray[np.int64], state: NDArray[np.uint8]
    ) -> None:
        own = query.around._replace(lists=lists)
        nearest_poses(
            query.poses, query.avatar.arrays, query.data.arrays, own, which, cursor, state, query.beyond,
            budget.relative, tolerance, nearest, counts,
        )  # fmt: skip

    return search


def _drop_farther(data: SceneData, lists: VoxelLists, nearest: NearestPairs) -> VoxelLists:
    """Return lists without items whose next voxel is farther than the pair found."""
    next_units = next_near(lists, lists.starts[:-1]) * data.arrays.units_per_step
    found = np.sqrt(np.maximum(nearest.square, 0).astype(np.float64)) + 2.0 + nearest.deficit
    return drop_items(lists, (nearest.square >= 0) & (next_units > found))


def _bound_by_level(
    level: LevelOfDetail,
    query: PoseQuery,
    which: NDArray[np.int64],
    rows: NDArray[np.int64],
    nearest: NearestPairs,
) -> NDArray[np.float64]:
    """Return lower bounds of the distance of the scene's voxels `rows` from the avatar's centres [steps].

    Of the poses numbered in `which`. A representative nearer than the pair in `nearest` replaces it.
    """
    k, covers, points = len(which), level.covers, level.points
    by_covers, by_points = (ask_level(query, each, which, query.beyond) for each in (covers, points))
    if by_covers is None or by_points is None:
        return np.zeros(k)
    covered, pairs, counts = no_pairs(k), no_pairs(k), np.zeros((3, k), np.uint32)
    own = below(level, by_covers.around.lists, rows)
    left = search_level(query, by_covers, own, _search(by_covers, covered, counts))
    search_level(query, by_points, by_points.around.lists, _search(by_points, pairs, counts))
    closer = _lengths(pairs) < _lengths(nearest)[which]
    at = which[closer]
    nearest.square[at], nearest.pair[at], nearest.deficit[at] = pairs.square[closer], pairs.pair[closer], 0
    # All points lie within the cover radius of a representative, also those of voxels of the level
    # that are missing.
    grown, per_step = covers.radius_units - points.radius_units, covers.arrays.units_per_step
    missing = np.minimum(covered.missing_bound, left) * per_step
    if covers.nothing_clear:  # a load may have proved the index of the level wrong
        missing[:] = 0.0
    lower = np.minimum(_lengths(covered) + covered.deficit, missing) - grown - _ROUNDING
    return np.asarray(np.maximum(lower, 0.0) / per_step * (1.0 - 1e-12))


def _is_within(
    nearest: NearestPairs, lower: NDArray[np.float64], reach: NDArray[np.int64], budget: QueryBudget
) -> NDArray[np.bool_]:
    """Return which poses (k,) need nothing of their absent voxels, which are `lower` or more away.

    lower, reach: (k,), of centres [exact units].
    """
    upper = _lengths(nearest)
    with np.errstate(invalid="ignore"):  # no pair within reach: inf - inf, or no share of inf
        allowed = np.fmax(budget.between_bounds * UNITS_PER_METRE, budget.relative * lower)
        near = upper - lower <= allowed - TOLERANCE_SLACK
    return np.where(np.isfinite(upper), near | (lower > upper), lower > reach)


def _lengths(pairs: NearestPairs) -> NDArray[np.float64]:
    """Return the distances of pairs (k,) [exact units]; inf for none."""
    square = np.where(pairs.square >= 0, pairs.square.astype(np.float64), np.inf)
    return np.asarray(np.sqrt(square), np.float64)


def signed_from_square(square: NDArray[np.int64], radii: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return the signed distances (k,) [m] of pairs.

    square: |a - b|^2.  radii: r_a + r_b. Both are in exact units.
    """
    above = (square - radii * radii).astype(np.float64)
    both = np.sqrt(square.astype(np.float64)) + radii.astype(np.float64)
    return np.divide(above, both, out=np.zeros(len(square)), where=both > 0) / UNITS_PER_METRE
