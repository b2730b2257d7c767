"""Front-to-back search of `raycast` and `within`, in rounds that load only the voxels needed.

A round holds the next voxel of every unfinished ray or point and all later voxels that are already
resident, and makes one kernel call for all of them. A request whose voxels are resident therefore
takes one round, and a hit in the first voxel loads no second one. The voxels held at a time fit in
the cache's budget.
"""

import math
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ....schemas.archive.units import UNITS_PER_METRE
from ....schemas.archive.voxel_grid import MAX_COORDINATE
from ....schemas.errors import BadRequestError
from ....schemas.wire.requests import make_vectors
from ...kernels.core.voxel_tree import VoxelLists, VoxelTree, list_voxels
from ...kernels.rays.rays import ClosestHits
from ...residency.index_proof import ENTRIES_AT_ONCE
from ...runtime.stop_flag import StopFlag
from .level_hits import HitsByLevel, found_units
from .query_budget import CostCounter, QueryBudget
from .query_context import SceneData, prove

# Rays or points whose lists are in memory at a time.
BATCH = 1 << 14


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


def make_best(k: int) -> ClosestHits:
    """Return the results of k searches that have found nothing."""
    return ClosestHits(
        np.full(k, np.inf),
        np.full(k, -1, np.int64),
        np.zeros((k, 3), np.int64),
        np.full(k, np.inf),
        np.zeros((3, k), np.uint32),
    )


def _part(best: ClosestHits, begin: int, end: int) -> ClosestHits:
    """Return views of rows [begin, end), and a contiguous copy of counts to be written back."""
    rows = slice(begin, end)
    return ClosestHits(
        best.value[rows],
        best.square[rows],
        best.lattice[rows],
        best.unseen[rows],
        best.counts[:, rows].copy(),
    )


def _forget(best: ClosestHits) -> None:
    """Reset results to those of `make_best`, except `unseen`."""
    best.value[:], best.square[:], best.lattice[:], best.counts[:] = np.inf, -1, 0, 0


