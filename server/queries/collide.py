"""Query `collide`: whether an avatar touches the scene, one verdict a pose."""

import math
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...schemas.archive.units import UNITS_PER_METRE
from ...schemas.wire.answers import CollideAnswers
from ..avatars.avatar_model import AvatarModel
from ..kernels.collide.collide_poses import collide_poses
from ..kernels.collide.early_contact import CLEAR, CONTACT, EARLY, UNKNOWN, write_verdict_bounds
from ..kernels.core.voxels_in_reach import VoxelsInReach
from .context.late_voxels import drop_proved_voxels
from .context.level_of_detail import SettledPoses, ask_after_deadline, level_budget
from .context.query_budget import EXACT, CostCounter, QueryBudget
from .context.query_context import (
    LevelOfDetail,
    SceneData,
    as_held,
    find_proved_reach,
    in_unknown,
    kernel_poses,
    pieces,
    to_units,
    with_voxels,
)
from .context.unloaded_voxels import drop_clear_voxels


def collide(
    data: SceneData, avatar: AvatarModel, poses: ArrayLike, margin: float = 0.0, budget: QueryBudget = EXACT
) -> CollideAnswers:
    """Test whether the avatar touches the scene under each pose.

    poses: (k, 4, 4) float64, avatar to world, rigid or with a uniform scale, bits used as given.
    margin: distance at or below which two spheres are in contact [m].
    budget: with a tolerance, CONTACT means a pair within margin plus tolerance, and CLEAR none
    within the margin; the answer has bounds.
    The verdict is CONTACT, CLEAR or UNKNOWN. UNKNOWN means that a voxel in reach cannot be read, a
    scan was left out there or the deadline passed, and that no contact was found elsewhere.
    NUMERICS.md N5 has the definition. Raise BadRequestError, BadTransformError, TooLargeError.
    """
    begin = time.perf_counter()
    array = kernel_poses(poses)
    margin_units = to_units(margin, "margin")
    spent = CostCounter(begin, data.residency, data.broad.keys)
    found = np.zeros(len(array), np.uint8)  # verdicts of the poses that the level settles

    def ask(level: LevelOfDetail, which: NDArray[np.int64]) -> NDArray[np.bool_]:
        found[which] = _level_verdicts(level, avatar, array[which], margin_units, budget, spent)
        return np.asarray(found[which] != UNKNOWN)

    by_level, coarse = SettledPoses(data, array, budget, ask), drop_clear_voxels(data, avatar, array)
    if budget.late is not None:
        coarse = drop_proved_voxels(data, avatar, array, margin_units, budget)
    verdict, counts, reach = _verdicts(
        data, avatar, array, margin_units, budget, spent, lambda reach: by_level.drop(coarse(reach))
    )
    verdict[by_level.settled] = found[by_level.settled]
    which = np.flatnonzero(verdict == UNKNOWN)
    if len(which):

        def ask_late(level: LevelOfDetail, own: QueryBudget) -> NDArray[np.uint8]:
            return _level_verdicts(level, avatar, array[which], margin_units, own, spent)

        late = ask_after_deadline(data, budget, ask_late)
        verdict[which] = UNKNOWN if late is None else late
    # A load may have proved the index wrong by now.
    if (data.nothing_clear or len(data.unknown)) and len(avatar.points):
        lost = in_unknown(reach.boxes, data.unknown, data.nothing_clear)
        verdict[lost & (verdict == CLEAR)] = UNKNOWN
    bounds = verdict_bounds(verdict, reach.units - margin_units, margin, margin_units, budget)
    return CollideAnswers(verdict, reach.outside, counts[0], counts[1], counts[2], **spent.fields(), **bounds)


