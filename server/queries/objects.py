"""Query `objects`: contacts of several avatars with the scene and with one another.

Nothing is stored between requests: a door or a vehicle is an object of the request, with its
current pose.
"""

from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...schemas.archive.units import UNITS_PER_METRE
from ...schemas.errors import BadRequestError
from ...schemas.wire.answers import ObjectsAnswers
from ...schemas.wire.question_table import COLLIDE
from ..avatars.avatar_model import AvatarModel
from ..kernels.bodies.body_pairs import CLEAR, UNKNOWN, bound_objects, sweep_and_prune, touch_pairs
from ..kernels.core.placed_avatar import MAX_REACH_UNITS
from ..runtime.stop_flag import NO_STOP
from .collide import collide_fast
from .load_and_search import ask_until_stopped
from .query_inputs import (
    EXACT,
    CostCounter,
    QueryBudget,
    SceneData,
    check_avatar,
    kernel_poses,
    to_units,
    with_stop,
)

# Group of the scene: an object whose mask lacks this bit is not tested against the scene.
SCENE_GROUP = 1 << 31


class CheckedObjects(NamedTuple):
    """Checked objects of a request, n of them.

    models: the distinct avatars.  model_of: (n,) int64, index into `models`.  poses: (n, 4, 4).
    groups, masks: (n,) uint32.  units: (n,) int64, radii, exact units.
    margin_units: of each pair.
    """

    models: list[AvatarModel]
    model_of: NDArray[np.int64]
    poses: NDArray[np.float64]
    groups: NDArray[np.uint32]
    masks: NDArray[np.uint32]
    units: NDArray[np.int64]
    margin_units: int


def objects(
    data: SceneData,
    avatars: Sequence[AvatarModel],
    poses: ArrayLike,
    groups: ArrayLike,
    masks: ArrayLike,
    margin: float = 0.0,
    budget: QueryBudget = EXACT,
) -> ObjectsAnswers:
    """Test which of n objects touch the scene, and which touch one another.

    avatars: n, repetitions allowed.  poses: (n, 4, 4) float64, avatar to world.
    groups, masks: (n,) uint32 bit fields. A pair is tested if the group of each object has a bit in
    common with the other's mask. The scene's group is SCENE_GROUP, and its mask has all bits.
    margin: of each pair, and of each object with the scene [m].
    NUMERICS.md N5 defines contact, also between two objects: kernels/bodies/body_pairs.py. A radius
    model applies to the scan's spheres and not to objects. Pairs left untested by a deadline are
    listed as UNKNOWN.
    Raise BadRequestError, BadTransformError, TooLargeError.
    """
    spent = CostCounter(data)
    checked = _check(data, avatars, poses, groups, masks, margin)
    n = len(checked.poses)
    verdict, outside, counts = np.zeros(n, np.uint8), np.zeros(n, bool), np.zeros((3, n), np.uint32)
    for number, model in enumerate(checked.models):
        rows = np.flatnonzero((checked.model_of == number) & ((checked.masks & SCENE_GROUP) > 0))
        if not len(rows):
            continue
        ask = partial(collide_fast, data, model, checked.poses[rows], margin, budget)
        found = ask_until_stopped(COLLIDE, len(rows), budget, ask)
        verdict[rows], outside[rows] = found.verdict, found.outside
        counts[:, rows] = found.voxels_missing, found.node_visits, found.point_tests
        spent.add_cost(found)
    pairs = _touching_pairs(checked, data.arrays.origin, budget)
    missing, visits, tests = counts
    return ObjectsAnswers(verdict, outside, missing, visits, tests, **pairs, **spent.fields())


def _check(
    data: SceneData,
    avatars: Sequence[AvatarModel],
    poses: ArrayLike,
    groups: ArrayLike,
    masks: ArrayLike,
    margin: float,
) -> CheckedObjects:
    """Check the objects of a request: poses are valid, and squares of reaches fit in 63 bits.

    This takes milliseconds for the largest request, so it does not check the stop flag.
    """
    data = with_stop(data, NO_STOP)
    array = kernel_poses(poses)
    n = len(array)
    group, mask = np.asarray(groups, np.uint32), np.asarray(masks, np.uint32)
    if not len(avatars) == n == len(group) == len(mask):
        raise BadRequestError(
            f"{len(avatars)} avatars, {n} poses, {len(group)} groups, {len(mask)} masks: expected equal numbers"
        )
    distinct = {id(avatar): avatar for avatar in avatars}
    numbers = {key: number for number, key in enumerate(distinct)}
    model_of = np.array([numbers[id(avatar)] for avatar in avatars], np.int64)
    margin_units = to_units(margin, "margin")
    units = np.empty(n, np.int64)
    for number, model in enumerate(distinct.values()):
        rows = np.flatnonzero(model_of == number)
        units[rows] = check_avatar(data, model, array[rows], 0, rows)
    if n > 1:
        first, second = (int(row) for row in np.argsort(-units, kind="stable")[:2])
        together = int(units[first] + units[second]) + margin_units
        if together > MAX_REACH_UNITS:
            raise BadRequestError(
                f"objects {first} and {second} have radii and margin that add up to {together / UNITS_PER_METRE:g} m: "
                "expected at most 16 m: give a smaller margin or radius"
            )
    return CheckedObjects(list(distinct.values()), model_of, array, group, mask, units, margin_units)


