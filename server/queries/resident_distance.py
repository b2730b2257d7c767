"""Fast path of `distance` for one pose: one kernel call if all voxels in reach are resident.

Intended for callers that query in each frame.
"""

import time

import numpy as np
from numpy.typing import ArrayLike

from ...schemas.wire.answers import DistanceAnswers, Verdict
from ..avatars.avatar_model import AvatarModel
from ..kernels.nearest.nearest_resident import AVATAR, CLOUD, COLUMNS, LOWER, NORMAL, SIGNED, nearest_resident
from .collide import QUICK_POINTS
from .context.query_budget import EXACT, QueryBudget
from .context.query_context import SceneData, kernel_poses, refuse, to_units
from .distance import distance

# Limits of the fast path [voxels] and [m]. The search holds the residency's lock, so others wait
# for it, and with nothing near its time grows with the number of voxels in reach.
QUICK_ROWS, QUICK_REACH = 64, 2.0

_CLEAR, _CONTACT = np.uint8(Verdict.CLEAR), np.uint8(Verdict.CONTACT)


def near(
    data: SceneData, avatar: AvatarModel, pose: ArrayLike, reach: float, budget: QueryBudget = EXACT
) -> DistanceAnswers:
    """Return the answer of `distance` for one pose (4, 4).

    It is identical to the last bit, cost counters included, except engine_seconds.
    reach, budget, errors: as for `distance`.
    """
    poses = kernel_poses(np.asarray(pose)[None])
    answers = _near_at_once(data, avatar, poses, reach, budget)
    return distance(data, avatar, poses, reach, budget) if answers is None else answers


def _near_at_once(
    data: SceneData, avatar: AvatarModel, poses: ArrayLike, reach: float, budget: QueryBudget
) -> DistanceAnswers | None:
    """Return the answer of one kernel call, or None if the fast path does not apply.

    It does not apply if a voxel has to be loaded or the request exceeds its limits.
    """
    if budget.limited or len(avatar.points) > QUICK_POINTS or data.nothing_clear or len(data.unknown):
        return None
    begin = time.perf_counter()
    reach_units = to_units(reach, "reach")
    if reach > QUICK_REACH:
        return None
    residency = data.residency
    rows, said = np.empty(QUICK_ROWS, np.int64), np.empty(COLUMNS)
    with residency.still():
        fault, pose, found, needed, outside, visits, tests = nearest_resident(
            poses,
            avatar.arrays,
            avatar.radius,
            data.radius_units,
            reach_units,
            float(reach),
            data.arrays,
            data.broad,
            rows,
            said,
        )
        if needed > 0:
            residency.use(rows[:needed].tolist(), scan=budget.scan)
    refuse(fault, pose, found)
    if needed < 0:
        return None
    signed, lower = said[SIGNED:LOWER], said[LOWER:NORMAL]
    row = said.reshape(1, COLUMNS)
    return DistanceAnswers(
        verdict=np.array([_CONTACT if signed[0] <= 0.0 else _CLEAR]), signed_distance=signed, lower=lower,
        upper=signed.copy(), exact=np.ones(1, bool), witness_avatar=row[:, AVATAR:CLOUD],
        witness_cloud=row[:, CLOUD:], normal=row[:, NORMAL:AVATAR], outside=np.array([outside]),
        voxels_missing=np.zeros(1, np.uint32), node_visits=np.array([visits], np.uint32),
        point_tests=np.array([tests], np.uint32), engine_seconds=time.perf_counter() - begin, hits=needed,
        resident=residency.resident, resident_bytes=residency.resident_bytes,
    )  # fmt: skip
