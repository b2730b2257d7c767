"""Query `collide`: whether an avatar touches the scene, one verdict a pose."""

import math
import time
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...schemas.archive.units import UNITS_PER_METRE
from ...schemas.wire.answers import CollideAnswers
from ..avatars.avatar_model import AvatarModel
from ..kernels.collide.collide_poses import collide_poses
from ..kernels.collide.early_contact import CLEAR, UNKNOWN, write_verdict_bounds
from .context.anytime_search import collide_bounded
from .context.query_budget import EXACT, NO_LIMIT, CostCounter, QueryBudget
from .context.query_context import (
    SceneData,
    as_held,
    find_proved_reach,
    in_unknown,
    kernel_poses,
    pieces,
    to_units,
)
from .context.unloaded_voxels import drop_clear_voxels


def collide(
    data: SceneData, avatar: AvatarModel, poses: ArrayLike, margin: float = 0.0, budget: QueryBudget = EXACT
) -> CollideAnswers:
    """Test whether the avatar touches the scene under each pose.

    poses: (k, 4, 4) float64, avatar to world, rigid or with a uniform scale, bits used as given.
    margin: distance at or below which two spheres are in contact [m].
    budget: a limited one is passed to `collide_bounded`. With a tolerance, CONTACT means a pair
    within margin plus tolerance, and CLEAR none within the margin; the answer has bounds.
    The verdict is CONTACT, CLEAR or UNKNOWN. UNKNOWN means that a voxel in reach cannot be read or
    a scan was left out there, and that no contact was found elsewhere. NUMERICS.md N5 has the
    definition. Raise BadRequestError, BadTransformError, TooLargeError.
    """
    if budget.limited:
        return collide_bounded(data, avatar, poses, margin, budget)
    begin = time.perf_counter()
    array = kernel_poses(poses)
    margin_units = to_units(margin, "margin")
    other_units, early = data.radius_units + margin_units, budget.tolerance_units
    k = len(array)
    residency, spent = data.residency, CostCounter(begin, data.residency, data.broad.keys)
    clear = drop_clear_voxels(data, avatar, array)
    reach = find_proved_reach(data, avatar, array, other_units, budget, spent, clear)
    verdict, counts = np.zeros(k, np.uint8), np.zeros((3, k), np.uint32)
    # An avatar without points is clear, even if the index is wrong or a scan was left out.
    for which, rows, part in (
        pieces(reach, residency, budget.share, budget.stop) if len(avatar.points) else ()
    ):
        if budget.stop:
            verdict[which[verdict[which] == CLEAR]] = UNKNOWN
            continue
        with residency.hold(rows, budget.loads_until(), scan=budget.scan, stop=budget.stop) as held:
            seen = as_held(data, held)
            collide_poses(array, avatar.arrays, seen.arrays, part, which, early, NO_LIMIT, verdict, counts)
        spent.add(held)
    # A load may have proved the index wrong by now.
    if (data.nothing_clear or len(data.unknown)) and len(avatar.points):
        lost = in_unknown(reach.boxes, data.unknown, data.nothing_clear)
        verdict[lost & (verdict == CLEAR)] = UNKNOWN
    bounds = verdict_bounds(verdict, reach.units - margin_units, margin, margin_units, budget)
    return CollideAnswers(verdict, reach.outside, counts[0], counts[1], counts[2], **spent.fields(), **bounds)


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
