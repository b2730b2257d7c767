"""Query `sweep`: first contact of an avatar with the scene on a motion between two poses."""

import time

import msgspec
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...schemas.archive.units import UNITS_PER_METRE
from ...schemas.archive.voxel_grid import MAX_COORDINATE
from ...schemas.errors import BadRequestError, BadTransformError
from ...schemas.wire.answers import SweepAnswers, Verdict
from ..avatars.avatar_model import AvatarModel
from ..kernels.core.voxels_in_reach import SIMILARITY_TOLERANCE, VoxelsInReach, check_poses
from ..kernels.motion.motion_scratch import make_scratch
from ..kernels.motion.sweep_advance import advance_segments
from ..kernels.motion.sweep_segments import SweepProgress, avatar_box, find_unknown_regions, plan_segments
from ..residency.index_proof import ENTRIES_AT_ONCE
from ..runtime.stop_flag import StopFlag
from .context.level_of_detail import ask_after_deadline
from .context.query_budget import EXACT, CostCounter, QueryBudget
from .context.query_context import (
    LevelOfDetail,
    SceneData,
    as_held,
    kernel_poses,
    pieces,
    prove,
    refuse,
    to_units,
)
from .late_sweep import AbsentVoxels, Motions, clear_until
from .sweep_by_level import DEFAULT_TOLERANCE, SweepsByLevel, cold_motions


def _check(
    data: SceneData,
    avatar: AvatarModel,
    first: NDArray[np.float64],
    last: NDArray[np.float64],
    other_units: int,
) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.float64]]:
    """Check the poses of k motions, and return scales, reaches and their variation, (k,) each.

    Scale and reach are the larger of those at both ends. The reach is in exact units and includes
    the scan's largest sphere. The variation bounds how much the reach changes during the motion
    [exact units].
    """
    k = len(first)
    scales, units = np.ones((2, k)), np.zeros((2, k), np.int64)  # a stop may leave some unchanged
    for end, poses in enumerate((first, last)):
        fault, pose, found = check_poses(
            poses, avatar.arrays.radius, avatar.radius, other_units, data.arrays, scales[end], units[end]
        )
        refuse(fault, pose, found)
    apart = np.abs(scales[1] - scales[0]) > SIMILARITY_TOLERANCE * scales[0]
    if apart.any():
        i = int(apart.argmax())
        raise BadTransformError(
            f"motion {i} begins at scale {scales[0, i]:g} and ends at {scales[1, i]:g}: expected one scale "
            "within 1e-9: a rigid motion changes no size"
        )
    # During the motion the scale lies between those of the ends. If both are well within 1e-9 of 1,
    # it is 1 throughout (voxels_in_reach.py).
    rigid = np.ones(k, bool)
    for poses in (first, last):
        rigid &= np.abs((poses[:, :3, :3] ** 2).sum(axis=(1, 2)) / 3.0 - 1.0) <= SIMILARITY_TOLERANCE
    most = units.max(axis=0)
    loose = np.where(rigid, 0.0, most - units.min(axis=0) + 2.0)
    loose[~rigid] += 2.0 * SIMILARITY_TOLERANCE * scales.max(axis=0)[~rigid] * avatar.radius * UNITS_PER_METRE
    return scales.max(axis=0), most, loose


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


def sweep(
    data: SceneData,
    avatar: AvatarModel,
    pose_from: ArrayLike,
    pose_to: ArrayLike,
    margin: float = 0.0,
    tolerance: float = DEFAULT_TOLERANCE,
    budget: QueryBudget = EXACT,
) -> SweepAnswers:
    """Find the first contact of the avatar with the scene on the screw motion between two poses.

    kernels/motion/screw_motion.py defines the motion, in the dataset's frame: translations are
    t - O (NUMERICS.md N5). Each scan point has the sphere given by the radius model of `data`,
    constant during the motion.
    pose_from, pose_to: (k, 4, 4) float64, avatar to world, rigid or of one scale, bits used as
    given.
    margin: distance at or below which two spheres are in contact [m].
    tolerance: how far any avatar point may move between `lower` and `upper` [m]; the tolerance of
    `budget` if that is larger.
    The verdict is CONTACT in [lower, upper]; CLEAR; or UNKNOWN from `lower` on: something is
    missing there, the deadline passed, or a graze of some hundredths of a micrometre cannot be
    distinguished from a touch. A contact found after an unknown place is CONTACT with exact=False.
    If the budget has a tolerance, or where voxels are late, the scene's level of detail is asked
    before they are loaded: how far the motion is clear, and whether a contact is near enough to
    that place. With a budget that does not wait for loads, late_sweep.py bounds the motion by absent
    voxels.
    Raise BadRequestError, BadTransformError, TooLargeError.
    """

    def ask(
        scene: SceneData,
        begin: NDArray[np.float64],
        end: NDArray[np.float64],
        within: float,
        own: QueryBudget,
    ) -> SweepAnswers:
        return _sweep(scene, avatar, begin, end, margin, within, own, None)

    absent = None if budget.late is None else AbsentVoxels()
    level = SweepsByLevel(data, max(tolerance, budget.tolerance), budget, ask)
    answers = _sweep(data, avatar, pose_from, pose_to, margin, tolerance, budget, level, absent)
    which = np.flatnonzero(answers.verdict == Verdict.UNKNOWN)
    if not len(which):
        return answers

    def ask_late(late: LevelOfDetail, own: QueryBudget) -> SweepAnswers:
        return level.find_clear(late, own, kernel_poses(pose_from)[which], kernel_poses(pose_to)[which])

    found = ask_after_deadline(data, budget, ask_late)
    if found is None or data.nothing_clear:
        return answers
    lower, verdict, exact = answers.lower.copy(), answers.verdict.copy(), answers.exact.copy()
    lower[which] = np.maximum(lower[which], found.lower)
    clear = which[found.verdict == Verdict.CLEAR]
    verdict[clear], exact[clear] = Verdict.CLEAR, True
    return msgspec.structs.replace(answers, lower=lower, verdict=verdict, exact=exact)


