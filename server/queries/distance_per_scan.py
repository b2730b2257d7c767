"""Separation of each scan of an archive from an avatar under one pose, to estimate scan noise."""

import time
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from ..avatars.avatar_model import AvatarModel
from ..kernels.nearest.nearest_by_scan import NearestPerScan, nearest_by_scan
from .context.late_voxels import drop_proved_voxels
from .context.query_budget import EXACT, CostCounter, QueryBudget
from .context.query_context import (
    SceneData,
    as_held,
    find_proved_reach,
    in_unknown,
    kernel_poses,
    pieces,
    to_units,
)

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
    spent = CostCounter(time.perf_counter(), data.residency, data.broad.keys)
    proved = drop_proved_voxels(data, avatar, poses, margin_units, budget)
    reach = find_proved_reach(data, avatar, poses, units, budget, spent, proved)
    if not len(avatar.points):
        return ScanSeparations({}, True)
    nearer = NearestPerScan(np.full(scans + 1, np.inf), np.full(scans + 1, reach.units[0]))
    counts, exact = np.zeros(3, np.int64), True
    for _, rows, part in pieces(reach, data.residency, budget.share, budget.stop):
        if budget.stop:
            exact = False
            break
        with data.residency.hold(rows, budget.loads_until(), scan=budget.scan, stop=budget.stop) as held:
            arrays = as_held(data, held, budget).arrays
            exact &= bool(nearest_by_scan(poses, avatar.arrays, arrays, part, margin_units, nearer, counts))
    exact &= counts[0] == 0 and not in_unknown(reach.boxes, data.unknown, data.nothing_clear)[0]
    found = np.flatnonzero(nearer.gaps < np.inf).tolist()
    separations = {ANY_SCAN if number == scans else number: float(nearer.gaps[number]) for number in found}
    return ScanSeparations(separations, bool(exact), int(counts[1]), int(counts[2]))
