"""Query `collide`: whether an avatar touches the scene, one verdict a pose."""

import time
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...schemas.archive.units import UNITS_PER_METRE
from ...schemas.wire.answers import CollideAnswers
from ..avatars.avatar_model import AvatarModel
from ..kernels.collide.collide_poses import CLEAR, CONTACT, EARLY, UNKNOWN, collide_poses, collide_resident
from ..kernels.core.reach import VoxelLists
from .level_of_detail import ask_level, below, find_level, search_level
from .load_and_search import Search, Settle, Slices, answered, drop_items, resolve
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

# Limit of the points of an avatar in `search_resident`: 20 µs for the 3,617 points of the walk. Larger
# avatars could block other requests, and gain little.
MAX_FAST_POINTS = 1 << 13


def collide_slices(
    data: SceneData, avatar: AvatarModel, poses: ArrayLike, margin: float = 0.0, budget: QueryBudget = EXACT
) -> Slices[CollideAnswers]:
    """Test whether the avatar touches the scene under each pose.

    poses: (k, 4, 4) float64, avatar to world, rigid, bits used as given.
    margin: distance at or below which two spheres are in contact [m].
    budget: with a tolerance, CONTACT means a pair within margin plus tolerance, and CLEAR none within
    the margin; the answer has bounds.
    The verdict is CONTACT, CLEAR or UNKNOWN. UNKNOWN means that a voxel in reach was not examined or
    a scan was left out there, and that no contact was found elsewhere. NUMERICS.md N5 has the
    definition. Raise BadRequestError, BadTransformError, TooLargeError.
    """
    margin_units = to_units(margin, "margin")
    query = make_query(data, avatar, poses, margin_units, budget)
    verdict, counts = np.zeros(len(query.poses), np.uint8), np.zeros((3, len(query.poses)), np.uint32)
    level = find_level(data, budget)
    drop_clear = drop_clear_of(level, query)

    def settle(lists: VoxelLists) -> VoxelLists:
        lists = drop_items(lists, (verdict == CONTACT) | (verdict == EARLY))
        if level is None or drop_clear is None:
            return lists
        lists = drop_clear(lists)
        which = np.flatnonzero(np.diff(lists.starts))
        verdict[which[_touch_level(level, query, which)]] = EARLY if budget.tolerance_units else CONTACT
        return drop_items(lists, (verdict == CONTACT) | (verdict == EARLY))

    search = _search(query, budget.tolerance_units, verdict, counts)
    left = yield from resolve(query.data, query.around.lists, search, budget, query.spent, settle)
    verdict[(np.minimum(left, query.unseen) < np.inf) & (verdict == CLEAR)] = UNKNOWN
    bounds = verdict_bounds(verdict, query.radii, margin, margin_units, budget)
    missing, visits, tests = counts
    cost = query.spent.fields()
    return CollideAnswers(verdict, query.around.outside, missing, visits, tests, **cost, **bounds)


collide = answered(collide_slices)


def search_resident(
    data: SceneData,
    budget: QueryBudget,
    kernel: Any,
    before: tuple[Any, ...],
    after: tuple[Any, ...],
    examined: int = 2,
) -> tuple[Any, NDArray[np.bool_]]:
    """Answer a query of one item by a single kernel call, if resident voxels answer it.

    The answers equal those of the slices bit for bit, cost counters included, except engine_seconds and
    `hits`, the voxels that were examined instead of all in reach; with a tolerance, the distance is the
    exact one. For `collide` and `distance`, resident voxels suffice if nothing in the others changes the
    answer. Callers do not use it for avatars of more than MAX_FAST_POINTS points, nor, except `sweep`,
    if a scan was left out of the archive or a load proved its index wrong.

    The kernel runs under the lock of the resident set, which saves pinning its voxels: more than half
    of the overhead of such a call (scripts/bench_walk). Other requests wait meanwhile, so the limits
    keep it to some tens of microseconds.

    kernel: takes `before`, a reference to the scene, the stop flag, and `after`.  examined: position in
    the kernel's result of the number of voxels examined; negative: a voxel has to be loaded, too many are
    in reach, or the request was stopped.
    Return the kernel's result, and whether the reach of the pose leaves the scene (1,).
    """
    residency, held = data.residency, data.references.to(data.arrays, data.tree)
    with residency.frozen():
        found = held.call(kernel, *before, held.reference, budget.stop.flag, *after)
        count, outside = found[examined], held.outside.copy()
        if count > 0:
            residency.use(held.rows[:count].tolist(), scan=budget.scan)
    return found, outside


