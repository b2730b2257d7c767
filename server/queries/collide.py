"""Query `collide`: whether an avatar touches the scene, one verdict a pose."""

import time
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...schemas.archive.units import UNITS_PER_METRE
from ...schemas.wire.answers import CollideAnswers
from ..avatars.avatar_model import AvatarModel
from ..kernels.collide.collide_poses import collide_poses, collide_resident
from ..kernels.collide.leaf_contact import CLEAR, CONTACT, EARLY, UNKNOWN
from ..kernels.core.reach import VoxelLists
from ..kernels.core.voxels_in_reach import VoxelsInReach
from .level_of_detail import below, find_level, level_budget, level_reach
from .load_and_search import (
    MAX_FAST_POINTS,
    CostCounter,
    Search,
    Settle,
    Steps,
    answered,
    cost_of_one,
    drop_items,
    load_and_search,
    resolve,
    search_resident,
)
from .query_inputs import (
    EXACT,
    LevelOfDetail,
    QueryBudget,
    SceneData,
    check_request,
    has_unknown,
    kernel_poses,
    refuse,
    to_units,
    unseen_from,
    with_stop,
)


def collide_steps(
    data: SceneData, avatar: AvatarModel, poses: ArrayLike, margin: float = 0.0, budget: QueryBudget = EXACT
) -> Steps[CollideAnswers]:
    """Test whether the avatar touches the scene under each pose.

    poses: (k, 4, 4) float64, avatar to world, rigid, bits used as given.
    margin: distance at or below which two spheres are in contact [m].
    budget: with a tolerance, CONTACT means a pair within margin plus tolerance, and CLEAR none within
    the margin; the answer has bounds.
    The verdict is CONTACT, CLEAR or UNKNOWN. UNKNOWN means that a voxel in reach was not examined or
    a scan was left out there, and that no contact was found elsewhere. NUMERICS.md N5 has the
    definition. Raise BadRequestError, BadTransformError, TooLargeError.
    """
    spent = CostCounter(data)
    array, margin_units = kernel_poses(poses), to_units(margin, "margin")
    reach = check_request(data, avatar, array, data.radius_units + margin_units)
    verdict, counts = np.zeros(len(array), np.uint8), np.zeros((3, len(array)), np.uint32)
    level = find_level(data, budget)
    drop_clear = drop_clear_of(level, avatar, array, margin_units, budget, spent)

    def settle(lists: VoxelLists) -> Steps[VoxelLists]:
        lists = drop_items(lists, (verdict == CONTACT) | (verdict == EARLY))
        if level is None or drop_clear is None:
            return lists
        lists = yield from drop_clear(lists)
        which = np.flatnonzero(np.diff(lists.starts))
        touches = yield from _touch_level(level, avatar, array[which], margin_units, budget, spent)
        verdict[which[touches]] = EARLY if budget.tolerance_units else CONTACT
        return drop_items(lists, (verdict == CONTACT) | (verdict == EARLY))

    if len(avatar.points):
        own = with_stop(data, budget.stop)
        search = _search(own, avatar, array, reach, budget.tolerance_units, verdict, counts)
        left = yield from resolve(data, reach.lists, search, budget, spent, settle)
        unseen = np.minimum(left, unseen_from(data, reach))
        verdict[(unseen < np.inf) & (verdict == CLEAR)] = UNKNOWN
    bounds = verdict_bounds(verdict, reach.units - margin_units, margin, margin_units, budget)
    return CollideAnswers(verdict, reach.outside, *counts, **spent.fields(), **bounds)


collide = answered(collide_steps)


def collide_fast(
    data: SceneData, avatar: AvatarModel, poses: ArrayLike, margin: float = 0.0, budget: QueryBudget = EXACT
) -> CollideAnswers:
    """Answer `collide`, in one kernel call if there is one pose and the fast path applies."""
    begin = time.perf_counter()
    array = kernel_poses(poses)
    if len(array) != 1 or len(avatar.points) > MAX_FAST_POINTS or budget.tolerance or has_unknown(data):
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
    return CollideAnswers(verdict, outside, *counts, **cost_of_one(data, begin, needed))


def _search(
    data: SceneData,
    avatar: AvatarModel,
    poses: NDArray[np.float64],
    reach: VoxelsInReach,
    tolerance_units: int,
    verdict: NDArray[np.uint8],
    counts: NDArray[np.uint32],
) -> Search:
    """Return the search of `resolve`: it writes verdict (k,) and counts (3, k)."""

    def search(lists: VoxelLists, *state: NDArray[Any]) -> None:
        own = reach._replace(lists=lists)
        collide_poses(poses, avatar.arrays, data.arrays, own, *state, tolerance_units, verdict, counts)

    return search


def drop_clear_of(
    level: LevelOfDetail | None,
    avatar: AvatarModel,
    poses: NDArray[np.float64],
    margin_units: int,
    budget: QueryBudget,
    spent: CostCounter,
) -> Settle | None:
    """Return the `settle` of `resolve` that drops those of poses (k, 4, 4) which the level proves clear.

    Return None without a level.
    """
    if level is None:
        return None
    covers = level.covers

    def settle(lists: VoxelLists) -> Steps[VoxelLists]:
        which, rows = np.flatnonzero(np.diff(lists.starts)), lists.rows[: lists.starts[-1]]
        own = poses[which]
        reach = level_reach(covers, avatar, own, margin_units) if len(which) else None
        if reach is None:
            return lists
        reach = reach._replace(lists=below(level, reach.lists, rows))
        verdict, left = yield from _search_level(covers, avatar, own, reach, budget, spent)
        clear = np.zeros(len(poses), bool)
        clear[which] = (verdict == CLEAR) & (left == np.inf) & (not covers.nothing_clear)
        return drop_items(lists, clear)

    return settle


def _touch_level(
    level: LevelOfDetail,
    avatar: AvatarModel,
    poses: NDArray[np.float64],
    margin_units: int,
    budget: QueryBudget,
    spent: CostCounter,
) -> Steps[NDArray[np.bool_]]:
    """Return which poses (k,) touch a representative, within margin plus tolerance."""
    reach = level_reach(level.points, avatar, poses, margin_units + budget.tolerance_units)
    if reach is None:
        return np.zeros(len(poses), bool)
    verdict, _ = yield from _search_level(level.points, avatar, poses, reach, budget, spent)
    return np.asarray(verdict == CONTACT)


def _search_level(
    data: SceneData,
    avatar: AvatarModel,
    poses: NDArray[np.float64],
    reach: VoxelsInReach,
    budget: QueryBudget,
    spent: CostCounter,
) -> Steps[tuple[NDArray[np.uint8], NDArray[np.float64]]]:
    """Return the verdicts (k,) of poses in covers or points of a level, and what `resolve` returns."""
    verdict, counts = np.zeros(len(poses), np.uint8), np.zeros((3, len(poses)), np.uint32)
    search, own = _search(data, avatar, poses, reach, 0, verdict, counts), CostCounter(data)
    left = yield from load_and_search(data, reach.lists, search, level_budget(budget), own)
    spent.add_level(own)
    return verdict, left


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
