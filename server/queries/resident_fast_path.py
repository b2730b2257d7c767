"""Fast path of queries of one pose that resident voxels answer: a single kernel call.

The answers equal those of the engines bit for bit, cost counters included, except engine_seconds;
with a tolerance, that of `distance` is the exact one.
The engine is called instead if

- a voxel has to be loaded, or more than MAX_FAST_VOXELS are in reach. For `collide` and `distance`,
resident voxels suffice if nothing in the others changes the answer,
- the avatar has more than MAX_FAST_POINTS points, or the reach of `distance` exceeds
MAX_FAST_REACH,
- a scan was left out of the archive, or a load proved its index wrong (not for `sweep`).

The kernel runs under the lock of the resident set, which saves pinning its voxels: more than half
of the overhead of such a call (scripts/bench_walk). Other requests wait meanwhile, so the limits
keep it to some tens of microseconds.
"""

import time
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...schemas.wire.answers import CollideAnswers, DistanceAnswers, Verdict
from ..avatars.avatar_model import AvatarModel, make_avatar
from ..kernels.collide.collide_poses import collide_resident
from ..kernels.collide.leaf_contact import CLEAR, CONTACT, EARLY, UNKNOWN
from ..kernels.core.array_references import Held, refer_to_avatar
from ..kernels.motion import sweep_resident as _swept
from ..kernels.motion.sweep_resident import make_scratch, pose_between, sweep_resident
from ..kernels.motion.sweep_segments import avatar_box
from ..kernels.nearest import nearest_resident as _nearest
from ..kernels.nearest.nearest_resident import nearest_resident
from ..residency.voxel_cache import VoxelCache
from .collide import collide
from .context.query_budget import EXACT, QueryBudget
from .context.query_context import SceneData, kernel_poses, refuse, to_units
from .distance import distance
from .sweep import sweep

Vec = NDArray[np.float64]
Pose = NDArray[np.float64]

# 20 µs for the 3,617 points of the walk. Larger avatars could block other requests, and gain
# little.
MAX_FAST_POINTS = 1 << 13
# With nothing near, the time grows with the number of voxels in reach [voxels], [m].
MAX_FAST_VOXELS, MAX_FAST_REACH = 64, 2.0
# Verdict of a kernel -> `Verdict`: making one from a number would double the Python time of a query.
_VERDICTS = {CLEAR: Verdict.CLEAR, CONTACT: Verdict.CONTACT, UNKNOWN: Verdict.UNKNOWN, EARLY: Verdict.CONTACT}
_CLEAR, _CONTACT = int(Verdict.CLEAR), int(Verdict.CONTACT)
# Columns of the results of `nearest_resident` and `sweep_resident`.
_SIGNED, _LOWER = slice(_nearest.SIGNED, _nearest.LOWER), slice(_nearest.LOWER, _nearest.NORMAL)
_NORMAL, _AVATAR = slice(_nearest.NORMAL, _nearest.AVATAR), slice(_nearest.AVATAR, _nearest.CLOUD)
_CLOUD = slice(_nearest.CLOUD, None)
_SWEPT_BOUNDS, _SWEPT_AVATAR = slice(_swept.AVATAR), slice(_swept.AVATAR, _swept.CLOUD)
_SWEPT_CLOUD, _POINT = slice(_swept.CLOUD, _swept.ENDED), slice(_swept.POINT, _swept.END)
_END = slice(_swept.END, None)
# This many consecutive queries of `ResidentQueries` in the same voxels count as one use of them.
_QUERIES_PER_USE = 16


