"""Front-to-back search of `raycast` and `within`, in rounds that load only the voxels needed.

A round holds the next voxel of every unfinished ray or point and all later voxels that are already
resident, and makes one kernel call for all of them. A request whose voxels are resident therefore
takes one round, and a hit in the first voxel loads no second one. The voxels held at a time fit in
the cache's budget.
"""

import math
from functools import partial

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ....schemas.archive.units import UNITS_PER_METRE
from ....schemas.archive.voxel_grid import MAX_COORDINATE
from ....schemas.errors import BadRequestError
from ....schemas.wire.requests import make_vectors
from ...kernels.core.voxel_tree import VoxelLists, VoxelTree, list_voxels
from ...kernels.rays.points import search_points
from ...kernels.rays.rays import ClosestHits, RayBatch, follow_rays
from ...residency.index_proof import ENTRIES_AT_ONCE
from ...runtime.stop_flag import StopFlag
from .query_budget import CostCounter, QueryBudget
from .query_context import SceneData, prove

# Rays or points whose lists are in memory at a time.
BATCH = 1 << 14
# The same with a deadline, which is checked between batches and rounds: some 10 ms of work.
TIMED_BATCH = 1 << 11


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


def _part(best: ClosestHits, rows: slice) -> ClosestHits:
    """Return views of some rows, and a contiguous copy of their counts, to be written back."""
    value, square, lattice, unseen, counts = best
    return ClosestHits(value[rows], square[rows], lattice[rows], unseen[rows], counts[:, rows].copy())


def search_front_to_back(
    data: SceneData,
    at_units: NDArray[np.int64],
    direction: NDArray[np.float64] | None,
    reach_units: int,
    budget: QueryBudget,
    spent: CostCounter,
) -> ClosestHits:
    """Answer k rays (direction (k, 3)) or query points (direction None) in rounds.

    `unseen` of the result bounds what a deadline left unfinished. Add the cost to `spent`.
    """
    k = len(at_units)
    best = ClosestHits(
        np.full(k, np.inf), np.full(k, -1, np.int64), np.zeros((k, 3), np.int64), np.full(k, np.inf),
        np.zeros((3, k), np.uint32),
    )  # fmt: skip
    tree, index_tree = data.bounds.trees()
    batch = BATCH if budget.deadline == math.inf else TIMED_BATCH
    for begin in range(0, k, batch):
        if budget.spent:
            best.unseen[begin:] = 0.0
            break
        rows = slice(begin, min(begin + batch, k))
        part = _part(best, rows)
        if direction is None:
            rays = RayBatch(at_units[rows], np.empty((0, 3)), reach_units, 0)
        else:
            rays = RayBatch(at_units[rows], direction[rows], reach_units, data.radius_units)
        looked: NDArray[np.bool_] = np.zeros(len(data.arrays.where), bool)
        search = partial(_search, data, rays, part, budget, spent, looked)
        unproved = data.bounds.unproved
        lists = _list(data, tree, rays, part)
        if not search(lists, unproved):
            # By the boxes of the index, unproved voxels may be out of reach: restart with those
            # boxes, and finally examine the voxels that they exclude.
            part.value[:], part.square[:], part.lattice[:], part.counts[:] = np.inf, -1, 0, 0
            doubts, lists = lists, _list(data, index_tree, rays, part)
            search(lists, 0)
            _settle_doubts(data, doubts, lists, part, reach_units, budget, spent)
        best.counts[:, rows] = part.counts
    if data.nothing_clear:  # a load may have proved the index wrong
        best.unseen[:] = 0.0
    return best


def _search(
    data: SceneData,
    rays: RayBatch,
    best: ClosestHits,
    budget: QueryBudget,
    spent: CostCounter,
    looked: NDArray[np.bool_],
    lists: VoxelLists,
    unproved: int,
) -> bool:
    """Search the voxels of `lists` in rounds; write to `best`.

    looked: (v,) bool, voxels held so far.
    unproved: of `ProvedBounds` before `lists` was made; 0: boxes are not doubted. Return False, with
    the search unfinished, when an unproved voxel comes next.
    """
    until = budget.deadline if budget.late is None else -math.inf
    kernel = follow_rays if len(rays.direction) else search_points
    cursor = lists.starts[:-1].copy()
    while (open_ := cursor < lists.starts[1:]).any():
        if budget.spent:
            best.unseen[open_] = np.minimum(best.unseen[open_], lists.near[cursor[open_]])
            break
        rows = _next_rows(data, lists, cursor, open_)
        if unproved and data.bounds.unsettled(rows, unproved).any():
            return False
        held = np.zeros(len(looked), bool)
        held[rows] = True
        with data.residency.hold(rows.tolist(), until, scan=budget.scan, stop=budget.stop) as found:
            held[list(found.late)] = False  # another thread may be writing them
            kernel(rays, lists, cursor, held, data.arrays, budget.visits, best)
        if budget.late is not None and found.late:
            _pass_late(lists, cursor, list(found.late), best)
        spent.add(found, int(looked[rows].sum()))
        looked |= held
    return True


def _list(data: SceneData, tree: VoxelTree, rays: RayBatch, best: ClosestHits) -> VoxelLists:
    """List the voxels that rays or points reach by a tree's boxes; share `unseen` with `best`."""
    k, along = len(rays.origin), len(rays.direction) > 0
    capacity = max(64, 8 * k)
    while True:
        lists = VoxelLists(
            np.zeros(k + 1, np.int64), np.empty(capacity, np.int64), np.empty(capacity), best.unseen
        )
        needed = list_voxels(
            tree, rays.origin, rays.direction, along, rays.reach, rays.radius, data.arrays.units_per_step,
            data.arrays.stop, lists,
        )  # fmt: skip
        if needed <= capacity:
            break
        capacity = needed
    if data.nothing_clear:
        best.unseen[:] = 0.0
    return lists


