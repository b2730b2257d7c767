"""Load the missing voxels of a query slice by slice, and search them, until a deadline or a cancel.

Every query gets its voxels in this way. It lists the voxels in reach of each of its items (poses,
points, rays, motions), nearest first (kernels/core/reach.py), and gives the search that examines
them. `resolve` first searches the voxels that are resident. What these leave open, the query may
settle in another way, for example by the level of detail (level_of_detail.py). The rest is loaded:
`load_and_search` repeats a slice until every item is finished. A slice holds the next voxel of each
item, and all later ones that are resident, as many as fit in SHARE of the cache, and calls the
search, which goes on where each item stopped. A hit in the first voxel therefore loads no second
one. A query whose items need their voxels together, because it cannot compare parts of an answer
exactly (sweep) or collects one item at a time (contacts), holds all voxels of as many whole items as
fit. One item whose voxels are all resident does without (`search_resident` in collide.py).

A query is a generator: between two slices it yields, holding nothing. Whoever runs it decides what
happens there; `run` goes on at once. `settle` runs through, although it may load voxels of the level
of detail.

A voxel that cannot be read, that comes too late, or that the budget does not wait for is MISSING: the
search bounds it by its box. Loads that came too late are owed (residency).
"""

from collections.abc import Callable, Generator, Iterator, Sequence
from functools import wraps
from typing import ParamSpec, TypeVar

import numpy as np
from msgspec import structs
from numpy.typing import NDArray

from ...schemas.wire.answers import Cost
from ...schemas.wire.question_rules import Question
from ..kernels.core.reach import HELD, MISSING, NOT_HELD, VoxelLists
from ..residency.voxel_cache import VoxelCache
from ..runtime.stop_flag import StoppedError
from .query_inputs import CostCounter, QueryBudget, SceneData

_A = TypeVar("_A", bound=Cost)
_R = TypeVar("_R")
_P = ParamSpec("_P")
# Share of the cache that a slice holds at once: the rest stays with the voxels kept for users.
SHARE = 0.5

# What a query is: it yields between two slices of its work, and returns its answers.
Slices = Generator[None, None, _R]
# search(lists, which, cursor, state): examine voxels of the items numbered in `which`, each from its
# entry `cursor` of the lists on, while `state` (v,) uint8 says HELD or MISSING. Move the cursors; an
# item is finished at the end of its list.
Search = Callable[[VoxelLists, NDArray[np.int64], NDArray[np.int64], NDArray[np.uint8]], None]
# settle(lists): settle what can be settled without the voxels of `lists`, which are absent; return
# what is left of the lists.
Settle = Callable[[VoxelLists], VoxelLists]


def run(slices: Slices[_R]) -> _R:
    """Run a query through and return its answers."""
    while True:
        try:
            next(slices)
        except StopIteration as ended:
            answers: _R = ended.value
            return answers


def answered(slices: Callable[_P, Slices[_R]]) -> Callable[_P, _R]:
    """Return the function that runs through the query whose slices this generator is."""

    @wraps(slices)
    def answer(*args: _P.args, **kwargs: _P.kwargs) -> _R:
        return run(slices(*args, **kwargs))

    answer.__name__ = slices.__name__.removesuffix("_slices")
    return answer


def ask_until_stopped(question: Question[_A], k: int, budget: QueryBudget, ask: Callable[[], _A]) -> _A:
    """Run a query of k items with `ask`. Add the reason to the answer if the request is stopped."""
    try:
        answers = ask()
    except StoppedError:
        return unknown_answers(question, k, budget)
    return structs.replace(answers, stopped=budget.stopped) if budget.stopped else answers


def unknown_answers(question: Question[_A], k: int, budget: QueryBudget) -> _A:
    """Return `Question.unknown` for the k items of a stopped request, with the reason."""
    answers = question.unknown(k, bounded=budget.tolerance > 0.0)
    return structs.replace(answers, stopped=budget.stopped)


def resolve(
    data: SceneData,
    lists: VoxelLists,
    search: Search,
    budget: QueryBudget,
    spent: CostCounter,
    settle: Settle | None = None,
    *,
    together: bool = False,
) -> Slices[NDArray[np.float64]]:
    """Search the voxels in reach of k items; add the cost to `spent`.

    settle: asked about the voxels that are absent, unless the request was stopped before; None: load
    them all.  together: the voxels of an item are searched in one call where they fit in the cache
    together, instead of those that are resident first.
    Return (k,) float64 [steps], the least `near` of the voxels that were not searched, because the
    budget was spent or the request was stopped; inf for items that are finished.
    """
    absent = data.arrays.where[lists.rows[: lists.starts[-1]], 0] < 0
    if settle is not None and absent.any() and together and not budget.stop:
        cold = settle(drop_entries(lists, ~absent))
        settled = np.diff(cold.starts) == 0
        lists = drop_entries(lists, absent & settled[items_of(lists)])
    if settle is None or not absent.any() or together:
        return (yield from load_and_search(data, lists, search, budget, spent, together=together))
    left = yield from load_and_search(data, drop_entries(lists, absent), search, budget, spent)
    lists = drop_entries(lists, ~absent)
    if not budget.stop:  # all that is resident has been searched
        lists = settle(lists)
    if not lists.starts[-1]:
        return left
    return np.minimum(left, (yield from load_and_search(data, lists, search, budget, spent)))