def find_pairs(checked: CheckedObjects, origin: NDArray[np.float64]) -> tuple[NDArray[np.int64], int]:
    """Return the pairs (p, 2) of objects to test, ascending, and how many the masks exclude.

    Pairs have first < second, and their bounds overlap. Sweep and prune along the axis on which the
    objects' root spheres are spread farthest. This takes milliseconds for the largest request, so
    it does not check the stop flag.
    """
    full = [number for number, model in enumerate(checked.models) if len(model.points)]
    present = np.flatnonzero(np.isin(checked.model_of, full))
    low, high = np.zeros((len(checked.poses), 3)), np.zeros((len(checked.poses), 3))
    for number in full:
        rows = np.flatnonzero(checked.model_of == number)
        bound_objects(
            checked.models[number].arrays, checked.poses, rows, checked.units, origin,
            checked.margin_units, low, high,
        )  # fmt: skip
    if len(present) < 2:
        return np.empty((0, 2), np.int64), 0
    axis = int(np.argmax(np.ptp(low[present] + high[present], axis=0)))
    axes = [axis, (axis + 1) % 3, (axis + 2) % 3]
    low, high = np.ascontiguousarray(low[:, axes]), np.ascontiguousarray(high[:, axes])
    order = present[np.argsort(low[present, 0], kind="stable")]
    capacity = 8 * len(present)
    while True:
        pairs = np.empty((capacity, 2), np.int32)
        found, filtered = sweep_and_prune(
            order, low, high, checked.groups, checked.masks, NO_STOP.flag, pairs
        )
        if found <= capacity:
            break
        capacity = found
    # One sort key a pair: sorting by two keys takes ten times as long.
    n = len(checked.poses)
    numbers = np.sort(pairs[:found, 0].astype(np.int64) * n + pairs[:found, 1])
    return np.column_stack((numbers // n, numbers % n)), filtered


def _touching_pairs(
    checked: CheckedObjects, origin: NDArray[np.float64], budget: QueryBudget
) -> dict[str, Any]:
    """Test the pairs, those of the same two avatars in one kernel call; return the fields of the answers."""
    pairs, filtered = find_pairs(checked, origin)
    kinds = checked.model_of[pairs]
    # Contact is symmetric, so two avatars are tested in one order only.
    turned = kinds[:, 0] > kinds[:, 1]
    ordered = np.where(turned[:, None], pairs[:, ::-1], pairs)
    models = len(checked.models)
    # One sort key for each pair of avatars: sorting rows of two would hold the interpreter's lock,
    # for a second with 10^6 pairs.
    kind = kinds.min(axis=1) * models + kinds.max(axis=1)
    order = np.argsort(kind, kind="stable")
    firsts = np.flatnonzero(np.diff(kind[order], prepend=-1))
    verdict = np.full(len(pairs), UNKNOWN, np.uint8)
    counters = np.zeros(2, np.int64)
    tested = 0
    for first, last in zip(firsts.tolist(), [*firsts[1:].tolist(), len(order)], strict=False):
        if budget.stop:
            break
        rows = order[first:last]
        a, b = divmod(int(kind[rows[0]]), models)
        found = np.empty(len(rows), np.uint8)
        touch_pairs(
            checked.models[a].arrays, checked.models[b].arrays, checked.poses, checked.units, ordered[rows],
            checked.margin_units, origin, budget.stop.flag, found, counters,
        )  # fmt: skip
        verdict[rows] = found
        tested += len(rows)
    listed = verdict != CLEAR
    visits, tests = counters.tolist()
    return {
        "pairs": pairs[listed].astype(np.int32), "pair_verdict": verdict[listed], "pairs_tested": tested,
        "pairs_filtered": filtered, "pair_visits": visits, "pair_tests": tests,
    }  # fmt: skip
