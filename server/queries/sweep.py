"""Query `sweep`: first contact of an avatar with the scene on a motion between two poses."""

import time
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...schemas.errors import BadRequestError, TooLargeError
from ...schemas.wire.answers import SweepAnswers, Verdict
from ..avatars.avatar_model import AvatarModel
from ..kernels.core.array_references import record_type
from ..kernels.core.reach import VoxelLists
from ..kernels.motion.sweep_resident import SWEPT, make_scratch, sweep_resident
from ..kernels.motion.sweep_segments import (
    SweepProgress,
    advance_segments,
    find_unknown_regions,
    make_plan_space,
    plan_segments,
)
from ..runtime.stop_flag import StoppedError
from .collide import MAX_FAST_POINTS, search_resident
from .level_of_detail import below, find_level, level_budget
from .load_and_search import Slices, answered, drop_items, resolve
from .query_inputs import (
    EXACT,
    CostCounter,
    LevelOfDetail,
    QueryBudget,
    SceneData,
    check_avatar,
    kernel_poses,
    to_units,
    with_stop,
)

# `tolerance` of a request that gives none [m].
DEFAULT_TOLERANCE = 1e-6
# Tolerance of a sweep through the level, as a share of the request's, and at least [m]: no time is spent
# on less than covers.
_LEVEL_SHARE, _LEVEL_LEAST = 0.25, 1e-4
_SWEPT = record_type(*SWEPT)
_CLEAR, _CONTACT = int(Verdict.CLEAR), int(Verdict.CONTACT)


class LevelPart(NamedTuple):
    """Part of k motions, and voxels, about which a level is asked.

    rows: voxels of the scene that the level divides.  at, end: (k,) fractions.
    """

    level: LevelOfDetail
    rows: NDArray[np.int64]
    at: NDArray[np.float64]
    end: NDArray[np.float64]


def sweep_slices(
    data: SceneData,
    avatar: AvatarModel,
    pose_from: ArrayLike,
    pose_to: ArrayLike,
    margin: float = 0.0,
    tolerance: float = 0.0,
    budget: QueryBudget = EXACT,
    part: LevelPart | None = None,
) -> Slices[SweepAnswers]:
    """Find the first contact of the avatar with the scene on the screw motion between two poses.

    kernels/motion/screw_motion.py defines the motion, in the dataset's frame: translations are
    t - O (NUMERICS.md N5). Each scan point has the sphere given by the radius model of `data`,
    constant during the motion.
    pose_from, pose_to: (k, 4, 4) float64, avatar to world, rigid, bits used as given.
    margin: distance at or below which two spheres are in contact [m].
    tolerance: how far any avatar point may move between `lower` and `upper` [m]; the tolerance of
    `budget` if that is larger.
    part: `data` is a level, and only this part of the motions and of its voxels counts.
    The verdict is CONTACT in [lower, upper]; CLEAR; or UNKNOWN from `lower` on: something is
    missing there, the budget was spent, or a graze of some hundredths of a micrometre cannot be
    distinguished from a touch. A contact found after an unknown place is CONTACT with exact=False.
    Where voxels are absent, the scene's level of detail may prove how far the motion is clear of them
    (`find_level`). Raise BadRequestError, BadTransformError, TooLargeError.
    """
    spent = CostCounter(data)
    to_units(tolerance, "tolerance")  # it is a length
    tolerance = max(tolerance, budget.tolerance)
    first, last = kernel_poses(pose_from), kernel_poses(pose_to)
    if len(first) != len(last):
        raise BadRequestError(
            f"{len(first)} poses to begin at and {len(last)} to end at: expected equal numbers"
        )
    k, world = len(first), (first, last)
    other_units = data.radius_units + to_units(margin, "margin")
    units = check_avatar(data, avatar, first, other_units)
    check_avatar(data, avatar, last, other_units)
    # Intermediate poses are computed and rounded from the dataset's origin, where the end poses are t - O
    # (N5): a scene at map coordinates gives the same answers as at the origin, bit for bit (NUMERICS.md
    # case 1), with intermediate poses of the same precision.
    origin = data.arrays.origin
    data = data._replace(arrays=data.arrays._replace(origin=np.zeros(3)))
    first, last = first.copy(), last.copy()
    first[:, :3, 3] -= origin
    last[:, :3, 3] -= origin
    progress = SweepProgress(
        np.zeros(k), np.ones(k), np.ones(k), np.full(k, np.inf), np.zeros(k), np.full((k, 2, 3), np.nan),
        np.zeros(k), np.zeros(k),
    )  # fmt: skip
    counts, outside, proved = np.zeros((4, k), np.uint32), np.zeros(k, bool), np.ones(k)
    which = np.arange(k if len(avatar.points) else 0)
    motions, scratch = (avatar.box, first, last, avatar.arrays, units), make_scratch(avatar.arrays)
    # The default tolerance is the rounding of an interval: such a sweep is an exact request.
    level = find_level(data, budget if tolerance > DEFAULT_TOLERANCE else budget._replace(tolerance=0.0))
    settled: NDArray[np.bool_] = np.zeros(k, bool)
    arrays = with_stop(data, budget.stop).arrays

    def search(lists: VoxelLists, *state: NDArray[Any]) -> None:
        advance_segments(*motions, arrays, lists, *state, tolerance, scratch, progress, counts)

    def settle(lists: VoxelLists) -> VoxelLists:
        """Drop the motions whose segments the level proves clear of the absent voxels."""
        if level is None:
            return lists
        which = np.flatnonzero(np.diff(lists.starts))
        own = LevelPart(level, lists.rows[: lists.starts[-1]], progress.at[which], progress.end[which])
        within, progress.floor[which] = max(tolerance * _LEVEL_SHARE, _LEVEL_LEAST), 0.0
        begins, ends = (poses[which] for poses in world)
        try:
            found = sweep(level.covers, avatar, begins, ends, margin, within, level_budget(budget), own)
        except (BadRequestError, TooLargeError, StoppedError):  # cover spheres are larger than the scene's
            return lists
        spent.add_level(found)
        if level.covers.nothing_clear:
            return lists
        progress.floor[which] = found.lower
        settled[which] = progress.floor[which] >= progress.end[which]
        return drop_items(lists, settled)

    if part is not None:
        progress.at[:] = part.at
    while len(which) and not budget.stop:
        lists = _plan(data, motions, which, progress)
        if lists is None:
            break
        if part is not None:
            lists = below(part.level, lists, part.rows)
        progress.lower[which] = progress.end[which]
        settled[:], missing = False, counts[0].copy()
        left = yield from resolve(data, lists, search, budget, spent, settle, together=True)
        # What else is near decides in which interval a contact is found: then the voxels that the
        # level settled are needed too, because the answer must not depend on what was in memory.
        again = settled & (left == np.inf) & ((progress.upper < np.inf) | (progress.lower < progress.end))
        if again.any():
            found = progress.upper.copy()
            progress.lower[again], progress.upper[again] = progress.end[again], np.inf
            counts[0, again] = missing[again]
            lists = drop_items(lists, ~again)
            left = np.minimum(left, (yield from resolve(data, lists, search, budget, spent, together=True)))
            lost = np.isinf(progress.upper) & (left < np.inf)  # stopped before it was found again
            progress.upper[lost] = found[lost]
        unfinished = left < np.inf
        progress.lower[unfinished] = np.minimum(progress.lower, progress.at)[unfinished]
        which = _next_round(which, progress, proved)
        if part is not None and (progress.at[which] >= part.end[which]).all():
            break
    # Beyond the place where a motion was stopped, nothing is known.
    proved[which] = np.minimum(proved[which], progress.at[which])
    if len(avatar.points):
        until, unknown = np.minimum(progress.upper, 1.0), np.empty(k)
        find_unknown_regions(
            *motions, data.arrays, data.tree, progress.upper, make_plan_space(), outside, unknown
        )
        if data.nothing_clear:
            unknown[:] = 0.0
        met = unknown <= until
        proved[met] = np.minimum(proved, unknown)[met]
    upper, touches, clear = progress.upper, progress.upper < np.inf, proved >= 1.0
    moved = progress.speed * (np.where(touches, upper, proved) - proved)
    verdict = np.where(touches, Verdict.CONTACT, np.where(clear, Verdict.CLEAR, Verdict.UNKNOWN))
    return SweepAnswers(
        verdict=verdict.astype(np.uint8), lower=proved, upper=upper,
        exact=np.where(touches, (moved <= tolerance) | (upper == proved), clear),
        witness_avatar=progress.witness[:, 0] + origin, witness_cloud=progress.witness[:, 1] + origin,
        steps=counts[3], outside=outside, voxels_missing=counts[0], node_visits=counts[1], point_tests=counts[2],
        **spent.fields(),
    )  # fmt: skip