def _sweep(
    data: SceneData,
    avatar: AvatarModel,
    pose_from: ArrayLike,
    pose_to: ArrayLike,
    margin: float,
    tolerance: float,
    budget: QueryBudget,
    level: SweepsByLevel | None,
    absent: AbsentVoxels | None = None,
) -> SweepAnswers:
    """Answer `sweep` from the voxels of the scene, and before they are loaded from its level.

    absent: collects the voxels that are not in memory and bounds the motions by them; None: these
    are loaded.
    """
    begin = time.perf_counter()
    if not 0.0 <= tolerance <= MAX_COORDINATE:
        raise BadRequestError(f"tolerance {tolerance!r}: expected zero or a positive length in metres")
    tolerance = max(tolerance, budget.tolerance)
    first, last = kernel_poses(pose_from), kernel_poses(pose_to)
    if len(first) != len(last):
        raise BadRequestError(
            f"{len(first)} poses to begin at and {len(last)} to end at: expected equal numbers"
        )
    k = len(first)
    other_units = data.radius_units + to_units(margin, "margin")
    scales, units, loose = _check(data, avatar, first, last, other_units)
    world = first, last
    data, first, last, origin = _from_origin(data, first, last)
    progress = SweepProgress(
        np.zeros(k), np.ones(k), np.ones(k), np.full(k, np.inf), np.zeros(k), np.full((k, 2, 3), np.nan)
    )
    counts, outside = np.zeros((4, k), np.uint32), np.zeros(k, bool)
    proved = np.ones(k)
    if not len(avatar.points) or not k:
        return _answers(progress, proved, counts, outside, tolerance)
    bounds, residency, box = data.bounds, data.residency, avatar_box(avatar.arrays)
    spent = CostCounter(begin, residency, data.broad.keys)
    starts, rows = np.zeros(k + 1, np.int64), np.empty(16 * k + 64, np.int64)
    which = np.arange(k)
    asked: set[int] = set()  # rows loaded to prove the index
    by_level: NDArray[np.bool_] = np.zeros(k, bool)  # motions about which the level was asked
    # A round plans the next segment of each unfinished motion, loads the voxels that only the index
    # excludes, and advances the motions through the segment's voxels, piece by piece.
    scratch = make_scratch(avatar.arrays)
    while len(which):
        begun = progress.at.copy()
        unproved = bounds.unproved
        planned = box, first, last, avatar.arrays, scales, units, data.arrays
        needed = plan_segments(*planned, data.broad, which, progress, starts, rows)
        if needed < 0:
            break
        if needed > len(rows):
            rows = np.empty(2 * needed, np.int64)
            continue
        if level is not None and level.before_loads:
            cold = cold_motions(data, starts, rows, by_level)
            if len(cold):
                by_level[cold] = True
                progress.at[:] = begun
                settled = level.settle(cold, *world, progress, proved, tolerance)
                progress.witness[settled] -= origin
                own = progress.witness[settled, 0]
                progress.witness[settled, 0] = np.rint(own * UNITS_PER_METRE) / UNITS_PER_METRE
                which = np.setdiff1d(which, settled)
                continue
        if unproved and absent is None and bounds.unsettled(rows[:needed], unproved).any():
            # By the boxes of the index some may be out of reach, or be met later, which changes the
            # segments: what is answered must not depend on which voxels were loaded before.
            by_index = progress._replace(
                at=begun.copy(), end=progress.end.copy(), speed=progress.speed.copy()
            )
            index_starts, index_rows = starts.copy(), np.empty_like(rows)
            count = plan_segments(*planned, bounds.index_boxes, which, by_index, index_starts, index_rows)
            if not 0 <= count <= len(index_rows):
                index_starts[:] = 0
            moved = (by_index.at != progress.at) | (by_index.end != progress.end)
            doubted = _hidden_rows(
                (starts, rows), (index_starts, index_rows), moved, len(bounds.proved), budget.stop
            )
            new = set(doubted) - asked
            if new:
                asked |= new
                prove(data, sorted(row for row in new if not bounds.proved[row]), budget, spent)
                progress.at[:] = begun
                continue
        progress.lower[which] = progress.end[which]
        boxes = np.empty((k, 2, 3))  # unused here
        near = starts, rows
        if absent is not None:
            near = absent.set_aside(starts, rows, data.arrays.where)
        around = VoxelsInReach(scales, units, *near, boxes, outside)
        for part, held_rows, reach in pieces(around, residency, budget.share, budget.stop):
            if budget.stop:
                progress.lower[part] = np.minimum(progress.lower[part], progress.at[part])
                continue
            with residency.hold(held_rows, budget.loads_until(), scan=budget.scan, stop=budget.stop) as held:
                seen = as_held(data, held, budget)
                advance_segments(
                    box, first, last, avatar.arrays, avatar.radius, other_units, scales, units, loose, seen.arrays,
                    data.broad, reach.starts, reach.rows, part, tolerance, scratch, progress, counts,
                )  # fmt: skip
            spent.add(held)
        which = _next_round(which, progress, proved)
        if budget.stop:
            break
    # Beyond the place where a motion was stopped, nothing is known.
    proved[which] = np.minimum(proved[which], progress.at[which])
    until = np.minimum(progress.upper, 1.0)
    if absent is not None and absent.rows and not absent.restricted:
        motions = Motions(first, last, scales, units, loose, box)
        clear = clear_until(
            data, avatar, motions, absent, budget,
            lambda covers, own: _sweep(covers, avatar, pose_from, pose_to, margin, tolerance, budget, None, own),
        )  # fmt: skip
        counts[0][clear < until] += np.uint32(len(absent.rows))
        proved = np.minimum(proved, clear)
        if (clear < 1.0).any() or (progress.upper < np.inf).any():
            # What else is near decides in which interval a contact is found.
            budget.lacked(len(absent.rows))
            with residency.hold(sorted(absent.rows), budget.loads_until()) as held:
                spent.add(held)  # their loads are owed
    lost = np.empty(k)
    find_unknown_regions(
        box,
        first,
        last,
        avatar.arrays,
        scales,
        units,
        data.arrays,
        data.broad,
        data.unknown,
        until,
        outside,
        lost,
    )
    if data.nothing_clear:
        lost[:] = 0.0
    met = lost <= until
    proved[met] = np.minimum(proved, lost)[met]
    progress.witness[:] += origin
    answers = _answers(progress, proved, counts, outside, tolerance)
    return msgspec.structs.replace(answers, **spent.fields())


