"""One avatar asked about frame after frame: one motion or one pose a question, one kernel call where all is resident.

The answers are those of server/queries/sweep.py and server/queries/collide.py, bit for bit; where
something has to be loaded, or a question is none for a quick look, these give them.
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
from .context.query_budget import Effort
from .context.query_context import SceneData, refuse
from .sweep import sweep

Vec = NDArray[np.float64]
Pose = NDArray[np.float64]

# By value; making one of a number takes as long as a question's share of Python otherwise.
_VERDICTS = tuple(Verdict(value) for value in range(3))
_CLEAR = int(Verdict.CLEAR)
# Voxels in reach of a quick question.
_ROWS = 64
# So many questions in the same voxels count as one use of them.
_AGAIN = 16


class Swept(NamedTuple):
    """When an avatar first touches on its way. Fields as of one motion in `SweepAnswers`.

    avatar, cloud: (3,) the witness's centres, world [m]; None where the verdict is not CONTACT.  archive: which of a
    scene's archives is touched.  exact: nothing else may be touched before: no point goes farther than the tolerance
    between `lower` and `upper`.  visits: node visits.  missing: voxels that could not be looked at.  unknown: whether
    something there could not be looked at, or was not; a contact that is not exact may be a graze, all looked at.
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
    """Return whether a scan was left out anywhere, or a load found the index wrong."""
    return data.nothing_clear or len(data.unknown) > 0


class Probe:
    """One avatar's questions. Not thread-safe: it has arrays that are written again and again.

    avatar: the model asked about.
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
        self, data: SceneData, pose_from: Pose, pose_to: Pose, tolerance: float, effort: Effort
    ) -> Swept:
        """When the avatar first touches between two poses (4, 4).

        See server/queries/sweep.py, which says what is refused.
        """
        if self.quick and not effort.limited:
            avatar, residency, rows, said = self.avatar, data.residency, self._rows, self._said
            with residency.still():
                needed, verdict, visits, _, _ = sweep_resident(
                    pose_from, pose_to, avatar.arrays, avatar.radius, data.radius_units, self._box, data.arrays,
                    data.broad, data.unknown, data.nothing_clear, max(tolerance, effort.tolerance), rows, said,
                )  # fmt: skip
                if needed > 0:
                    self._use(residency, rows[:needed].tolist())
            if needed >= 0:
                lower, upper, speed = said[:AVATAR].tolist()
                if verdict != Verdict.CONTACT:
                    clear = verdict == _CLEAR
                    return Swept(_VERDICTS[verdict], lower, upper, None, None, 0, clear, visits, 0, not clear)
                own, cloud = said[AVATAR:CLOUD].copy(), said[CLOUD:].copy()
                exact = upper == lower or speed * (upper - lower) <= max(tolerance, effort.tolerance)
                unknown = not exact and _has_unknown(data)
                return Swept(Verdict.CONTACT, lower, upper, own, cloud, 0, exact, visits, 0, unknown)
        answers = sweep(data, self.avatar, pose_from[None], pose_to[None], tolerance=tolerance, effort=effort)
        verdict, exact = _VERDICTS[answers.verdict[0]], bool(answers.exact[0])
        touches, missing = verdict == Verdict.CONTACT, int(answers.voxels_missing[0])
        # A budget, too, leaves places that were not looked at.
        partial = effort.limited or bool(data.arrays.stop.item(0)) or _has_unknown(data)
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
        """Count voxels as used, once for questions that follow one another in the same ones: it takes as long as a
        tenth of a question."""
        if rows != self._used or not self._again:
            residency.use(rows)
            self._used, self._again = rows, _AGAIN
        self._again -= 1

    def collide(self, data: SceneData, pose: Pose, effort: Effort) -> tuple[Verdict, int]:
        """Whether the avatar touches at a pose (4, 4), and the node visits; see server/queries/collide.py."""
        if self.quick and not effort.limited and not data.nothing_clear and not len(data.unknown):
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
        answers = collide(data, self.avatar, pose[None], effort=effort)
        return _VERDICTS[answers.verdict[0]], int(answers.node_visits[0])

    def between(self, origin: Vec, pose_from: Pose, pose_to: Pose, fraction: float) -> tuple[Pose, bool]:
        """The pose at a fraction of a motion, and whether what a sweep proved of the motion there holds for it.

        origin: (3,) of the dataset, world [m].
        """
        pose = np.empty((4, 4))
        same = pose_between(pose_from, pose_to, fraction, self._box, origin, pose)
        return pose, bool(same)
