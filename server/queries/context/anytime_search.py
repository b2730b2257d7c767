"""`collide` and `distance` with a budget, and optionally a tolerance.

Their bounds hold whenever the search stops. kernels/nearest/best_first_search.py has the search.
Without a deadline, one kernel call answers a request, and the same request gets the same answer.
With a deadline, the remaining time is divided among the remaining poses, and checked between slices
of the search.
"""

import math
import time
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ....schemas.archive.units import UNITS_PER_METRE
from ....schemas.wire.answers import CollideAnswers, Cost, DistanceAnswers, Verdict
from ...avatars.avatar_model import AvatarModel
from ...kernels.core.voxels_in_reach import VoxelsInReach
from ...kernels.nearest.best_first_search import (
    OPEN,
    SearchGoal,
    SearchResults,
    end_search,
    make_search,
    resume_search,
    search_poses,
)
from ...kernels.nearest.nearest_pair import NearestPairs
from ...runtime.stop_flag import StopFlag
from .query_budget import CostCounter, QueryBudget
from .query_context import SceneData, as_held, find_proved_reach, in_unknown, kernel_poses, pieces, to_units
from .signed_distance import distance_columns, signed_bound, signed_from_square, unknown_gaps
from .unloaded_voxels import bound_missing

# Capacity of the heap [pairs], beyond which the search is depth first: half a megabyte a request.
HEAP_PAIRS = 1 << 14
# Node visits between two checks of the clock: some 20 to 100 µs.
SLICE_VISITS = 2000
# Entries of voxels in reach of abandoned poses, processed at a time: some 10 MB.
LEFT_AT_A_TIME = 1 << 16
# Conversion to metres widens bounds by some exact units; a smaller tolerance has no effect.
TOLERANCE_SLACK = 8.0


class _Gathered(NamedTuple):
    """Results of a request: known, counts (3, k) uint32, and cost."""

    known: SearchResults
    counts: NDArray[np.uint32]
    cost: Cost


def _search_until(
    data: SceneData,
    avatar: AvatarModel,
    array: NDArray[np.float64],
    part: VoxelsInReach,
    which: NDArray[np.int64],
    heap: int,
    goal: SearchGoal,
    budget: QueryBudget,
    known: SearchResults,
    counts: NDArray[np.uint32],
) -> None:
    """Search for the poses `which`, each with its share of the remaining time.

    data: with the arrays of the current hold.
    """
    deadline = budget.deadline
    search = make_search(avatar.arrays, data.arrays, heap)
    for done, pose in enumerate(which.tolist()):
        now = time.perf_counter()
        if budget.spent:
            _leave_open(data, part, which[done:], budget.stop, known, counts)
            return
        share = now + (deadline - now) / (len(which) - done)
        fresh, until = True, SLICE_VISITS
        while True:
            status = resume_search(
                array, avatar.arrays, data.arrays, data.broad, part, pose, fresh, until, search, goal, known, counts
            )  # fmt: skip
            if status != OPEN:
                break
            if budget.stop or time.perf_counter() >= share:
                end_search(search, pose, known, counts)
                break
            fresh, until = False, until + SLICE_VISITS


def _leave_open(
    data: SceneData,
    part: VoxelsInReach,
    left: NDArray[np.int64],
    stop: StopFlag,
    known: SearchResults,
    counts: NDArray[np.uint32],
) -> None:
    """Abandon the poses `left` in one step and bound them by the index.

    With a kernel call for each pose, a request with a deadline of 5 ms took half a second. The
    bounds are distances between boxes, as in `unknown_gaps`; once the stop flag is set, they are 0.
    """
    if stop:
        known.lower[left] = 0.0
        return
    lengths = part.starts[left + 1] - part.starts[left]
    poses = np.repeat(left, lengths)
    behind = np.concatenate([[0], np.cumsum(lengths)])
    at = np.arange(behind[-1]) + np.repeat(part.starts[left] - behind[:-1], lengths)
    own = (part.units / data.arrays.units_per_step)[:, None]
    low, high = part.boxes[:, 0] + own, part.boxes[:, 1] - own
    for begin in range(0, len(at), LEFT_AT_A_TIME):
        if stop:
            known.lower[poses[begin:]] = 0.0
            return
        pose, voxel = poses[begin : begin + LEFT_AT_A_TIME], part.rows[at[begin : begin + LEFT_AT_A_TIME]]
        apart = np.maximum(data.broad.low[voxel] - high[pose], low[pose] - data.broad.high[voxel])
        np.maximum(apart, 0.0, out=apart)
        np.minimum.at(known.lower, pose, np.sqrt((apart * apart).sum(axis=1)) * (1.0 - 1e-9))
        np.add.at(counts[0], pose, (data.arrays.where[voxel, 0] < 0).astype(np.uint32))


