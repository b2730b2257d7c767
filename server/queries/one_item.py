"""Fast path of queries of one pose that resident voxels answer: a single kernel call.

The answers equal those of the engines bit for bit, cost counters included, except engine_seconds
and `hits`, the voxels that were examined instead of all in reach; with a tolerance, that of
`distance` is the exact one.
The engine is called instead if

- a voxel has to be loaded, or too many are in reach. For `collide` and `distance`,
resident voxels suffice if nothing in the others changes the answer,
- the avatar has more than MAX_FAST_POINTS points, or the reach of `distance` exceeds
MAX_FAST_REACH,
- a scan was left out of the archive, or a load proved its index wrong (not for `sweep`).

The kernel runs under the lock of the resident set, which saves pinning its voxels: more than half
of the overhead of such a call (scripts/bench_walk). Other requests wait meanwhile, so the limits
keep it to some tens of microseconds.
"""

import time

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...schemas.wire.answers import CollideAnswers, DistanceAnswers, SweepAnswers, Verdict
from ..avatars.avatar_model import AvatarModel
from ..kernels.collide.collide_poses import collide_resident
from ..kernels.core.array_references import record_type
from ..kernels.motion.sweep_resident import SWEPT, make_scratch, sweep_resident
from ..kernels.nearest import nearest_search as _nearest
from ..kernels.nearest.nearest_search import nearest_resident
from .collide import collide
from .distance import distance
from .request import EXACT, QueryBudget, kernel_poses, refuse
from .scene_data import SceneData, to_units
from .sweep import sweep

# 20 µs for the 3,617 points of the walk. Larger avatars could block other requests, and gain
# little.
MAX_FAST_POINTS = 1 << 13
# With nothing near, the time grows with the number of voxels in reach [m].
MAX_FAST_REACH = 2.0
_CLEAR, _CONTACT = int(Verdict.CLEAR), int(Verdict.CONTACT)
# Columns of the results of `nearest_resident`.
_SIGNED, _LOWER = slice(_nearest.SIGNED, _nearest.LOWER), slice(_nearest.LOWER, _nearest.NORMAL)
_NORMAL, _AVATAR = slice(_nearest.NORMAL, _nearest.AVATAR), slice(_nearest.AVATAR, _nearest.CLOUD)
_CLOUD = slice(_nearest.CLOUD, None)
_SWEPT = record_type(*SWEPT)


def collide_fast(
    data: SceneData, avatar: AvatarModel, poses: ArrayLike, margin: float = 0.0, budget: QueryBudget = EXACT
) -> CollideAnswers:
    """Answer `collide`, in one kernel call if there is one pose and the fast path applies."""
    begin = time.perf_counter()
    array = kernel_poses(poses)
    if len(array) != 1 or len(avatar.points) > MAX_FAST_POINTS or budget.tolerance or has_unknown(data):
        return collide(data, avatar, array, margin, budget)
    residency = data.residency
    verdict, counts = np.zeros(1, np.uint8), np.zeros((3, 1), np.uint32)
    other_units = data.radius_units + to_units(margin, "margin")
    held = data.references.to(data.arrays, data.tree)
    with residency.frozen():
        fault, found, needed = held.call(
            collide_resident, array, avatar.reference, avatar.radius, other_units, 0, held.reference,
            budget.stop.flag, verdict, counts,
        )  # fmt: skip
        outside = held.outside.copy()
        if needed > 0:
            residency.use(held.rows[:needed].tolist())
    refuse(fault, 0, found)
    if needed < 0:
        return collide(data, avatar, array, margin, budget)
    return CollideAnswers(
        verdict, outside, counts[0], counts[1], counts[2], engine_seconds=time.perf_counter() - begin,
        hits=needed, resident=residency.resident, resident_bytes=residency.resident_bytes,
    )  # fmt: skip