sweep = answered(sweep_slices)


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
    result = np.zeros(1, _SWEPT)
    other_units = data.radius_units + to_units(margin, "margin")
    before = first[0], last[0], avatar.reference, make_scratch(avatar.arrays), other_units
    after = data.nothing_clear, float(most), result[0]
    (needed, said, visits, tests, steps), _ = search_resident(
        data, budget, sweep_resident, before, after, examined=0
    )
    if needed < 0:
        return sweep(data, avatar, first, last, margin, tolerance, budget)
    # The columns of `sweep`, made for many motions, would take half as long again as the search.
    lower, upper, touches = result["lower"], result["upper"], said == _CONTACT
    exact, residency = np.full(1, said == _CLEAR), data.residency
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


def _plan(
    data: SceneData, motions: tuple[Any, ...], which: NDArray[np.int64], progress: SweepProgress
) -> VoxelLists | None:
    """Plan the next segment of each motion in `which`, and list its voxels; None after a stop."""
    k, capacity = len(progress.at), 16 * len(which) + 64
    space, moved = make_plan_space(), np.empty(len(which))
    while True:
        lists = VoxelLists(
            np.zeros(k + 1, np.int64), np.empty(capacity, np.int64), np.empty(capacity), np.full(k, np.inf)
        )
        needed = plan_segments(*motions, data.arrays, data.tree, which, progress, lists, space, moved)
        if needed < 0:
            return None
        if needed <= capacity:
            return lists
        capacity = needed


def _next_round(
    which: NDArray[np.int64], progress: SweepProgress, proved: NDArray[np.float64]
) -> NDArray[np.int64]:
    """Evaluate a round of segments; return the motions that continue.

    proved: (k,) fraction up to which nothing touches, 1 until an unresolved place or a contact
    fixes it.
    """
    at, end, lower = progress.at[which], progress.end[which], progress.lower[which]
    touches = progress.upper[which] < np.inf
    looked = at < 1.0  # otherwise nothing was left in reach
    doubt = looked & ((lower < end) | touches) & (proved[which] >= 1.0)
    proved[which[doubt]] = lower[doubt]
    progress.at[which] = np.where(looked, end, at)
    return which[looked & ~touches & (end < 1.0)]