def _hidden_rows(
    planned: tuple[NDArray[np.int64], NDArray[np.int64]],
    by_index: tuple[NDArray[np.int64], NDArray[np.int64]],
    moved: NDArray[np.bool_],
    voxels: int,
    stop: StopFlag,
) -> list[int]:
    """Return the distinct rows, ascending, in reach of a motion by `planned` but not by the index.

    planned, by_index: starts (k + 1,) and rows of k motions.
    moved: (k,) motions whose segment is another one by the index; all their rows are returned.
    stop: once it is set, the result may be incomplete.
    """
    hidden: NDArray[np.bool_] = np.zeros(voxels, bool)
    starts, _ = planned
    begin, k = 0, len(starts) - 1
    while begin < k and not stop:
        end = int(np.searchsorted(starts, starts[begin] + ENTRIES_AT_ONCE, side="right")) - 1
        end = min(max(end, begin + 1), k)
        own, known = (_pairs(*lists, begin, end, voxels) for lists in (planned, by_index))
        known = known[~moved[known // voxels]]
        hidden[np.setdiff1d(own, known) % voxels] = True
        begin = end
    found: list[int] = np.flatnonzero(hidden).tolist()
    return found


def _pairs(
    starts: NDArray[np.int64], rows: NDArray[np.int64], begin: int, end: int, voxels: int
) -> NDArray[np.int64]:
    """Encode each row of motions [begin, end) as one number: motion * voxels + voxel."""
    motions = np.repeat(np.arange(begin, end), np.diff(starts[begin : end + 1]))
    return np.asarray(motions * voxels + rows[starts[begin] : starts[end]], np.int64)


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
