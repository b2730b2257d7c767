"""What `raycast` and `within` share: voxels looked at front to back, in rounds, so that no more is loaded than asked.

A round holds the next voxel of every ray or point that is not done, and of the voxels further on those that are in
memory already, and makes one kernel call for all of them. So a request whose voxels are resident takes one round, and a
hit in the first voxel loads no second one. What is held at a time stays within the cache's budget.
"""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ....schemas.archive.units import UNITS_PER_METRE
from ....schemas.archive.voxel_grid import MAX_COORDINATE
from ....schemas.errors import BadRequestError
from ....schemas.wire.requests import make_vectors
from ...kernels.core.voxel_tree import Lists, VoxelTree, list_voxels
from ...kernels.rays.rays import Nearest
from ...residency.index_proof import ENTRIES_AT_ONCE
from ...runtime.stop_flag import Stop
from .proved_reach import prove
from .query_budget import Effort
from .query_context import SceneData
from .query_cost import Spent

# Rays or points whose lists are in memory together.
BATCH = 1 << 14
# The same where there is a deadline, which is looked at between batches and rounds: some 10 ms of work.
TIMED_BATCH = 1 << 11


def make_origins(
    data: SceneData, values: ArrayLike, what: str
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """World positions (k, 3) [m], and the same in exact units from the dataset's origin, half to even."""
    array = make_vectors(values, what)
    if len(array) and np.abs(array).max() > MAX_COORDINATE:
        raise BadRequestError(f"{what} at {np.abs(array).max():g} m: expected within {MAX_COORDINATE:g} m")
    return array, np.rint((array - data.arrays.origin) * UNITS_PER_METRE).astype(np.int64)


def make_best(k: int) -> Nearest:
    """Nothing found yet."""
    return Nearest(
        np.full(k, np.inf),
        np.full(k, -1, np.int64),
        np.zeros((k, 3), np.int64),
        np.full(k, np.inf),
        np.zeros((3, k), np.uint32),
    )


def _part(best: Nearest, begin: int, end: int) -> Nearest:
    """Views of rows [begin, end); counts contiguous, to be written back."""
    rows = slice(begin, end)
    return Nearest(
        best.value[rows],
        best.square[rows],
        best.lattice[rows],
        best.unseen[rows],
        best.counts[:, rows].copy(),
    )


def _forget(best: Nearest) -> None:
    """Make it what `make_best` makes, but for what was not seen."""
    best.value[:], best.square[:], best.lattice[:], best.counts[:] = np.inf, -1, 0, 0


def look(
    data: SceneData,
    at_units: NDArray[np.int64],
    direction: NDArray[np.float64] | None,
    reach_units: int,
    radius_units: int,
    effort: Effort,
    kernel: Callable[..., Any],
    spent: Spent,
) -> Nearest:
    """Answer k rays (direction (k, 3)) or loose points (None) by rounds.

    radius_units: of the scan's largest sphere, 0 where radii do not count: what the index alone can tell of a voxel.
    kernel(begin, end, lists, cursor, held, best) looks as far as it may; see `kernels.rays.follow_rays`.
    What a deadline left undone is in `unseen` of what is returned. What it took is added to `spent`.
    """
    k = len(at_units)
    best = make_best(k)
    bounds = data.bounds
    tree, index_tree = bounds.trees()
    batch = BATCH if effort.deadline == math.inf else TIMED_BATCH
    for begin in range(0, k, batch):
        end = min(begin + batch, k)
        if effort.spent:
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
        while (open_ := cursor < lists.starts[1:]).any():
            if effort.spent:
                part.unseen[open_] = np.minimum(part.unseen[open_], lists.near[cursor[open_]])
                break
            rows = _next_rows(data, lists, cursor, open_)
            if doubts is None and unproved and bounds.unsettled(rows, unproved).any():
                # By the boxes of the index they may be out of the way: begin again with those, and look at the end
                # at what they hide.
                doubts = lists
                _forget(part)
                lists = _list(data, index_tree, *ways, reach_units, radius_units, part)
                if data.nothing_clear:
                    part.unseen[:] = 0.0
                cursor = lists.starts[:-1].copy()
                continue
            held = np.zeros(len(looked), bool)
            held[rows] = True
            with data.residency.hold(
                rows.tolist(), effort.deadline, scan=effort.scan, stop=effort.stop
            ) as found:
                held[list(found.late)] = False  # they may be written to just now
                kernel(begin, end, lists, cursor, held, part)
            spent.add(found, int(looked[rows].sum()))
            looked |= held
        if doubts is not None:
            _settle_doubts(data, doubts, lists, part, reach_units, effort, spent)
        best.counts[:, begin:end] = part.counts
    if data.nothing_clear:  # a load may have found the index wrong
        best.unseen[:] = 0.0
    return best


def _list(
    data: SceneData,
    tree: VoxelTree,
    at_units: NDArray[np.int64],
    direction: NDArray[np.float64] | None,
    reach_units: int,
    radius_units: int,
    part: Nearest,
) -> Lists:
    """List the voxels that k rays or points reach, by the boxes of a tree. The lists share `unseen` with `part`."""
    k = len(at_units)
    directions = np.empty((0, 3)) if direction is None else direction
    capacity = max(64, 8 * k)
    while True:
        lists = Lists(
            np.zeros(k + 1, np.int64), np.empty(capacity, np.int64), np.empty(capacity), part.unseen
        )
        needed = list_voxels(
            tree, at_units, directions, direction is not None, reach_units, radius_units, data.arrays.units_per_step,
            data.arrays.stop, lists,
        )  # fmt: skip
        if needed <= capacity:
            return lists
        capacity = needed


def _settle_doubts(
    data: SceneData,
    doubts: Lists,
    lists: Lists,
    part: Nearest,
    reach_units: int,
    effort: Effort,
    spent: Spent,
) -> None:
    """Load the voxels that the index places out of the way, where nothing was found before their cells.

    doubts: what rays or points reach by proved bounds and cells.  lists: by the index, and looked at. A voxel that
    cannot be read is missing: `part` says so. Where the effort's stop is set, nothing is known in `part`.
    """
    proved, v = data.bounds.proved, len(data.bounds.proved)
    found = np.where(part.square >= 0, np.sqrt(np.maximum(part.square, 0)), part.value)
    until = np.minimum(np.minimum(found, part.unseen), reach_units)
    open_ = _open_doubts(doubts, until, proved, effort.stop)
    if effort.stop:
        part.unseen[:] = 0.0
        return
    if not len(open_):
        return
    rows, near = doubts.rows[open_], doubts.near[open_]
    first = np.full(v, math.inf)
    np.minimum.at(first, rows, near)
    wanted = np.flatnonzero(first < math.inf)
    prove(data, wanted[np.argsort(first[wanted], kind="stable")].tolist(), effort, spent)
    open_ = open_[~proved[rows]]
    if not len(open_):
        return
    rows, near = doubts.rows[open_], doubts.near[open_]
    ray = np.searchsorted(doubts.starts, open_, side="right") - 1
    np.minimum.at(part.unseen, ray, near)
    # Those that the index has in reach were counted when they were looked at.
    known = np.repeat(np.arange(len(until)), np.diff(lists.starts)) * v + lists.rows[: lists.starts[-1]]
    hidden = ~np.isin(ray * v + rows, known)
    np.add.at(part.counts[0], ray[hidden], np.uint32(1))


def _open_doubts(
    doubts: Lists, until: NDArray[np.float64], proved: NDArray[np.bool_], stop: Stop
) -> NDArray[np.int64]:
    """Return the numbers, ascending, of the entries of `doubts` whose voxel is not proved and not beyond `until`.

    until: (k,) of each ray [exact units].  stop: once it is set, some may be left out.
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


def _next_rows(
    data: SceneData, lists: Lists, cursor: NDArray[np.int64], open_: NDArray[np.bool_]
) -> NDArray[np.int64]:
    """The voxels to hold in the next round: those wanted next, the most wanted first, then what is resident already.

    At least one is wanted next and fits, as the cache holds every voxel alone; so each round comes further.
    """
    v = len(data.arrays.where)
    wanted = np.bincount(lists.rows[cursor[open_]], minlength=v)
    order = np.flatnonzero(wanted)
    later = np.zeros(v, bool)
    later[lists.rows[: lists.starts[-1]]] = True
    later &= (data.arrays.where[:, 0] >= 0) & (wanted == 0)
    rows = np.concatenate([order, np.flatnonzero(later)])
    residency, budget = data.residency, data.residency.buffer.total_bytes
    if residency.bytes_of(rows.tolist()) <= budget:
        return rows
    rows = np.concatenate([order[np.argsort(-wanted[order], kind="stable")], np.flatnonzero(later)])
    chosen, taken = [], 0
    for row in rows.tolist():
        size = residency.bytes_of([row])
        if taken + size <= budget:
            chosen.append(row)
            taken += size
    return np.array(chosen, np.int64)


def finish(
    found: NDArray[np.float64], unseen: NDArray[np.float64], reach_units: int
) -> tuple[NDArray[np.uint8], NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]]:
    """verdict, lower, upper [m] and exact of distances found (k,) [exact units], inf: none.

    unseen: (k,) lower bounds of what was not looked at [exact units]. A hit found is a hit, whatever is missing; it is
    the first one, as `exact` says, when all that is missing lies farther.
    """
    missing = np.where(unseen > reach_units, math.inf, unseen)
    hit = np.isfinite(found)
    exact = np.where(hit, found < missing, np.isinf(missing))
    lower = np.where(exact & ~hit, float(reach_units), np.minimum(found, missing)) / UNITS_PER_METRE
    verdict = np.where(hit, 1, np.where(exact, 0, 2)).astype(np.uint8)  # CONTACT, CLEAR, UNKNOWN
    return verdict, lower, found / UNITS_PER_METRE, exact