def _pass_late(lists: VoxelLists, cursor: NDArray[np.int64], late: list[int], part: ClosestHits) -> None:
    """Count late voxels that come next as missing, and go on behind them."""
    ahead = np.flatnonzero(cursor < lists.starts[1:])
    stuck = ahead[np.isin(lists.rows[cursor[ahead]], late)]
    part.unseen[stuck] = np.minimum(part.unseen[stuck], lists.near[cursor[stuck]])
    part.counts[0, stuck] += np.uint32(1)
    cursor[stuck] += 1


def _next_rows(
    data: SceneData, lists: VoxelLists, cursor: NDArray[np.int64], open_: NDArray[np.bool_]
) -> NDArray[np.int64]:
    """Return the voxels to hold in the next round.

    First come the next voxels of the unfinished rays, in descending order of the number of rays,
    then resident voxels that are needed later. At least one of the former fits, because the cache
    can hold every single voxel. Each round therefore makes progress.
    """
    v = len(data.arrays.where)
    wanted = np.bincount(lists.rows[cursor[open_]], minlength=v)
    order = np.flatnonzero(wanted)
    later = np.zeros(v, bool)
    later[lists.rows[: lists.starts[-1]]] = True
    later &= (data.arrays.where[:, 0] >= 0) & (wanted == 0)
    rows = np.concatenate([order, np.flatnonzero(later)])
    residency, capacity = data.residency, data.residency.buffer.total_bytes
    if residency.bytes_of(rows.tolist()) <= capacity:
        return rows
    rows = np.concatenate([order[np.argsort(-wanted[order], kind="stable")], np.flatnonzero(later)])
    chosen, taken = [], 0
    for row in rows.tolist():
        size = residency.bytes_of([row])
        if taken + size <= capacity:
            chosen.append(row)
            taken += size
    return np.array(chosen, np.int64)


def _found_units(best: ClosestHits) -> NDArray[np.float64]:
    """Return the distances found (k,) [exact units]; inf for none."""
    square = best.square
    return np.asarray(np.where(square >= 0, np.sqrt(np.maximum(square, 0).astype(np.float64)), best.value))


def verdict_and_bounds(
    best: ClosestHits, reach_units: int
) -> tuple[NDArray[np.uint8], NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]]:
    """Return verdict, lower, upper [m] and exact (k,) for the results of `search_front_to_back`.

    A hit remains a hit, whatever is missing. It is the first one, and `exact` is true, if
    everything missing is farther away.
    """
    found = _found_units(best)
    missing = np.where(best.unseen > reach_units, math.inf, best.unseen)
    hit = np.isfinite(found)
    exact = np.where(hit, found < missing, np.isinf(missing))
    lower = np.where(exact & ~hit, float(reach_units), np.minimum(found, missing)) / UNITS_PER_METRE
    verdict = np.where(hit, 1, np.where(exact, 0, 2)).astype(np.uint8)  # CONTACT, CLEAR, UNKNOWN
    return verdict, lower, found / UNITS_PER_METRE, exact


def _settle_doubts(
    data: SceneData,
    doubts: VoxelLists,
    lists: VoxelLists,
    part: ClosestHits,
    reach_units: int,
    budget: QueryBudget,
    spent: CostCounter,
) -> None:
    """Load the voxels that only the index excludes, unless something was found before their cells.

    doubts: voxels that rays or points reach by proved boxes and cells.  lists: those reached by the
    index, already examined. A voxel that cannot be read is counted as missing in `part`. If the
    budget's stop flag is set, everything in `part` is unknown.
    """
    proved, v = data.bounds.proved, len(data.bounds.proved)
    until = np.minimum(np.minimum(_found_units(part), part.unseen), reach_units)
    open_ = _open_doubts(doubts, until, proved, budget.stop)
    if budget.stop:
        part.unseen[:] = 0.0
        return
    if not len(open_):
        return
    rows, near = doubts.rows[open_], doubts.near[open_]
    first = np.full(v, math.inf)
    np.minimum.at(first, rows, near)
    wanted = np.flatnonzero(first < math.inf)
    prove(data, wanted[np.argsort(first[wanted], kind="stable")].tolist(), budget, spent)
    open_ = open_[~proved[rows]]
    if not len(open_):
        return
    rows, near = doubts.rows[open_], doubts.near[open_]
    ray = np.searchsorted(doubts.starts, open_, side="right") - 1
    np.minimum.at(part.unseen, ray, near)
    # Voxels in reach by the index were counted when they were examined.
    known = np.repeat(np.arange(len(until)), np.diff(lists.starts)) * v + lists.rows[: lists.starts[-1]]
    hidden = ~np.isin(ray * v + rows, known)
    np.add.at(part.counts[0], ray[hidden], np.uint32(1))


def _open_doubts(
    doubts: VoxelLists,
    until: NDArray[np.float64],
    proved: NDArray[np.bool_],
    stop: StopFlag,
) -> NDArray[np.int64]:
    """Return the entries of `doubts`, ascending, with an unproved voxel no farther than `until`.

    until: (k,) of each ray [exact units].  stop: once it is set, the result may be incomplete.
    """
    entries, found = int(doubts.starts[-1]), [np.empty(0, np.int64)]
    for begin in range(0, entries, ENTRIES_AT_ONCE):
        if stop:
            break
        end = min(begin + ENTRIES_AT_ONCE, entries)
        at = begin + np.flatnonzero(~proved[doubts.rows[begin:end]])
        ray = np.searchsorted(doubts.starts, at, side="right") - 1
        found.append(at[doubts.near[at] <= until[ray]])
    return np.concatenate(found)
