"""Query `sweep`: first contact of an avatar with the scene on a motion between two poses."""

from typing import Any, NamedTuple

import numpy as np
from msgspec import structs
from numpy.typing import ArrayLike, NDArray

from ...schemas.archive.voxel_grid import MAX_COORDINATE
from ...schemas.errors import BadRequestError, TooLargeError
from ...schemas.wire.answers import SweepAnswers, Verdict
from ..avatars.avatar_model import AvatarModel
from ..kernels.core.reach import VoxelLists
from ..kernels.motion.sweep_resident import make_scratch
from ..kernels.motion.sweep_segments import (
    SweepProgress,
    advance_segments,
    find_unknown_regions,
    make_plan_space,
    plan_segments,
)
from ..runtime.stop_flag import StoppedError
from .level_of_detail import below, find_level, level_budget
from .request import EXACT, CostCounter, QueryBudget, check_avatar, kernel_poses
from .resolve import Steps, answered, drop_items, resolve
from .scene_data import LevelOfDetail, SceneData, to_units, with_stop

# `tolerance` of a request that gives none [m].
DEFAULT_TOLERANCE = 1e-6
# Tolerance of a sweep through the level, as a share of the request's, and at least [m]: no time is spent
# on less than covers.
_LEVEL_SHARE, _LEVEL_LEAST = 0.25, 1e-4


