"""Query `collide`: whether an avatar touches the scene, one verdict a pose."""

import time
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...schemas.archive.units import UNITS_PER_METRE
from ...schemas.wire.answers import CollideAnswers
from ..avatars.avatar_model import AvatarModel
from ..kernels.collide.collide_poses import collide_poses
from ..kernels.collide.leaf_contact import CLEAR, CONTACT, EARLY, UNKNOWN
from ..kernels.core.reach import VoxelLists
from ..kernels.core.voxels_in_reach import VoxelsInReach
from .context.query_budget import EXACT, CostCounter, QueryBudget
from .context.query_context import (
    LevelOfDetail,
    SceneData,
    check_request,
    in_unknown,
    kernel_poses,
    to_units,
    with_stop,
)
from .level_of_detail import below, find_level, level_budget, level_reach
from .resolve import Steps, drop_items, load_and_search, resolve, run


def collide(
    data: SceneData, avatar: AvatarModel, poses: ArrayLike, margin: float = 0.0, budget: QueryBudget = EXACT
) -> CollideAnswers:
    """Answer `collide`; see `collide_steps`."""
    return run(collide_steps(data, avatar, poses, margin, budget))


def collide_steps(
    data: SceneData, avatar: AvatarModel, poses: ArrayLike, margin: float, budget: QueryBudget
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
    begin = time.perf_counter()
    array = kernel_poses(poses)
    margin_units = to_units(margin, "margin")
    spent = CostCounter(begin, data.residency, data.keys)
    reach = check_request(data, avatar, array, data.radius_units + margin_units)
    verdict, counts = np.zeros(len(array), np.uint8), np.zeros((3, len(array)), np.uint32)
    level = find_level(data, budget)

    def settle(lists: VoxelLists) -> Steps[VoxelLists]:
        lists = drop_items(lists, (verdict == CONTACT) | (verdict == EARLY))
        if level is None or not lists.starts[-1]:
            return lists
        which = np.flatnonzero(np.diff(lists.starts))
        rows = lists.rows[: lists.starts[-1]]
        clear = yield from clear_of_rows(level, avatar, array[which], margin_units, rows, budget, spent)
        settled = np.zeros(len(array), bool)
        settled[which[clear]] = True
        left = which[~clear]
        touched = yield from _touches_level(level, avatar, array[left], margin_units, budget, spent)
        verdict[left[touched]] = EARLY if budget.tolerance_units else CONTACT
        settled[left[touched]] = True
        return drop_items(lists, settled)

    if len(avatar.points):
        own = with_stop(data, budget.stop)
        search = _search(own, avatar, array, reach, budget.tolerance_units, verdict, counts)
        left = yield from resolve(data, reach.lists, search, budget, spent, settle)
        verdict[(left < np.inf) & (verdict == CLEAR)] = UNKNOWN
        # A load may have proved the index wrong by now.
        if data.nothing_clear or len(data.unknown):
            verdict[in_unknown(reach.boxes, data.unknown, data.nothing_clear) & (verdict == CLEAR)] = UNKNOWN
    bounds = verdict_bounds(verdict, reach.units - margin_units, margin, margin_units, budget)
    return CollideAnswers(verdict, reach.outside, counts[0], counts[1], counts[2], **spent.fields(), **bounds)


def _search(
    data: SceneData,
    avatar: AvatarModel,
    poses: NDArray[np.float64],
    reach: VoxelsInReach,
    tolerance_units: int,
    verdict: NDArray[np.uint8],
    counts: NDArray[np.uint32],
) -> Any:
    """Return the search of `resolve`: it writes verdict (k,) and counts (3, k)."""

    def search(
        lists: VoxelLists, which: NDArray[np.int64], cursor: NDArray[np.int64], state: NDArray[np.uint8]
    ) -> None:
        own = reach._replace(lists=lists)
        collide_poses(
            poses, avatar.arrays, data.arrays, own, which, cursor, state, tolerance_units, verdict, counts
        )  # fmt: skip

    return search


def clear_of_rows(
    level: LevelOfDetail,
    avatar: AvatarModel,
    poses: NDArray[np.float64],
    margin_units: int,
    rows: NDArray[np.int64],
    budget: QueryBudget,
    spent: CostCounter,
) -> Steps[NDArray[np.bool_]]:
    """Return which poses (k,) the level proves clear of all the scene's voxels `rows`."""
    covers = level.covers
    verdict, counts = np.zeros(len(poses), np.uint8), np.zeros((3, len(poses)), np.uint32)
    reach = level_reach(covers, avatar, poses, margin_units)
    if reach is None or covers.nothing_clear:
        return np.zeros(len(poses), bool)
    lists = below(level, reach.lists, rows)
    own = spent.of_level(covers.residency)
    search = _search(covers, avatar, poses, reach, 0, verdict, counts)
    left = yield from load_and_search(covers, lists, search, level_budget(budget), own)
    spent.add_level(own)
    return np.asarray((verdict == CLEAR) & (left == np.inf))


def _touches_level(
    level: LevelOfDetail,
    avatar: AvatarModel,
    poses: NDArray[np.float64],
    margin_units: int,
    budget: QueryBudget,
    spent: CostCounter,
) -> Steps[NDArray[np.bool_]]:
    """Return which poses (k,) touch a representative, within margin plus tolerance."""
    points = level.points
    verdict, counts = np.zeros(len(poses), np.uint8), np.zeros((3, len(poses)), np.uint32)
    reach = level_reach(points, avatar, poses, margin_units + budget.tolerance_units)
    if reach is None:
        return np.zeros(len(poses), bool)
    own = spent.of_level(points.residency)
    search = _search(points, avatar, poses, reach, 0, verdict, counts)
    yield from load_and_search(points, reach.lists, search, level_budget(budget), own)
    spent.add_level(own)
    return np.asarray(verdict == CONTACT)


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