def search_front_to_back(
    data: SceneData,
    at_units: NDArray[np.int64],
    direction: NDArray[np.float64] | None,
    reach_units: int,
    radius_units: int,
    budget: QueryBudget,
    kernel: Callable[..., Any],
    spent: CostCounter,
    level: HitsByLevel | None = None,
) -> ClosestHits:
    """Answer k rays (direction (k, 3)) or query points (direction None) in rounds.

    radius_units: of the scan's largest sphere; 0 if radii do not count. The index gives no other
    radius of a voxel.
    kernel(begin, end, lists, cursor, held, best) searches as far as the held voxels allow; see
    `kernels.rays.follow_rays`.
    level: asked about rays whose next voxel is not resident, and about those that a deadline left.
    `unseen` of the result bounds what a deadline left unfinished. Add the cost to `spent`.
    """
    k = len(at_units)
    best = make_best(k)
    bounds = data.bounds
    tree, index_tree = bounds.trees()
    until = budget.deadline if budget.late is None else -math.inf
    for begin in range(0, k, BATCH):
        end = min(begin + BATCH, k)
        if budget.stop:
            best.unseen[begin:] = 0.0
            break
        part = _part(best, begin, end)
        ways = at_units[begin:end], None if direction is None else direction[begin:end]
        unproved = bounds.unproved
        lists = _list(data, tree, *ways, reach_units, radius_units, part)
        doubts = None
        if data.nothing_clear:
            part.unseen[:] = 0.0
        cursor = lists.starts[:-1].copy()
        looked: NDArray[np.bool_] = np.zeros(len(data.arrays.where), bool)
        settled: NDArray[np.bool_] = np.zeros(end - begin, bool)
        clear_until = np.zeros(end - begin)
        while (open_ := cursor < lists.starts[1:]).any():
            if budget.stop:
                part.unseen[open_] = np.minimum(part.unseen[open_], lists.near[cursor[open_]])
                break
            rows = _next_rows(data, lists, cursor, open_)
            if doubts is None and unproved and bounds.unsettled(rows, unproved).any():
                # By the boxes of the index, unproved voxels may be out of reach: restart with those
                # boxes, and finally examine the voxels that they exclude.
                doubts = lists
                _forget(part)
                settled[:], clear_until[:] = False, 0.0
                if level is not None:
                    level.forget(begin, end)
                lists = _list(data, index_tree, *ways, reach_units, radius_units, part)
                if data.nothing_clear:
                    part.unseen[:] = 0.0
                cursor = lists.starts[:-1].copy()
                continue
            if level is not None and level.before_loads and (data.arrays.where[rows, 0] < 0).any():
                ahead = np.flatnonzero(open_)
                cold = ahead[data.arrays.where[lists.rows[cursor[ahead]], 0] < 0]
                done = level.settle(begin, cold, part)
                settled[done] = True
                cursor[done] = lists.starts[done + 1]
                clear_until[:] = level.clear_until[begin:end]
                if len(done) + _pass_clear(data, lists, cursor, cold, clear_until, *ways, radius_units):
                    continue
            held = np.zeros(len(looked), bool)
            held[rows] = True
            with data.residency.hold(rows.tolist(), until, scan=budget.scan, stop=budget.stop) as found:
                held[list(found.late)] = False  # another thread may be writing them
                kernel(begin, end, lists, cursor, held, part)
            if budget.late is not None and found.late:
                _pass_late(lists, cursor, list(found.late), part)
            spent.add(found, int(looked[rows].sum()))
            looked |= held
        if doubts is not None:
            clear_until[settled] = np.inf
            beyond = partial(_leaves_after, data, *ways, radius_units, clear_until)
            _settle_doubts(data, doubts, lists, part, beyond, reach_units, budget, spent)
        best.counts[:, begin:end] = part.counts
    if level is not None and not budget.stop:
        level.bound_late(best)
    if data.nothing_clear:  # a load may have proved the index wrong
        best.unseen[:] = 0.0
    return best


def _list(
    data: SceneData,
    tree: VoxelTree,
    at_units: NDArray[np.int64],
    direction: NDArray[np.float64] | None,
    reach_units: int,
    radius_units: int,
    part: ClosestHits,
) -> VoxelLists:
    """List the voxels that k rays or points reach by a tree's boxes; share `unseen` with `part`."""
    k = len(at_units)
    directions = np.empty((0, 3)) if direction is None else direction
    capacity = max(64, 8 * k)
    while True:
        lists = VoxelLists(
            np.zeros(k + 1, np.int64), np.empty(capacity, np.int64), np.empty(capacity), part.unseen
        )
        needed = list_voxels(
            tree, at_units, directions, direction is not None, reach_units, radius_units, data.arrays.units_per_step,
            data.arrays.stop, lists,
        )  # fmt: skip
        if needed <= capacity:
            return lists
        capacity = needed


def _pass_late(lists: VoxelLists, cursor: NDArray[np.int64], late: list[int], part: ClosestHits) -> None:
    """Count late voxels that come next as missing, and go on behind them."""
    ahead = np.flatnonzero(cursor < lists.starts[1:])
    stuck = ahead[np.isin(lists.rows[cursor[ahead]], late)]
    part.unseen[stuck] = np.minimum(part.unseen[stuck], lists.near[cursor[stuck]])
    part.counts[0, stuck] += np.uint32(1)
    cursor[stuck] += 1