def _gather(
    data: SceneData,
    avatar: AvatarModel,
    array: NDArray[np.float64],
    reach: VoxelsInReach,
    goal: SearchGoal,
    budget: QueryBudget,
    spent: CostCounter,
) -> _Gathered:
    """Search for all poses, piece by piece. Add the cost to `spent`."""
    k = len(array)
    known = SearchResults(
        np.full(k, -1, np.int64), np.zeros((k, 6), np.int64), np.zeros(k, np.int64), np.full(k, math.inf),
        np.full(k, math.inf), np.full(k, math.inf), np.zeros(k, bool),
    )  # fmt: skip
    counts = np.zeros((3, k), np.uint32)
    residency = data.residency
    for which, rows, part in (
        pieces(reach, residency, budget.share, budget.stop) if len(avatar.points) else ()
    ):
        if budget.stop:
            _leave_open(data, part, which, budget.stop, known, counts)
            continue
        heap = max(HEAP_PAIRS, int(np.diff(part.starts).max(initial=0)))
        with residency.hold(rows, budget.loads_until(), scan=budget.scan, stop=budget.stop) as held:
            seen = as_held(data, held)
            part = bound_missing(seen, held, avatar, array, part, which, known.missing_bound, counts)
            if budget.deadline < math.inf:
                _search_until(seen, avatar, array, part, which, heap, goal, budget, known, counts)
            else:
                search_poses(
                    array, avatar.arrays, seen.arrays, data.broad, part, which, heap, goal, known, counts
                )
        spent.add(held)
    return _Gathered(known, counts, Cost(**spent.fields()))


def _fields(cost: Cost) -> dict[str, Any]:
    return {name: getattr(cost, name) for name in Cost.__struct_fields__}


def _upper(data: SceneData, known: SearchResults, radii: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return upper bounds (k,) of the signed distances [m]; inf if no pair was bounded.

    radii: (k,) sum of the largest radii of avatar and scan, exact units.
    """
    found = signed_from_square(np.maximum(known.square, 0), radii - known.deficit)
    signed = np.where(known.square >= 0, found, np.inf)
    steps = known.upper * data.arrays.step * (1.0 + 1e-12)
    return np.minimum(signed, steps - radii / UNITS_PER_METRE + 2.0 / UNITS_PER_METRE)


def distance_bounded(
    data: SceneData, avatar: AvatarModel, poses: ArrayLike, reach: float, budget: QueryBudget
) -> DistanceAnswers:
    """Answer `distance` with a budget, and optionally a tolerance.

    The search ends when the bounds lie within the tolerance or the budget is spent; the bounds hold
    in either case. The tolerance ends it only after a pair was found. If the budget ends it first,
    there may be no pair, although `upper` may prove that one is in reach.
    """
    array = kernel_poses(poses)
    reach_units = to_units(reach, "reach")
    spent = CostCounter(time.perf_counter(), data.residency, data.broad.keys)
    around = find_proved_reach(data, avatar, array, data.radius_units + reach_units, budget, spent)
    tolerance = max(0.0, budget.between_bounds - TOLERANCE_SLACK / UNITS_PER_METRE) / data.arrays.step
    goal = SearchGoal(False, 0, np.zeros(len(array)), tolerance, budget.relative, budget.visits)
    known, counts, cost = _gather(data, avatar, array, around, goal, budget, spent)
    if len(avatar.points):
        np.minimum(known.missing_bound, unknown_gaps(data, around), out=known.missing_bound)
    # Unfinished searches bound the distance like missing voxels.
    np.minimum(known.missing_bound, known.lower, out=known.missing_bound)
    upper = _upper(data, known, around.units - reach_units)
    nearest = NearestPairs(known.square, known.pair, known.deficit, known.missing_bound)
    columns = distance_columns(data, around, float(reach), reach_units, nearest, counts, upper)
    return DistanceAnswers(**columns, **_fields(cost))


def collide_bounded(
    data: SceneData, avatar: AvatarModel, poses: ArrayLike, margin: float, budget: QueryBudget
) -> CollideAnswers:
    """Answer `collide` with a budget, and optionally a tolerance.

    The verdict is CONTACT if a pair is within the margin, or within margin plus tolerance (then not
    `exact`); CLEAR if provably none is; otherwise UNKNOWN, because the budget was spent or
    something in reach is missing.
    """
    array = kernel_poses(poses)
    margin_units = to_units(margin, "margin")
    spent = CostCounter(time.perf_counter(), data.residency, data.broad.keys)
    around = find_proved_reach(data, avatar, array, data.radius_units + margin_units, budget, spent)
    radii = around.units - margin_units
    early = budget.tolerance_units
    # Both sides of the comparison are float64 sums: some units of slack make it valid for the exact
    # values.
    certain = (around.units - TOLERANCE_SLACK) / data.arrays.units_per_step
    enough = np.asarray((around.units + early - TOLERANCE_SLACK) / data.arrays.units_per_step, np.float64)
    goal = SearchGoal(True, early, enough, 0.0, 0.0, budget.visits)
    known, counts, cost = _gather(data, avatar, array, around, goal, budget, spent)
    upper = _upper(data, known, radii)
    found = known.square >= 0
    truly = (found & (known.square <= (around.units - known.deficit) ** 2)) | (known.upper <= certain)
    contact = truly | found | (known.upper <= enough)
    lost = (counts[0] > 0) | (known.lower < math.inf)
    if len(avatar.points):
        lost |= in_unknown(around.boxes, data.unknown, data.nothing_clear)
        np.minimum(known.missing_bound, unknown_gaps(data, around), out=known.missing_bound)
    floor = signed_bound(np.minimum(known.missing_bound, known.lower), data, radii)
    lower = np.minimum(
        np.maximum(floor, -radii / UNITS_PER_METRE),
        np.minimum(upper, min(margin, margin_units / UNITS_PER_METRE)),
    )
    verdict = np.where(contact, Verdict.CONTACT, np.where(lost, Verdict.UNKNOWN, Verdict.CLEAR))
    return CollideAnswers(
        verdict.astype(np.uint8), around.outside, counts[0], counts[1], counts[2], lower, upper,
        truly | (verdict == Verdict.CLEAR), **_fields(cost),
    )  # fmt: skip