def _verdicts(
    data: SceneData,
    avatar: AvatarModel,
    poses: NDArray[np.float64],
    margin_units: int,
    budget: QueryBudget,
    spent: CostCounter,
    settled: Callable[[VoxelsInReach], VoxelsInReach] = lambda reach: reach,
) -> tuple[NDArray[np.uint8], NDArray[np.uint32], VoxelsInReach]:
    """Return verdicts (k,), counts (3, k) and reach of poses (k, 4, 4).

    Regions that were left out are not considered. settled: see `find_proved_reach`.
    """
    k, other_units = len(poses), data.radius_units + margin_units
    reach = find_proved_reach(data, avatar, poses, other_units, budget, spent, settled)
    verdict, counts = np.zeros(k, np.uint8), np.zeros((3, k), np.uint32)
    # An avatar without points is clear, even if the index is wrong or a scan was left out.
    if not len(avatar.points):
        return verdict, counts, reach
    residency, early = data.residency, budget.tolerance_units
    for which, rows, part in pieces(reach, residency, budget.share, budget.stop):
        if budget.stop:
            left = with_voxels(part, which)
            verdict[left[verdict[left] == CLEAR]] = UNKNOWN
            continue
        with residency.hold(rows, budget.loads_until(), scan=budget.scan, stop=budget.stop) as held:
            seen = as_held(data, held, budget)
            collide_poses(poses, avatar.arrays, seen.arrays, part, which, early, verdict, counts)
        spent.add(held)
    return verdict, counts, reach


def _level_verdicts(
    level: LevelOfDetail,
    avatar: AvatarModel,
    poses: NDArray[np.float64],
    margin_units: int,
    budget: QueryBudget,
    spent: CostCounter,
) -> NDArray[np.uint8]:
    """Return the verdicts (k,) that follow from the level alone; UNKNOWN where none does.

    CLEAR and CONTACT are those of the scene, EARLY is a pair within margin plus tolerance.
    """
    verdict = np.full(len(poses), UNKNOWN, np.uint8)
    clear = clear_by_level(level, avatar, poses, margin_units, budget, spent)
    verdict[clear] = CLEAR
    left = np.flatnonzero(~clear)
    if len(left):
        exact, own = level_budget(budget), spent.of_level(level.covers.residency)
        within = margin_units + budget.tolerance_units
        touched, _, _ = _verdicts(level.points, avatar, poses[left], within, exact, own)
        verdict[left[touched == CONTACT]] = EARLY if budget.tolerance_units else CONTACT
        spent.add_level(own)
    return verdict


def clear_by_level(
    level: LevelOfDetail,
    avatar: AvatarModel,
    poses: NDArray[np.float64],
    margin_units: int,
    budget: QueryBudget,
    spent: CostCounter,
) -> NDArray[np.bool_]:
    """Return which poses (k,) the level proves clear of the scene."""
    own = spent.of_level(level.covers.residency)
    covered, _, reach = _verdicts(level.covers, avatar, poses, margin_units, level_budget(budget), own)
    spent.add_level(own)
    lost = in_unknown(reach.boxes, level.covers.unknown, level.covers.nothing_clear)
    return np.asarray((covered == CLEAR) & ~lost)


def verdict_bounds(
    verdict: NDArray[np.uint8],
    radii: NDArray[np.int64],
    margin: float,
    margin_units: int,
    budget: QueryBudget,
) -> dict[str, Any]:
    """Return the bounds of `CollideAnswers` that follow from verdicts; {} without a tolerance.

    verdict: (k,), in which EARLY becomes CONTACT.
    radii: (k,) sum of the largest radii of avatar and scan, exact units: the depth limit of a pair.
    margin: [m].  margin_units: the margin as rounded, up or down; verdicts are based on it.
    """
    if budget.tolerance == 0:
        return {}
    rounded, k = margin_units / UNITS_PER_METRE, len(verdict)
    low, high = min(float(margin), rounded), max(float(margin), rounded)
    early = float(np.nextafter(high + budget.tolerance, math.inf))
    lower, upper, exact = np.empty(k), np.empty(k), np.empty(k, bool)
    write_verdict_bounds(verdict, radii, low, high, early, lower, upper, exact)
    return {"lower": lower, "upper": upper, "exact": exact}