def collide_fast(
    data: SceneData, avatar: AvatarModel, poses: ArrayLike, margin: float = 0.0, budget: QueryBudget = EXACT
) -> CollideAnswers:
    """Answer `collide`, in one kernel call if there is one pose and the fast path applies."""
    begin = time.perf_counter()
    array = kernel_poses(poses)
    if len(array) != 1 or len(avatar.points) > MAX_FAST_POINTS or budget.tolerance or _has_unknown(data):
        return collide(data, avatar, array, margin, budget)
    residency = data.residency
    verdict, counts = np.zeros(1, np.uint8), np.zeros((3, 1), np.uint32)
    other_units = data.radius_units + to_units(margin, "margin")
    body, held = refer_to_avatar(avatar.arrays), data.references.to(data.arrays, data.tree)
    with residency.frozen():
        fault, found, needed = held.call(
            collide_resident, array, body, avatar.radius, other_units, 0, held.reference, budget.stop.flag, verdict,
            counts,
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
    data: SceneData,
    avatar: AvatarModel,
    poses: ArrayLike,
    reach: float,
    budget: QueryBudget = EXACT,
    body: Any = None,
) -> DistanceAnswers:
    """Answer `distance`, in one kernel call if there is one pose and the fast path applies.

    body: reference to the arrays of the avatar, if there is one.
    """
    begin = time.perf_counter()
    poses = kernel_poses(poses)
    if (
        len(poses) != 1
        or not 0.0 <= reach <= MAX_FAST_REACH
        or len(avatar.points) > MAX_FAST_POINTS
        or _has_unknown(data)
    ):
        return distance(data, avatar, poses, reach, budget)
    reach_units = to_units(reach, "reach")
    residency = data.residency
    result = np.empty(_nearest.COLUMNS)
    body = refer_to_avatar(avatar.arrays) if body is None else body
    held = data.references.to(data.arrays, data.tree)
    with residency.frozen():
        fault, found, needed, visits, tests = held.call(
            nearest_resident, poses, body, avatar.radius, data.radius_units, reach_units, float(reach), held.reference,
            budget.stop.flag, result,
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


def _has_unknown(data: SceneData) -> bool:
    """Return whether a scan was left out anywhere, or a load proved the index wrong."""
    return data.nothing_clear or len(data.unknown) > 0


class SweepResult(NamedTuple):
    """First contact of an avatar on a motion. Fields as for one motion in `SweepAnswers`.

    avatar, cloud: (3,) the witness's centres, world [m]; None unless the verdict is CONTACT.
    archive: number of the touched archive in its scene.
    exact: whether no other contact can come first, and no avatar point moves farther than the
    tolerance between `lower` and `upper`.
    visits: node visits.  missing: voxels that could not be examined.
    unknown: whether something in reach was not examined. If it is false, a contact that is not
    exact may be a graze.
    point: (3,), the avatar's centre of the witness, avatar frame [m]; end: (4, 4), a clear pose the
    skin before the contact, or where the motion began if that is nearer than a motion. None if not
    requested or not known.
    """

    verdict: Verdict
    lower: float
    upper: float
    avatar: Vec | None = None
    cloud: Vec | None = None
    archive: int = 0
    exact: bool = True
    visits: int = 0
    missing: int = 0
    unknown: bool = False
    point: Vec | None = None
    end: Pose | None = None


class ResidentQueries:
    """Queries of one avatar, frame after frame. Not thread-safe: it reuses its arrays.

    avatar: the avatar's model.  body: reference to its arrays.
    """

    __slots__ = (
        "_again",
        "_box",
        "_counts",
        "_first",
        "_last",
        "_poses",
        "_result",
        "_scratch",
        "_small",
        "_used",
        "_verdict",
        "_walking",
        "avatar",
        "body",
    )

    def __init__(self, avatar: AvatarModel) -> None:
        self.avatar = avatar
        self.body = Held(refer_to_avatar(avatar.arrays))
        self._small = 0 < len(avatar.points) <= MAX_FAST_POINTS
        self._box = avatar_box(avatar.arrays) if len(avatar.points) else np.zeros((2, 3))
        self._scratch = make_scratch(avatar.arrays) if self._small else None
        self._poses, self._first, self._last = np.empty((1, 4, 4)), np.empty((4, 4)), np.empty((4, 4))
        self._result = np.empty(_swept.COLUMNS)
        self._walking: Any = None
        self._verdict = np.zeros(1, np.uint8)
        self._counts = np.zeros((3, 1), np.uint32)
        self._used: list[int] = []
        self._again = 0

    def sweep(
        self,
        data: SceneData,
        pose_from: Pose,
        pose_to: Pose,
        tolerance: float,
        budget: QueryBudget,
        skin: float = -1.0,
    ) -> SweepResult:
        """Find when the avatar first touches between two poses (4, 4); errors as for `sweep`.

        skin: distance to keep from a contact [m], for `SweepResult.end`; negative: not requested.
        """
        if self._small:
            residency, result = data.residency, self._result
            self._first[:], self._last[:] = pose_from, pose_to
            held = data.references.to(data.arrays, data.tree)
            with residency.frozen():
                needed, verdict, visits, _, _ = held.call(
                    sweep_resident, self._first, self._last, self.body.reference, self._scratch, self.avatar.radius,
                    data.radius_units, self._box, held.reference, budget.stop.flag, data.nothing_clear,
                    max(tolerance, budget.tolerance), skin, result,
                )  # fmt: skip
                if needed > 0:
                    self.use(residency, held.rows[:needed].tolist())
            if needed >= 0:
                return self._swept(
                    data, pose_from, verdict, visits, max(tolerance, budget.tolerance), skin, result
                )
        answers = sweep(data, self.avatar, pose_from[None], pose_to[None], tolerance=tolerance, budget=budget)
        verdict, exact = _VERDICTS[answers.verdict[0]], bool(answers.exact[0])
        touches, missing = verdict == Verdict.CONTACT, int(answers.voxels_missing[0])
        # A stop may leave places unexamined too.
        partial = bool(budget.stop) or _has_unknown(data)
        return SweepResult(
            verdict,
            float(answers.lower[0]),
            float(answers.upper[0]),
            answers.witness_avatar[0] if touches else None,
            answers.witness_cloud[0] if touches else None,
            0,
            exact,
            int(answers.node_visits[0]),
            missing,
            missing > 0 or verdict == Verdict.UNKNOWN or (not exact and partial),
        )

    @property
    def is_small(self) -> bool:
        """Return whether queries of the avatar take the fast path: it has points, and not too many."""
        return self._small

    @property
    def walking(self) -> Any:
        """Return the avatar's arrays for the kernel `walk_frame`."""
        if self._walking is None:
            # Imported here: only effects that walk need it.
            from ..kernels.walk.walk_state import make_walk_avatar

            scratch = self._scratch
            if scratch is None:  # not used, but of this type
                scratch = make_scratch(make_avatar([[0.0, 0.0, 0.0]], 0.1).arrays)
            points = np.ascontiguousarray(self.avatar.points)
            self._walking = make_walk_avatar(
                self.body.reference,
                self.avatar.rows,
                len(self.avatar.points) - self.avatar.inner_points,
                scratch,
                self._box,
                points,
                float(self.avatar.radius),
            )
        return self._walking

    def use(self, residency: VoxelCache, rows: list[int]) -> None:
        """Record a use of voxels, once for _QUERIES_PER_USE consecutive uses of the same voxels.

        Recording takes as long as a tenth of a query.
        """
        if rows != self._used or not self._again:
            residency.use(rows)
            self._used, self._again = rows, _QUERIES_PER_USE
        self._again -= 1

    @staticmethod
    def _swept(
        data: SceneData,
        pose_from: Pose,
        verdict: int,
        visits: int,
        tolerance: float,
        skin: float,
        result: NDArray[np.float64],
    ) -> SweepResult:
        """Return the answer in a `result` of `sweep_resident`. Other arguments as there."""
        lower, upper, speed = result[_SWEPT_BOUNDS].tolist()
        if verdict != _CONTACT:
            clear = verdict == _CLEAR
            return SweepResult(_VERDICTS[verdict], lower, upper, None, None, 0, clear, visits, 0, not clear)
        own, cloud = result[_SWEPT_AVATAR].copy(), result[_SWEPT_CLOUD].copy()
        exact = upper == lower or speed * (upper - lower) <= tolerance
        unknown = not exact and _has_unknown(data)
        if skin < 0.0:
            return SweepResult(Verdict.CONTACT, lower, upper, own, cloud, 0, exact, visits, 0, unknown)
        ended, end = result[_swept.ENDED], None
        if ended != _swept.OPEN:
            end = result[_END].reshape(4, 4).copy() if ended == _swept.PROVED else pose_from
        point = result[_POINT].copy()
        return SweepResult(
            Verdict.CONTACT, lower, upper, own, cloud, 0, exact, visits, 0, unknown, point, end
        )

    def collide(self, data: SceneData, pose: Pose, budget: QueryBudget) -> tuple[Verdict, int]:
        """Return verdict and node visits of `collide` for a pose (4, 4)."""
        if self._small and not _has_unknown(data):
            residency = data.residency
            held = data.references.to(data.arrays, data.tree)
            poses, verdict, counts = self._poses, self._verdict, self._counts
            poses[0] = pose
            with residency.frozen():
                fault, found, needed = held.call(
                    collide_resident, poses, self.body.reference, self.avatar.radius, data.radius_units,
                    budget.tolerance_units, held.reference, budget.stop.flag, verdict, counts,
                )  # fmt: skip
                if needed > 0:
                    self.use(residency, held.rows[:needed].tolist())
            refuse(fault, 0, found)
            if needed >= 0:
                return _VERDICTS[int(verdict[0])], int(counts[1, 0])
        answers = collide(data, self.avatar, pose[None], budget=budget)
        budget.lacked(len(answers.late))
        return _VERDICTS[answers.verdict[0]], int(answers.node_visits[0])

    def between(self, origin: Vec, pose_from: Pose, pose_to: Pose, fraction: float) -> tuple[Pose, bool]:
        """Return the pose at a fraction of a motion, and whether a sweep's proof holds for it.

        origin: (3,) of the dataset, world [m].
        """
        pose = np.empty((4, 4))
        self._first[:], self._last[:] = pose_from, pose_to
        same = self.body.call(pose_between, self._first, self._last, fraction, self._box, origin, pose)
        return pose, bool(same)
