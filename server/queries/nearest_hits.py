"""Provide what `raycast` and `within` share: origins, the voxels in reach, and the answers."""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...schemas.archive.units import UNITS_PER_METRE
from ...schemas.archive.voxel_grid import MAX_COORDINATE
from ...schemas.errors import BadRequestError
from ...schemas.wire.answers import Verdict
from ...schemas.wire.requests import make_vectors
from ..kernels.core.reach import Items, VoxelLists, find_lists
from ..kernels.rays.hits import ClosestHits, HitBatch, search_hits
from .request import CostCounter, QueryBudget
from .resolve import Steps, drop_items, resolve
from .scene_data import SceneData, with_stop

# Rays or points whose lists are in memory at a time.
BATCH = 1 << 14


class Hits(NamedTuple):
    """Answers about k rays or points.

    verdict: (k,) uint8. A hit remains a hit, whatever is missing.  distance: (k,) of the hit [m]; inf
    for none.  lower: (k,) of what may be there [m].  exact: (k,) bool, whether everything missing
    is farther away.  cloud: (k, 3) the scan point hit, world [m]; NaN for none.
    counts: (3, k) uint32, voxels missing, node visits, point tests.
    """

    verdict: NDArray[np.uint8]
    distance: NDArray[np.float64]
    lower: NDArray[np.float64]
    exact: NDArray[np.bool_]
    cloud: NDArray[np.float64]
    counts: NDArray[np.uint32]


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


def leaves_scene(data: SceneData, *places: NDArray[Any]) -> NDArray[np.bool_]:
    """Return which of k items have a place (k, 3), exact units, outside of the box of all scan points."""
    low, high = np.rint(data.tree.scene * data.arrays.units_per_step).astype(places[0].dtype)
    outside = np.zeros(len(places[0]), bool)
    for place in places:
        for r in range(3):  # `any` along rows of three takes longer
            outside |= (place[:, r] < low[r]) | (place[:, r] > high[r])
    return outside


def find_hits(
    data: SceneData,
    items: HitBatch,
    budget: QueryBudget,
    spent: CostCounter,
    on_hits: Callable[[NDArray[np.int64], ClosestHits], None] = lambda which, best: None,
) -> Steps[Hits]:
    """Find the first hits of k rays or the points nearest to k points, a batch at a time.

    on_hits: called with the numbers (n,) of items that hit something, and their results.
    Add the cost to `spent`. Once the request is stopped, no further batch is begun, and nothing is
    known about its items.
    """
    k, arrays = len(items.origin), with_stop(data, budget.stop).arrays
    hits = Hits(
        np.full(k, Verdict.UNKNOWN, np.uint8), np.full(k, math.inf), np.zeros(k), np.zeros(k, bool),
        np.full((k, 3), math.nan), np.zeros((3, k), np.uint32),
    )  # fmt: skip
    for begin in range(0, k, BATCH):
        if begin and budget.stop:
            break
        rows = slice(begin, begin + BATCH)
        batch = items._replace(origin=items.origin[rows], direction=items.direction[rows])
        best = yield from _search_batch(data, batch, arrays, budget, spent)
        value, missing = best.value, np.where(best.unseen > items.reach, math.inf, best.unseen)
        hit = np.isfinite(value)
        exact = np.where(hit, value < missing, np.isinf(missing))
        hits.verdict[rows] = np.where(hit, Verdict.CONTACT, np.where(exact, Verdict.CLEAR, Verdict.UNKNOWN))
        hits.distance[rows], hits.exact[rows] = value / UNITS_PER_METRE, exact
        lower = np.where(exact & ~hit, float(items.reach), np.minimum(value, missing))
        hits.lower[rows], hits.counts[:, rows] = lower / UNITS_PER_METRE, best.counts
        which = np.flatnonzero(hit)
        found = best._replace(value=value[which], lattice=best.lattice[which])
        hits.cloud[begin + which] = found.lattice * data.arrays.step + data.arrays.origin
        on_hits(begin + which, found)
    if data.nothing_clear:  # a load may have proved the index wrong
        hits.verdict[hits.verdict == Verdict.CLEAR] = Verdict.UNKNOWN
        hits.lower[:], hits.exact[:] = 0.0, False
    return hits


def no_hits(k: int) -> ClosestHits:
    """Return the results of k rays or points before any is found."""
    return ClosestHits(
        np.full(k, math.inf), np.full(k, -1, np.int64), np.zeros((k, 3), np.int64), np.full(k, math.inf),
        np.zeros((3, k), np.uint32),
    )  # fmt: skip


def _search_batch(
    data: SceneData, batch: HitBatch, arrays: Any, budget: QueryBudget, spent: CostCounter
) -> Steps[ClosestHits]:
    """Return the results of a batch; `unseen` bounds what was not examined."""
    k, per_step, lists = len(batch.origin), data.arrays.units_per_step, _list(data, batch)
    best = no_hits(k)

    def search(lists: VoxelLists, *state: NDArray[Any]) -> None:
        search_hits(batch, lists, *state, arrays, best)

    def settle(lists: VoxelLists) -> Steps[VoxelLists]:
        """Drop the rays that hit something before their next voxel."""
        ahead = np.full(k, math.inf)
        open_ = np.flatnonzero(np.diff(lists.starts))
        ahead[open_] = lists.near[lists.starts[:-1][open_]] * per_step
        return drop_items(lists, ahead > best.value)
        yield  # it is a generator

    left = yield from resolve(data, lists, search, budget, spent, settle)
    np.minimum(best.unseen, np.minimum(lists.unseen, left) * per_step, out=best.unseen)
    return best


def _list(data: SceneData, batch: HitBatch) -> VoxelLists:
    """List the voxels that rays or points reach, by the boxes of the index.

    Boxes grow by the largest sphere, by one step, and by more than the rounding: 2^-46 of the
    largest number.
    """
    tree, per_step = data.tree, data.arrays.units_per_step
    begin, reach = batch.origin / per_step, batch.reach / per_step
    far = np.maximum(np.abs(begin).max(axis=1, initial=reach), np.abs(tree.scene).max(initial=0.0))
    slack = 1.0 + far * 2.0**-46
    if len(batch.direction):
        span = batch.radius / per_step + slack
        items = Items(begin, begin + batch.direction * (reach + slack)[:, None], span, span)
    else:
        items = Items(begin, begin, reach + 2.0 * slack, slack)
    return find_lists(tree, items, data.arrays.stop)
