"""Fast path of `sweep` and `collide` for one avatar, queried frame after frame.

A query has one motion or one pose, and takes one kernel call if all voxels are resident. The
answers equal those of server/queries/sweep.py and server/queries/collide.py bit for bit. These are
called if a voxel has to be loaded or the fast path does not apply.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...schemas.wire.answers import Verdict
from ..avatars.avatar_model import AvatarModel
from ..kernels.motion.sweep_resident import AVATAR, CLOUD, COLUMNS, box_of, pose_between, sweep_resident
from ..kernels.overlap.overlap import answer_resident
from ..residency.voxel_cache import Residency
from .collide import QUICK_POINTS, collide
from .context.query_budget import QueryBudget
from .context.query_context import SceneData, refuse
from .sweep import sweep

Vec = NDArray[np.float64]
Pose = NDArray[np.float64]

# Verdicts by value: constructing one from a number would double the Python time of a query.
_VERDICTS = tuple(Verdict(value) for value in range(3))
_CLEAR = int(Verdict.CLEAR)
# Most voxels in reach of a query on the fast path.
_ROWS = 64
# This many consecutive queries in the same voxels count as one use of them.
_AGAIN = 16


class Swept(NamedTuple):
    """First contact of an avatar on a motion. Fields as for one motion in `SweepAnswers`.

    avatar, cloud: (3,) the witness's centres, world [m]; None unless the verdict is CONTACT.
    archive: number of the touched archive in its scene.
    exact: whether nothing else can be touched before: no point moves farther than the tolerance
    between `lower` and `upper`.
    visits: node visits.  missing: voxels that could not be examined.
    unknown: whether something in reach could not be or was not examined. If it is false, a contact
    that is not exact may be a graze, with everything examined.
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


def _has_unknown(data: SceneData) -> bool:
    """Return whether a scan was left out anywhere, or a load proved the index wrong."""
    return data.nothing_clear or len(data.unknown) > 0


class Probe:
    """Queries of one avatar. Not thread-safe: it reuses its arrays.

    avatar: the avatar's model.
    """

    __slots__ = (
        "_again",
        "_box",
        "_counts",
        "_outside",
        "_poses",
        "_rows",
        "_said",
        "_used",
        "_verdict",
        "avatar",
        "quick",
    )

    def __init__(self, avatar: AvatarModel) -> None:
        self.avatar = avatar
        self.quick = 0 < len(avatar.points) <= QUICK_POINTS
        self._box = box_of(avatar.arrays) if len(avatar.points) else np.zeros((2, 3))
        self._poses = np.empty((1, 4, 4))
        self._rows, self._said = np.empty(_ROWS, np.int64), np.empty(COLUMNS)
        self._verdict, self._outside = np.zeros(1, np.uint8), np.zeros(1, bool)
        self._counts = np.zeros((3, 1), np.uint32)
        self._used: list[int] = []
        self._again = 0

    def sweep(
        self, data: SceneData, pose_from: Pose, pose_to: Pose, tolerance: float, budget: QueryBudget
    ) -> Swept:
        """Find when the avatar first touches between two poses (4, 4).

        server/queries/sweep.py documents the errors.
        """
        if self.quick and not budget.limited:
            avatar, residency, rows, said = self.avatar, data.residency, self._rows, self._said
            with residency.still():
                needed, verdict, visits, _, _ = sweep_resident(
                    pose_from, pose_to, avatar.arrays, avatar.radius, data.radius_units, self._box, data.arrays,
                    data.broad, data.unknown, data.nothing_clear, max(tolerance, budget.tolerance), rows, said,
                )  # fmt: skip
                if needed > 0:
                    self._use(residency, rows[:needed].tolist())
            if needed >= 0:
                lower, upper, speed = said[:AVATAR].tolist()
                if verdict != Verdict.CONTACT:
                    clear = verdict == _CLEAR
                    return Swept(_VERDICTS[verdict], lower, upper, None, None, 0, clear, visits, 0, not clear)
                own, cloud = said[AVATAR:CLOUD].copy(), said[CLOUD:].copy()
                exact = upper == lower or speed * (upper - lower) <= max(tolerance, budget.tolerance)
                unknown = not exact and _has_unknown(data)
                return Swept(Verdict.CONTACT, lower, upper, own, cloud, 0, exact, visits, 0, unknown)
        answers = sweep(data, self.avatar, pose_from[None], pose_to[None], tolerance=tolerance, budget=budget)
        verdict, exact = _VERDICTS[answers.verdict[0]], bool(answers.exact[0])
        touches, missing = verdict == Verdict.CONTACT, int(answers.voxels_missing[0])
        # A budget may leave places unexamined too.
        partial = budget.limited or bool(data.arrays.stop.item(0)) or _has_unknown(data)
        return Swept(
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

    def _use(self, residency: Residency, rows: list[int]) -> None:
        """Record a use of voxels, once for _AGAIN consecutive queries in the same voxels.

        Recording takes as long as a tenth of a query.
        """
        if rows != self._used or not self._again:
            residency.use(rows)
            self._used, self._again = rows, _AGAIN
        self._again -= 1

    def collide(self, data: SceneData, pose: Pose, budget: QueryBudget) -> tuple[Verdict, int]:
        """Return verdict and node visits for a pose (4, 4); see server/queries/collide.py."""
        if self.quick and not budget.limited and not data.nothing_clear and not len(data.unknown):
            avatar, residency, rows = self.avatar, data.residency, self._rows
            poses, verdict, counts = self._poses, self._verdict, self._counts
            poses[0] = pose
            verdict[0] = _CLEAR
            counts[:] = 0
            with residency.still():
                fault, at, found, needed = answer_resident(
                    poses, avatar.arrays, avatar.radius, data.radius_units, data.arrays, data.broad, rows,
                    self._outside, verdict, counts,
                )  # fmt: skip
                if needed > 0:
                    self._use(residency, rows[:needed].tolist())
            refuse(fault, at, found)
            if needed >= 0:
                return _VERDICTS[verdict[0]], int(counts[1, 0])
        answers = collide(data, self.avatar, pose[None], budget=budget)
        return _VERDICTS[answers.verdict[0]], int(answers.node_visits[0])

    def between(self, origin: Vec, pose_from: Pose, pose_to: Pose, fraction: float) -> tuple[Pose, bool]:
        """Return the pose at a fraction of a motion, and whether a sweep's proof holds for it.

        origin: (3,) of the dataset, world [m].
        """
        pose = np.empty((4, 4))
        same = pose_between(pose_from, pose_to, fraction, self._box, origin, pose)
        return pose, bool(same)