def _settle_doubts(
    data: SceneData,
    doubts: VoxelLists,
    lists: VoxelLists,
    part: ClosestHits,
    beyond: Callable[[NDArray[np.int64], NDArray[np.int64]], NDArray[np.bool_]],
    reach_units: int,
    budget: QueryBudget,
    spent: CostCounter,
) -> None:
    """Load the voxels that only the index excludes, unless something was found before their cells.

    doubts: voxels that rays or points reach by proved boxes and cells.  lists: those reached by the
    index, already examined.  beyond: function of rays and rows, `_leaves_after`. A voxel that cannot
    be read is counted as missing in `part`. If the budget's stop flag is set, everything in `part` is
    unknown.
    """
    proved, v = data.bounds.proved, len(data.bounds.proved)
    until = np.minimum(np.minimum(found_units(part), part.unseen), reach_units)
    open_ = _open_doubts(doubts, until, proved, beyond, budget.stop)
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
    beyond: Callable[[NDArray[np.int64], NDArray[np.int64]], NDArray[np.bool_]],
    stop: StopFlag,
) -> NDArray[np.int64]:
    """Return the entries of `doubts`, ascending, with an unproved voxel no farther than `until`.

    until: (k,) of each ray [exact units].  beyond: `_leaves_after`, of rays and rows.  stop: once it
    is set, the result may be incomplete.
    """
    entries, found = int(doubts.starts[-1]), [np.empty(0, np.int64)]
    for begin in range(0, entries, ENTRIES_AT_ONCE):
        if stop:
            break
        end = min(begin + ENTRIES_AT_ONCE, entries)
        at = begin + np.flatnonzero(~proved[doubts.rows[begin:end]])
        ray = np.searchsorted(doubts.starts, at, side="right") - 1
        near = doubts.near[at] <= until[ray]
        at, ray = at[near], ray[near]
        found.append(at[beyond(ray, doubts.rows[at])])
    return np.concatenate(found)


def _leaves_after(
    data: SceneData,
    at_units: NDArray[np.int64],
    direction: NDArray[np.float64] | None,
    radius_units: int,
    clear_until: NDArray[np.float64],
    ray: NDArray[np.int64],
    rows: NDArray[np.int64],
) -> NDArray[np.bool_]:
    """Return whether rays leave the cells of voxels, grown by the largest sphere, where they may be hit.

    clear_until: (k,) of each ray, nothing is hit before [exact units]; inf: anywhere.
    ray, rows: (n,), pairs of ray and voxel. Nothing of a cell is farther from a point than this
    either, but cells around a point are rare: a cell counts unless it is clear everywhere.
    """
    clear = clear_until[ray]
    after = clear < np.inf
    if direction is None:
        return after
    arrays = data.arrays
    which = np.flatnonzero(after & (clear > 0.0))
    at = at_units[ray[which]] / arrays.units_per_step
    along = direction[ray[which]]
    low = (arrays.coordinates[rows[which]] * arrays.voxel_steps).astype(np.float64)
    grow = (
        radius_units / arrays.units_per_step + 2.0 + np.abs(at).max(axis=1, initial=0.0)[:, None] * 2.0**-40
    )
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        ends = np.maximum((low - grow - at) / along, (low + arrays.voxel_steps + grow - at) / along)
    last = np.where(along == 0.0, np.inf, ends).min(axis=1) * (1.0 + 1e-9)
    after[which] = last * arrays.units_per_step >= clear[which]
    return after


def _pass_clear(
    data: SceneData,
    lists: VoxelLists,
    cursor: NDArray[np.int64],
    cold: NDArray[np.int64],
    clear_until: NDArray[np.float64],
    at_units: NDArray[np.int64],
    direction: NDArray[np.float64] | None,
    radius_units: int,
) -> int:
    """Move cursors of the rays `cold` past voxels that they leave before anything can be hit.

    These voxels become the first of the remaining ones in `lists`. Return their number.
    """
    if direction is None:
        return 0
    left = lists.starts[cold + 1] - cursor[cold]
    ray = np.repeat(cold, left)
    at = np.repeat(cursor[cold] - np.cumsum(left) + left, left) + np.arange(len(ray))
    kept = _leaves_after(data, at_units, direction, radius_units, clear_until, ray, lists.rows[at])
    order = at[np.lexsort((at, kept, ray))]
    lists.rows[at], lists.near[at] = lists.rows[order], lists.near[order]
    np.add.at(cursor, ray[~kept], 1)
    return int((~kept).sum())


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
