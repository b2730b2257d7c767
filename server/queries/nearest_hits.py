"""Provide what `raycast` and `within` share: origins, the voxels in reach, and verdicts."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...schemas.archive.units import UNITS_PER_METRE
from ...schemas.archive.voxel_grid import MAX_COORDINATE
from ...schemas.errors import BadRequestError
from ...schemas.wire.requests import make_vectors
from ..kernels.core.reach import Items, VoxelLists, find_lists
from ..kernels.rays.rays import ClosestHits, RayBatch
from .request import CostCounter, QueryBudget
from .resolve import Steps, drop_items, resolve
from .scene_data import SceneData, with_stop

# Rays or points whose lists are in memory at a time.
BATCH = 1 << 14
_NONE = np.empty((0, 3))


def make_origins(
    data: SceneData, values: ArrayLike, what: str
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return world positions (k, 3) [m], and the same in exact units from the dataset's origin.

    Rounding is half to even. Raise BadRequestError for a position that is too far away.
    """
    array = make_vectors(values, what)
    if len(array) and np.abs(array).max() > MAX_COORDINATE:
        raise BadRequestError(f"{what} at {np.abs(array).max():g} m: expected within {MAX_COORDINATE:g} m")
    return array, np.rint((array - data.arrays.origin) * UNITS_PER_METRE).astype(np.int64)


def find_hits(
    data: SceneData,
    kernel: Callable[..., None],
    at_units: NDArray[np.int64],
    direction: NDArray[np.float64] | None,
    reach_units: int,
    radius_units: int,
    budget: QueryBudget,
    spent: CostCounter,
) -> Steps[ClosestHits]:
    """Find the first hits of k rays (direction (k, 3)) or the points nearest to k points (None).

    kernel: `follow_rays` or `search_points`.  radius_units: of the scan's largest sphere; 0 if radii do
    not count.
    `unseen` of the result bounds what was not examined. Add the cost to `spent`.
    """
    k, per_step = len(at_units), data.arrays.units_per_step
    best = ClosestHits(
        np.full(k, np.inf), np.full(k, -1, np.int64), np.zeros((k, 3), np.int64), np.full(k, np.inf),
        np.zeros((3, k), np.uint32),
    )  # fmt: skip
    arrays = with_stop(data, budget.stop).arrays
    for begin in range(0, k, BATCH):
        rows = slice(begin, min(begin + BATCH, k))
        part = ClosestHits(
            best.value[rows], best.square[rows], best.lattice[rows], best.unseen[rows], best.counts[:, rows].copy()
        )  # fmt: skip
        along = None if direction is None else direction[rows]
        lists = _list(data, at_units[rows], along, reach_units, radius_units)
        batch = RayBatch(at_units[rows], _NONE if along is None else along, reach_units, radius_units)

        def search(
            lists: VoxelLists, *state: NDArray[Any], batch: RayBatch = batch, part: ClosestHits = part
        ) -> None:
            kernel(batch, lists, *state, arrays, part)

        def settle(lists: VoxelLists, part: ClosestHits = part) -> Steps[VoxelLists]:
            """Drop the rays that hit something before their next voxel."""
            ahead = np.full(len(part.value), np.inf)
            open_ = np.flatnonzero(np.diff(lists.starts))
            ahead[open_] = lists.near[lists.starts[:-1][open_]] * per_step
            return drop_items(lists, ahead > found_units(part))
            yield  # it is a generator

        left = yield from resolve(data, lists, search, budget, spent, settle)
        np.minimum(best.unseen[rows], np.minimum(lists.unseen, left) * per_step, out=best.unseen[rows])
        best.counts[:, rows] = part.counts
    if data.nothing_clear:  # a load may have proved the index wrong
        best.unseen[:] = 0.0
    return best


def _list(
    data: SceneData,
    at_units: NDArray[np.int64],
    direction: NDArray[np.float64] | None,
    reach_units: int,
    radius_units: int,
) -> VoxelLists:
    """List the voxels that rays or points reach, by the boxes of the index.

    Boxes grow by the largest sphere, by one step, and by more than the rounding: 2^-46 of the
    largest number.
    """
    tree, per_step = data.tree, data.arrays.units_per_step
    begin, reach = at_units / per_step, reach_units / per_step
    far = np.maximum(np.abs(begin).max(axis=1, initial=reach), np.abs(tree.scene).max(initial=0.0))
    slack = 1.0 + far * 2.0**-46
    if direction is None:
        items = Items(begin, begin, reach + 2.0 * slack, slack)
    else:
        span = radius_units / per_step + slack
        items = Items(begin, begin + direction * (reach + slack)[:, None], span, span)
    return find_lists(tree, items, data.arrays.stop)


def found_units(best: ClosestHits) -> NDArray[np.float64]:
    """Return the distances found (k,) [exact units]; inf for none."""
    square = best.square
    return np.asarray(np.where(square >= 0, np.sqrt(np.maximum(square, 0).astype(np.float64)), best.value))


def verdict_and_bounds(
    found: NDArray[np.float64], unseen: NDArray[np.float64], reach_units: int
) -> tuple[NDArray[np.uint8], NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]]:
    """Return verdict, lower, upper [m] and exact for the distances found (k,) [exact units].

    found: inf for none.  unseen: (k,) lower bounds of the distance of what was not examined [exact
    units]. A hit remains a hit, whatever is missing. It is the first one, and `exact` is true, if
    everything missing is farther away.
    """
    missing = np.where(unseen > reach_units, math.inf, unseen)
    hit = np.isfinite(found)
    exact = np.where(hit, found < missing, np.isinf(missing))
    lower = np.where(exact & ~hit, float(reach_units), np.minimum(found, missing)) / UNITS_PER_METRE
    verdict = np.where(hit, 1, np.where(exact, 0, 2)).astype(np.uint8)  # CONTACT, CLEAR, UNKNOWN
    return verdict, lower, found / UNITS_PER_METRE, exact
