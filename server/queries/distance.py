"""Query `distance`: distance of an avatar from the scene, and the nearest pair.

signed_distance.py has the definition.
"""

import math
import time

import numpy as np
from numpy.typing import ArrayLike

from ...schemas.archive.units import UNITS_PER_METRE
from ...schemas.wire.answers import DistanceAnswers
from ..avatars.avatar_model import AvatarModel
from ..kernels.nearest.nearest_pair import NearestPairs
from ..kernels.nearest.nearest_search import nearest_poses
from .context.anytime_search import TOLERANCE_SLACK, distance_bounded
from .context.query_budget import EXACT, NO_LIMIT, CostCounter, QueryBudget
from .context.query_context import (
    SceneData,
    as_held,
    find_proved_reach,
    kernel_poses,
    pieces,
    to_units,
)
from .context.signed_distance import distance_columns, unknown_gaps
from .context.unloaded_voxels import bound_missing


def distance(
    data: SceneData, avatar: AvatarModel, poses: ArrayLike, reach: float, budget: QueryBudget = EXACT
) -> DistanceAnswers:
    """Compute the distance of the avatar from the scene under each pose, up to `reach` [m].

    poses: (k, 4, 4) float64, avatar to world, rigid or with a uniform scale.
    reach: pairs whose spheres are farther apart than this do not count; reach and largest radii
    together are at most 16 m.
    budget: with a tolerance, the pair found may be farther than the nearest one by as much as it
    allows; `lower` and `upper` then bound the distance.
    If a voxel in reach is missing or a scan was left out, the distance is that of the nearest
    examined pair, and exact only if nothing missing can contain a nearer pair.
    Raise BadRequestError, BadTransformError, TooLargeError.
    """
    if budget.limited:
        return distance_bounded(data, avatar, poses, reach, budget)
    begin = time.perf_counter()
    array = kernel_poses(poses)
    reach_units = to_units(reach, "reach")
    k = len(array)
    residency, spent = data.residency, CostCounter(begin, data.residency, data.broad.keys)
    around = find_proved_reach(data, avatar, array, data.radius_units + reach_units, budget, spent)
    nearest = NearestPairs(
        np.full(k, -1, np.int64), np.zeros((k, 6), np.int64), np.zeros(k, np.int64), np.full(k, math.inf)
    )
    counts = np.zeros((3, k), np.uint32)
    tolerance = max(0.0, budget.between_bounds * UNITS_PER_METRE - TOLERANCE_SLACK)
    if len(avatar.points):
        for which, rows, part in pieces(around, residency, budget.share, budget.stop):
            if budget.stop:
                nearest.missing_bound[which] = 0.0
                continue
            with residency.hold(rows, budget.loads_until(), scan=budget.scan, stop=budget.stop) as held:
                seen = as_held(data, held)
                own = bound_missing(
                    seen, held, avatar, array, part, which, nearest.missing_bound, counts, budget
                )
                nearest_poses(
                    array,
                    avatar.arrays,
                    seen.arrays,
                    data.broad,
                    own,
                    reach_units,
                    which,
                    budget.relative,
                    tolerance,
                    NO_LIMIT,
                    nearest,
                    counts,
                )
            spent.add(held)
        np.minimum(nearest.missing_bound, unknown_gaps(data, around), out=nearest.missing_bound)
    return DistanceAnswers(
        **distance_columns(data, around, float(reach), reach_units, nearest, counts),
        **spent.fields(),
    )