def collide_fast(
    data: SceneData, avatar: AvatarModel, poses: ArrayLike, margin: float = 0.0, budget: QueryBudget = EXACT
) -> CollideAnswers:
    """Answer `collide`, in one kernel call if there is one pose and the fast path applies."""
    begin = time.perf_counter()
    array = kernel_poses(poses)
    if (
        len(array) != 1
        or not 0 < len(avatar.points) <= MAX_FAST_POINTS
        or budget.tolerance
        or has_unknown(data)
    ):
        return collide(data, avatar, array, margin, budget)
    verdict, counts = np.zeros(1, np.uint8), np.zeros((3, 1), np.uint32)
    other_units = data.radius_units + to_units(margin, "margin")
    before = array, avatar.reference, avatar.radius, other_units, 0
    (fault, found, needed), outside = search_resident(
        data, budget, collide_resident, before, (verdict, counts)
    )
    refuse(fault, 0, found)
    if needed < 0:
        return collide(data, avatar, array, margin, budget)
    residency = data.residency
    return CollideAnswers(
        verdict, outside, counts[0], counts[1], counts[2], engine_seconds=time.perf_counter() - begin,
        hits=needed, resident=residency.resident, resident_bytes=residency.resident_bytes,
    )  # fmt: skip


def _search(
    query: PoseQuery, tolerance_units: int, verdict: NDArray[np.uint8], counts: NDArray[np.uint32]
) -> Search:
    """Return the search of `resolve`: it writes verdict (k,) and counts (3, k)."""

    def search(lists: VoxelLists, *state: NDArray[Any]) -> None:
        own = query.around._replace(lists=lists)
        collide_poses(
            query.poses, query.avatar.arrays, query.data.arrays, own, *state, tolerance_units, verdict, counts
        )

    return search


def drop_clear_of(level: LevelOfDetail | None, query: PoseQuery) -> Settle | None:
    """Return the `settle` of `resolve` that drops the poses which the level proves clear; None without one."""
    if level is None:
        return None
    covers = level.covers

    def settle(lists: VoxelLists) -> VoxelLists:
        which = np.flatnonzero(np.diff(lists.starts))
        asked = ask_level(query, covers, which, query.beyond)
        if asked is None:
            return lists
        own = below(level, asked.around.lists, lists.rows[: lists.starts[-1]])
        verdict, left = _search_level(query, asked, own)
        clear = np.zeros(len(query.poses), bool)
        clear[which] = (verdict == CLEAR) & (left == np.inf) & (not covers.nothing_clear)
        return drop_items(lists, clear)

    return settle


def _touch_level(level: LevelOfDetail, query: PoseQuery, which: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Return which of the poses numbered in `which` touch a representative, within margin plus tolerance."""
    asked = ask_level(query, level.points, which, query.beyond + query.budget.tolerance_units)
    if asked is None:
        return np.zeros(len(which), bool)
    verdict, _ = _search_level(query, asked, asked.around.lists)
    return np.asarray(verdict == CONTACT)


def _search_level(
    query: PoseQuery, asked: PoseQuery, lists: VoxelLists
) -> tuple[NDArray[np.uint8], NDArray[np.float64]]:
    """Return the verdicts (k,) of the poses asked in voxels of a level, and what `search_level` returns."""
    verdict, counts = np.zeros(len(asked.poses), np.uint8), np.zeros((3, len(asked.poses)), np.uint32)
    return verdict, search_level(query, asked, lists, _search(asked, 0, verdict, counts))


def verdict_bounds(
    verdict: NDArray[np.uint8],
    radii: NDArray[np.int64],
    margin: float,
    margin_units: int,
    budget: QueryBudget,
) -> dict[str, Any]:
    """Return the bounds of `CollideAnswers` that follow from verdicts; {} if the budget has no limit.

    verdict: (k,), in which EARLY becomes CONTACT.
    radii: (k,) sum of the largest radii of avatar and scan, exact units: the depth limit of a pair.
    margin: [m].  margin_units: the margin as rounded, up or down; verdicts are based on it.
    """
    if budget.tolerance == 0:
        return {}
    rounded = margin_units / UNITS_PER_METRE
    low, high = min(float(margin), rounded), max(float(margin), rounded)
    early, found = verdict == EARLY, verdict == CONTACT
    lower = np.where(verdict == CLEAR, low, -radii / UNITS_PER_METRE)
    upper = np.where(found, high, np.where(early, np.nextafter(high + budget.tolerance, np.inf), np.inf))
    exact = found | (verdict == CLEAR)
    verdict[early] = CONTACT
    return {"lower": lower, "upper": upper, "exact": exact}