def _from_origin(
    data: SceneData, first: NDArray[np.float64], last: NDArray[np.float64]
) -> tuple[SceneData, NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Move scene and poses so that the dataset's origin is zero; return its world position too [m].

    Intermediate poses are computed and rounded in this frame. A scene at map coordinates therefore
    gives the same answers as at the origin, bit for bit (NUMERICS.md case 1), with intermediate
    poses of the same precision. The end poses are t - O, see N5.
    """
    origin = data.arrays.origin
    first, last = first.copy(), last.copy()
    for poses in (first, last):
        poses[:, :3, 3] -= origin
    return data._replace(arrays=data.arrays._replace(origin=np.zeros(3))), first, last, origin


def _answers(
    progress: SweepProgress, frozen: NDArray[np.float64], counts: NDArray[np.uint32], outside: NDArray[np.bool_],
    tolerance: float,
) -> SweepAnswers:  # fmt: skip
    """Make the answers from the progress of each motion.

    frozen: (k,) fraction up to which the motion is proved clear.
    """
    touches = progress.upper < np.inf
    verdict = np.full(len(frozen), Verdict.UNKNOWN, np.uint8)
    verdict[touches] = Verdict.CONTACT
    verdict[~touches & (frozen >= 1.0)] = Verdict.CLEAR
    with np.errstate(invalid="ignore"):
        moved = progress.speed * (progress.upper - frozen)
    exact = (verdict == Verdict.CLEAR) | (touches & ((moved <= tolerance) | (progress.upper == frozen)))
    return SweepAnswers(
        verdict=verdict, lower=frozen, upper=progress.upper, exact=exact,
        witness_avatar=progress.witness[:, 0].copy(), witness_cloud=progress.witness[:, 1].copy(),
        steps=counts[3], outside=outside, voxels_missing=counts[0], node_visits=counts[1], point_tests=counts[2],
    )  # fmt: skip


def sweep_steps(
    data: SceneData,
    avatar: AvatarModel,
    pose_from: ArrayLike,
    pose_to: ArrayLike,
    margin: float = 0.0,
    tolerance: float = 0.0,
    budget: QueryBudget = EXACT,
    part: "LevelPart | None" = None,
) -> Steps[SweepAnswers]:
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
    if not 0.0 <= tolerance <= MAX_COORDINATE:
        raise BadRequestError(f"tolerance {tolerance!r}: expected zero or a positive length in metres")
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
    data, first, last, origin = _from_origin(data, first, last)
    progress = SweepProgress(
        np.zeros(k), np.ones(k), np.ones(k), np.full(k, np.inf), np.zeros(k), np.full((k, 2, 3), np.nan),
        np.zeros(k), np.zeros(k),
    )  # fmt: skip
    counts, outside = np.zeros((4, k), np.uint32), np.zeros(k, bool)
    proved = np.ones(k)
    if not len(avatar.points) or not k:
        return _answers(progress, proved, counts, outside, tolerance)
    box, scratch = avatar.box, make_scratch(avatar.arrays)
    # The default tolerance is the rounding of an interval: such a sweep is an exact request.
    level = find_level(data, budget if tolerance > DEFAULT_TOLERANCE else budget._replace(tolerance=0.0))
    settled: NDArray[np.bool_] = np.zeros(k, bool)

    arrays = with_stop(data, budget.stop).arrays

    def search(lists: VoxelLists, *state: NDArray[Any]) -> None:
        advance_segments(
            box, first, last, avatar.arrays, units, arrays, lists,
            *state, tolerance, scratch, progress, counts,
        )  # fmt: skip

    def settle(lists: VoxelLists) -> Steps[VoxelLists]:
        which = np.flatnonzero(np.diff(lists.starts))
        if level is None:
            return lists
        own = LevelPart(level, lists.rows[: lists.starts[-1]], progress.at[which], progress.end[which])
        progress.floor[which] = yield from _clear_until(
            own, avatar, world[0][which], world[1][which], margin, tolerance, budget, spent
        )
        settled[which] = progress.floor[which] >= progress.end[which]
        return drop_items(lists, settled)

    which = np.arange(k)
    if part is not None:
        progress.at[:] = part.at
    while len(which) and not budget.stop:
        lists = _plan(data, avatar, box, first, last, units, which, progress)
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
    until = np.minimum(progress.upper, 1.0)
    unknown = np.empty(k)
    find_unknown_regions(
        box, first, last, avatar.arrays, units, data.arrays, data.tree, until, make_plan_space(), outside, unknown
    )  # fmt: skip
    if data.nothing_clear:
        unknown[:] = 0.0
    met = unknown <= until
    proved[met] = np.minimum(proved, unknown)[met]
    progress.witness[:] += origin
    answers = _answers(progress, proved, counts, outside, tolerance)
    return structs.replace(answers, **spent.fields())


sweep = answered(sweep_steps)


def _plan(
    data: SceneData,
    avatar: AvatarModel,
    box: NDArray[np.float64],
    first: NDArray[np.float64],
    last: NDArray[np.float64],
    units: NDArray[np.int64],
    which: NDArray[np.int64],
    progress: SweepProgress,
) -> VoxelLists | None:
    """Plan the next segment of each motion in `which`, and list its voxels; None after a stop."""
    k, capacity = len(first), 16 * len(which) + 64
    space, moved = make_plan_space(), np.empty(len(which))
    while True:
        lists = VoxelLists(
            np.zeros(k + 1, np.int64), np.empty(capacity, np.int64), np.empty(capacity), np.full(k, np.inf)
        )
        needed = plan_segments(
            box, first, last, avatar.arrays, units, data.arrays, data.tree, which, progress, lists, space, moved
        )  # fmt: skip
        if needed < 0:
            return None
        if needed <= capacity:
            return lists
        capacity = needed


class LevelPart(NamedTuple):
    """Part of k motions, and voxels, about which a level is asked.

    rows: voxels of the scene that the level divides.  at, end: (k,) fractions.
    """

    level: LevelOfDetail
    rows: NDArray[np.int64]
    at: NDArray[np.float64]
    end: NDArray[np.float64]


def _clear_until(
    part: LevelPart,
    avatar: AvatarModel,
    first: NDArray[np.float64],
    last: NDArray[np.float64],
    margin: float,
    tolerance: float,
    budget: QueryBudget,
    spent: CostCounter,
) -> Steps[NDArray[np.float64]]:
    """Return the fraction (k,) up to which the level proves that motions, world, touch none of its voxels."""
    covers = part.level.covers
    within = max(tolerance * _LEVEL_SHARE, _LEVEL_LEAST)
    try:
        found = yield from sweep_steps(
            covers, avatar, first, last, margin, within, level_budget(budget), part
        )
    except (BadRequestError, TooLargeError, StoppedError):  # cover spheres are larger than those of the scene
        return np.zeros(len(first))
    spent.add_level(found)
    return np.zeros(len(first)) if covers.nothing_clear else found.lower


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
