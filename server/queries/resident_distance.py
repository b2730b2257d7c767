"""`distance` of one pose, for who asks each frame: one kernel call where all voxels in reach are resident."""

import time

import numpy as np
from numpy.typing import ArrayLike

from ...schemas.wire.answers import DistanceAnswers, Verdict
from ..avatars.avatar_model import AvatarModel
from ..kernels.nearest.nearest_resident import AVATAR, CLOUD, COLUMNS, LOWER, NORMAL, SIGNED, nearest_resident
from .collide import QUICK_POINTS
from .context.query_budget import EXACT, Effort
from .context.query_context import SceneData, kernel_poses, refuse, to_units
from .distance import distance

# The search keeps the residency's lock, so that others wait for it. What it takes grows with the voxels in reach, where
# nothing is near: so many at most are looked into so [voxels], and so far [m].
QUICK_ROWS, QUICK_REACH = 64, 2.0

_CLEAR, _CONTACT = np.uint8(Verdict.CLEAR), np.uint8(Verdict.CONTACT)


def near(
    data: SceneData, avatar: AvatarModel, pose: ArrayLike, reach: float, effort: Effort = EXACT
) -> DistanceAnswers:
    """What `distance` answers for one pose (4, 4), to the last bit, its cost counters too; engine_seconds aside.

    reach, effort, errors: as there.
    """
    poses = kernel_poses(np.asarray(pose)[None])
    answers = _near_at_once(data, avatar, poses, reach, effort)
    return distance(data, avatar, poses, reach, effort) if answers is None else answers


def _near_at_once(
    data: SceneData, avatar: AvatarModel, poses: ArrayLike, reach: float, effort: Effort
) -> DistanceAnswers | None:
    """The answer of one kernel call; None: something has to be loaded, or it is not to be had so."""
    if effort.limited or len(avatar.points) > QUICK_POINTS or data.nothing_clear or len(data.unknown):
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
            residency.use(rows[:needed].tolist(), scan=effort.scan)
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