def load_and_search(
    data: SceneData,
    lists: VoxelLists,
    search: Search,
    budget: QueryBudget,
    spent: CostCounter,
    *,
    together: bool = False,
) -> Slices[NDArray[np.float64]]:
    """Load the voxels of lists, nearest first and as far as the search needs them; return as `resolve`."""
    residency, where = data.residency, data.arrays.where
    cursor, ends = lists.starts[:-1].copy(), lists.starts[1:]
    state: NDArray[np.uint8] = np.zeros(len(where), np.uint8)
    looked: NDArray[np.bool_] = np.zeros(len(where), bool)
    first = True
    while len(open_ := np.flatnonzero(cursor < ends)) and not budget.stop:
        if together:
            open_, rows = _whole_items(data, lists, cursor, open_)
        else:
            needed = (
                lists.rows[: lists.starts[-1]] if first else lists.rows[_entries(lists, cursor, open_)[0]]
            )
            rows = _next_rows(data, lists.rows[cursor[open_]], needed)
        with residency.hold(rows.tolist(), budget.loads_until(), scan=budget.scan, stop=budget.stop) as held:
            state[rows] = np.where(where[rows, 0] < 0, MISSING, HELD)
            state[list(held.late)] = MISSING  # another thread may be loading them
            search(lists, open_, cursor, state)
        spent.add(held, int(looked[rows].sum()))
        state[rows], looked[rows], first = NOT_HELD, True, False
        yield
    return next_near(lists, cursor)


def next_near(lists: VoxelLists, cursor: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return `near` of each item's entry at `cursor` (k,) [steps]; inf at the end of its list."""
    found = np.full(len(cursor), np.inf)
    open_ = np.flatnonzero(cursor < lists.starts[1:])
    found[open_] = lists.near[cursor[open_]]
    return found


def _next_rows(data: SceneData, ahead: NDArray[np.int64], needed: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the distinct voxels to hold in the next slice, at least one.

    First come those `ahead`, the next ones of the open items, in the order of the items, then
    resident ones of those that some item still needs. Those that do not fit in the cache together
    are left for another slice.
    """
    where = data.arrays.where
    later: NDArray[np.bool_] = np.zeros(len(where), bool)
    later[needed] = True
    later &= where[:, 0] >= 0
    rows = np.flatnonzero(later)
    if later[ahead].all() and len(_that_fit(data, rows)) == len(rows):
        return rows  # nothing is loaded: the order does not matter
    ahead = _distinct(ahead)
    later[ahead] = False
    return _that_fit(data, np.concatenate([ahead, np.flatnonzero(later)]))


def _whole_items(
    data: SceneData, lists: VoxelLists, cursor: NDArray[np.int64], open_: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the first open items whose voxels fit in SHARE of the cache, and these distinct voxels.

    A single item may take the whole cache. Where that does not suffice, its first voxels do.
    """
    entries, ends = _entries(lists, cursor, open_)
    listed = lists.rows[entries]
    rows = _that_fit(data, _distinct(listed))
    left_out = np.flatnonzero(~np.isin(listed, rows))
    whole = len(open_) if not len(left_out) else int(np.searchsorted(ends, left_out[0], side="right"))
    if whole:
        return open_[:whole], rows
    return open_[:1], _that_fit(data, _distinct(listed[: ends[0]]), 1.0)


def _entries(
    lists: VoxelLists, cursor: NDArray[np.int64], open_: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the entries that the open items have left, item after item, and where each item's end."""
    counts = lists.starts[open_ + 1] - cursor[open_]
    ends = np.cumsum(counts)
    return np.arange(ends[-1]) + np.repeat(cursor[open_] - ends + counts, counts), ends


def _distinct(rows: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the distinct values in the order of their first occurrence."""
    return rows[np.sort(np.unique(rows, return_index=True)[1])]


def _that_fit(data: SceneData, rows: NDArray[np.int64], share: float = SHARE) -> NDArray[np.int64]:
    """Return the first rows that fit together in a share of the cache, at least one."""
    residency = data.residency
    capacity = share * residency.buffer.total_bytes
    if residency.bytes_of(rows.tolist()) <= capacity:
        return rows
    return np.array(next(parts_that_fit(residency, rows.tolist(), capacity)))


def items_of(lists: VoxelLists) -> NDArray[np.int64]:
    """Return the number of the item of each entry (starts[-1],)."""
    return np.repeat(np.arange(len(lists.starts) - 1), np.diff(lists.starts))


def drop_entries(lists: VoxelLists, dropped: NDArray[np.bool_]) -> VoxelLists:
    """Return lists without some of their entries. dropped: (starts[-1],) bool."""
    if not dropped.any():
        return lists
    kept = ~dropped
    before, n = np.concatenate([[0], np.cumsum(kept)]), len(dropped)
    return lists._replace(starts=before[lists.starts], rows=lists.rows[:n][kept], near=lists.near[:n][kept])


def drop_items(lists: VoxelLists, dropped: NDArray[np.bool_]) -> VoxelLists:
    """Return lists in which some items have no entries. dropped: (k,) bool."""
    return drop_entries(lists, dropped[items_of(lists)])


def parts_that_fit(residency: VoxelCache, rows: Sequence[int], budget_bytes: float) -> Iterator[list[int]]:
    """Split rows, in order, into parts of at most `budget_bytes` or of one larger row."""
    part: list[int] = []
    taken = 0
    for row in rows:
        size = residency.bytes_of([row])
        if part and taken + size > budget_bytes:
            yield part
            part, taken = [], 0
        part.append(row)
        taken += size
    if part:
        yield part