def distance_fast(
    data: SceneData, avatar: AvatarModel, poses: ArrayLike, reach: float, budget: QueryBudget = EXACT
) -> DistanceAnswers:
    """Answer `distance`, in one kernel call if there is one pose and the fast path applies."""
    begin = time.perf_counter()
    poses = kernel_poses(poses)
    if (
        len(poses) != 1
        or not 0.0 <= reach <= MAX_FAST_REACH
        or len(avatar.points) > MAX_FAST_POINTS
        or has_unknown(data)
    ):
        return distance(data, avatar, poses, reach, budget)
    reach_units = to_units(reach, "reach")
    residency = data.residency
    result = np.empty(_nearest.COLUMNS)
    held = data.references.to(data.arrays, data.tree)
    with residency.frozen():
        fault, found, needed, visits, tests = held.call(
            nearest_resident, poses, avatar.reference, avatar.radius, data.radius_units, reach_units, float(reach),
            held.reference, budget.stop.flag, result,
        )  # fmt: skip
        outside = held.outside.copy()
        if needed > 0:
            residency.use(held.rows[:needed].tolist(), scan=budget.scan)
    refuse(fault, 0, found)
    if needed < 0:
        return distance(data, avatar, poses, reach, budget)
    signed, row = result[_SIGNED], result[None]
    return DistanceAnswers(
        verdict=np.array([_CONTACT if signed[0] <= 0.0 else _CLEAR], np.uint8), signed_distance=signed,
        lower=result[_LOWER], upper=signed.copy(), exact=np.ones(1, bool), witness_avatar=row[:, _AVATAR],
        witness_cloud=row[:, _CLOUD], normal=row[:, _NORMAL], outside=outside,
        voxels_missing=np.zeros(1, np.uint32), node_visits=np.array([visits], np.uint32),
        point_tests=np.array([tests], np.uint32), engine_seconds=time.perf_counter() - begin, hits=needed,
        resident=residency.resident, resident_bytes=residency.resident_bytes,
    )  # fmt: skip


def sweep_fast(
    data: SceneData,
    avatar: AvatarModel,
    pose_from: ArrayLike,
    pose_to: ArrayLike,
    margin: float = 0.0,
    tolerance: float = 0.0,
    budget: QueryBudget = EXACT,
) -> SweepAnswers:
    """Answer `sweep`, in one kernel call if there is one motion and the fast path applies."""
    begin = time.perf_counter()
    first, last = kernel_poses(pose_from), kernel_poses(pose_to)
    most = max(tolerance, budget.tolerance)
    if (
        len(first) != 1
        or len(last) != 1
        or not 0.0 <= tolerance < np.inf
        or not 0 < len(avatar.points) <= MAX_FAST_POINTS
    ):
        return sweep(data, avatar, first, last, margin, tolerance, budget)
    residency, result = data.residency, np.zeros(1, _SWEPT)
    other_units = data.radius_units + to_units(margin, "margin")
    held = data.references.to(data.arrays, data.tree)
    with residency.frozen():
        needed, said, visits, tests, steps = held.call(
            sweep_resident, first[0], last[0], avatar.reference, make_scratch(avatar.arrays), other_units,
            held.reference, budget.stop.flag, data.nothing_clear, float(most), result[0],
        )  # fmt: skip
        if needed > 0:
            residency.use(held.rows[:needed].tolist(), scan=budget.scan)
    if needed < 0:
        return sweep(data, avatar, first, last, margin, tolerance, budget)
    lower, upper, touches = result["lower"], result["upper"], said == _CONTACT
    exact = np.full(1, said == _CLEAR)
    if touches:
        exact = (result["speed"] * (upper - lower) <= most) | (upper == lower)
    nothing: NDArray[np.float64] = np.full((1, 3), np.nan)
    return SweepAnswers(
        verdict=np.array([said], np.uint8), lower=lower, upper=upper, exact=exact,
        witness_avatar=result["avatar"] if touches else nothing,
        witness_cloud=result["cloud"] if touches else nothing.copy(), steps=np.array([steps], np.uint32),
        outside=result["outside"], voxels_missing=np.zeros(1, np.uint32), node_visits=np.array([visits], np.uint32),
        point_tests=np.array([tests], np.uint32), engine_seconds=time.perf_counter() - begin, hits=needed,
        resident=residency.resident, resident_bytes=residency.resident_bytes,
    )  # fmt: skip


def has_unknown(data: SceneData) -> bool:
    """Return whether a scan was left out anywhere, or a load proved the index wrong."""
    return data.nothing_clear or len(data.tree.unknown) > 0
