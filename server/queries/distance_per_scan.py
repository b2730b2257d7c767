"""Separation of each scan of an archive from an avatar under one pose, to estimate scan noise."""

import time
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..avatars.avatar_model import AvatarModel
from ..kernels.core.reach import VoxelLists
from ..kernels.nearest.nearest_by_scan import NearestPerScan, nearest_by_scan
from .collide import clear_of_rows
from .context.query_budget import EXACT, CostCounter, QueryBudget
from .context.query_context import SceneData, check_request, in_unknown, kernel_poses, to_units, with_stop
from .level_of_detail import find_level
from .resolve import Steps, drop_items, resolve, run

# Key of points whose scan is not stored, or whose number belongs to no scan.
ANY_SCAN = -1


class ScanSeparations(NamedTuple):
    """Separation of each scan from an avatar.

    separations: least signed one [m] of each scan within the margin, by its row in
    `SceneInfo.sources`.
    exact: whether everything in reach was examined.  node_visits, point_tests: cost.
    """

    separations: dict[int, float]
    exact: bool
    node_visits: int = 0
    point_tests: int = 0


def separation_per_scan(
    data: SceneData,
    avatar: AvatarModel,
    pose: ArrayLike,
    margin: float,
    scans: int,
    budget: QueryBudget = EXACT,
) -> ScanSeparations:
    """Compute the least signed separation of every scan from the avatar under a pose (4, 4).

    Scans farther than `margin` [m] are omitted.
    data: of an archive that keeps the scan of each point.  scans: their number.
    The pairs are those that `contacts` finds with this margin, and the separation of a scan is that
    of its deepest pair, except for the last bits: if the separations of several pairs differ only
    by rounding, it is that of one of them. A point whose number belongs to no scan counts as
    ANY_SCAN.
    budget: a deadline may leave pairs out; `exact` is then false.
    Raise BadRequestError, BadTransformError, TooLargeError.
    """
    poses = kernel_poses(np.asarray(pose)[None])
    margin_units = to_units(margin, "margin")
    units = data.radius_units + margin_units
    spent = CostCounter(time.perf_counter(), data.residency, data.keys)
    reach = check_request(data, avatar, poses, units)
    if not len(avatar.points):
        return ScanSeparations({}, True)
    nearer = NearestPerScan(np.full(scans + 1, np.inf), np.full(scans + 1, reach.units[0]))
    counts, lists, level = np.zeros(3, np.int64), reach.lists, find_level(data, budget)

    arrays = with_stop(data, budget.stop).arrays

    def search(lists: VoxelLists, _: NDArray[np.int64], *state: NDArray[Any]) -> None:
        own = reach._replace(lists=lists)
        nearest_by_scan(poses, avatar.arrays, arrays, own, *state, margin_units, nearer, counts)

    def settle(lists: VoxelLists) -> Steps[VoxelLists]:
        if level is None or not lists.starts[-1]:
            return lists
        rows = lists.rows[: lists.starts[-1]]
        clear = yield from clear_of_rows(level, avatar, poses, margin_units, rows, budget, spent)
        return drop_items(lists, clear)

    left = run(resolve(data, lists, search, budget, spent, settle))
    exact = left[0] == np.inf and counts[0] == 0
    exact &= not in_unknown(reach.boxes, data.unknown, data.nothing_clear)[0]
    found = np.flatnonzero(nearer.gaps < np.inf).tolist()
    separations = {ANY_SCAN if number == scans else number: float(nearer.gaps[number]) for number in found}
    return ScanSeparations(separations, bool(exact), int(counts[1]), int(counts[2]))
