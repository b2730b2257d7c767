"""The one way to the voxels: rounds that fit in the cache, what is absent, late, settled or stopped."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from fake_store import BLOCK, FakeStore
from numpy.typing import NDArray
from solidcloud.server.kernels.core.reach import HELD, MISSING, NOT_HELD, VoxelLists
from solidcloud.server.queries.load_and_search import (
    drop_entries,
    drop_items,
    load_and_search,
    resolve,
    run,
)
from solidcloud.server.queries.query_inputs import EXACT, CostCounter, LateVoxels, QueryBudget
from solidcloud.server.residency.voxel_cache import VoxelCache
from solidcloud.server.runtime.stop_flag import StopFlag


def lists_of(items: list[list[int]]) -> VoxelLists:
    """Lists of these rows, whose `near` is their number in the list of the item, and a half."""
    starts = np.cumsum([0, *map(len, items)])
    rows = np.array([row for own in items for row in own], np.int64)
    near = np.array([at + 0.5 for own in items for at in range(len(own))])
    return VoxelLists(starts, rows, near, np.full(len(items), np.inf))


def rows_of(lists: VoxelLists) -> list[list[int]]:
    """The rows of each item."""
    return [lists.rows[a:b].tolist() for a, b in zip(lists.starts[:-1], lists.starts[1:], strict=True)]


class Table:
    """A cache of voxels of some blocks, and a search that records what it examines.

    seen: for each item, rows and states in the order in which they were examined.  calls: for each call,
    the items and the rows held for it.  ends: item -> row at which it is finished.
    """

    def __init__(self, sizes: list[int], blocks: int) -> None:
        self.store = FakeStore(sizes)
        self.residency = VoxelCache(self.store, blocks * BLOCK)  # type: ignore[arg-type]
        self.data: Any = SimpleNamespace(
            residency=self.residency,
            arrays=SimpleNamespace(where=self.residency.where),
            keys=np.arange(len(sizes)).astype(np.uint64),
        )
        self.spent = CostCounter(self.data)
        self.seen: dict[int, list[tuple[int, int]]] = {}
        self.calls: list[tuple[list[int], list[int]]] = []
        self.ends: dict[int, int] = {}
        self.stop_at = 0  # the number of the examined voxel that is stopped before
        self.stop = StopFlag()

    def load(self, *rows: int) -> None:
        """Make voxels resident."""
        with self.residency.hold(rows):
            pass
        self.store.loads.clear()

    def search(
        self,
        lists: VoxelLists,
        which: NDArray[np.int64],
        cursor: NDArray[np.int64],
        state: NDArray[np.uint8],
    ) -> None:
        """Examine what is held, as a kernel does."""
        self.calls.append((which.tolist(), np.flatnonzero(state == HELD).tolist()))
        assert set(self.residency._pins) <= set(np.flatnonzero(state).tolist()), "of this slice alone"
        for item in which.tolist():
            while cursor[item] < lists.starts[item + 1]:
                row = int(lists.rows[cursor[item]])
                if state[row] == NOT_HELD:
                    break
                examined = self.seen.setdefault(item, [])
                if self.stop_at and sum(map(len, self.seen.values())) == self.stop_at:
                    self.stop.set("")
                    return
                if state[row] == HELD:
                    assert self.residency.where[row, 0] >= 0 and self.residency._pins[row]
                examined.append((row, int(state[row])))
                cursor[item] = lists.starts[item + 1] if self.ends.get(item) == row else cursor[item] + 1

    def rows_seen(self) -> list[list[int]]:
        """The rows that each item was examined in, all of them held."""
        assert all(state == HELD for own in self.seen.values() for _, state in own)
        return [[row for row, _ in self.seen[item]] for item in sorted(self.seen)]


@pytest.mark.parametrize("together", [False, True])
@pytest.mark.parametrize("blocks", [2, 3, 20])
def test_every_voxel_of_every_item_is_searched_once_in_its_order(blocks: int, together: bool) -> None:
    rng = np.random.default_rng(blocks)
    for _ in range(20):
        table = Table([1, 2, 1, 2, 1, 1, 2, 1], blocks)
        items = [rng.permutation(8)[: rng.integers(0, 8)].tolist() for _ in range(6)]
        table.load(0, 2)
        slices = load_and_search(
            table.data, lists_of(items), table.search, EXACT, table.spent, together=together
        )
        while True:
            try:
                next(slices)
            except StopIteration as ended:
                left = ended.value
                break
            assert not table.residency._pins, "nothing is held between two slices"
        assert not table.residency._pins, "nothing is held at the end"
        assert [table.seen.get(i, []) for i in range(6)] == [[(row, HELD) for row in own] for own in items]
        assert (left == np.inf).all()
        distinct = {row for own in items for row in own}
        if blocks == 20:
            assert (
                set(table.store.loads) == distinct - {0, 2}
                and max(table.store.loads.values(), default=1) == 1
            )
            assert table.spent.misses == len(distinct - {0, 2})
            assert table.spent.hits == len(distinct & {0, 2}), "once, however many rounds held them"
        table.residency.check()


def test_a_round_holds_the_next_voxel_of_each_item_and_what_is_resident() -> None:
    table = Table([1] * 6, 6)
    table.load(5)
    table.ends = {0: 0}
    run(load_and_search(table.data, lists_of([[0, 1, 5], [2, 5, 3]]), table.search, EXACT, table.spent))
    assert table.calls == [([0, 1], [0, 2, 5]), ([1], [3])], "what no item needs any more is not held"
    assert table.rows_seen() == [[0], [2, 5, 3]]
    assert sorted(table.store.loads) == [0, 2, 3], "what is finished in its first voxel loads no second"


def test_an_item_whose_voxels_do_not_fit_is_searched_in_parts() -> None:
    table = Table([1] * 5, 2)
    lists = lists_of([[0], [1, 2, 3], [4, 0]])
    run(load_and_search(table.data, lists, table.search, EXACT, table.spent, together=True))
    assert table.rows_seen() == [[0], [1, 2, 3], [4, 0]]
    assert table.calls == [([0], [0]), ([1], [1, 2]), ([1], [3]), ([2], [0, 4])]


def test_whole_items_share_a_round_as_far_as_they_fit() -> None:
    table = Table([1] * 6, 8)
    lists = lists_of([[0, 1], [1, 2], [3, 4], [4, 5]])
    run(load_and_search(table.data, lists, table.search, EXACT, table.spent, together=True))
    assert table.calls == [([0, 1], [0, 1, 2, 3]), ([2, 3], [3, 4, 5])]


@pytest.mark.parametrize("together", [False, True])
@pytest.mark.parametrize("stop_at", range(1, 6))
def test_a_stop_leaves_what_was_not_searched_and_loads_no_more(stop_at: int, together: bool) -> None:
    table, items = Table([1] * 6, 2), [[0, 1], [2, 0, 3], [4]]
    table.stop_at = stop_at
    budget = QueryBudget(stop=table.stop)
    left = run(
        resolve(table.data, lists_of(items), table.search, budget, table.spent, None, together=together)
    )
    assert sum(map(len, table.seen.values())) == stop_at
    for item, own in enumerate(items):
        done = len(table.seen.get(item, []))
        assert left[item] == (done + 0.5 if done < len(own) else np.inf)
    assert sum(table.store.loads.values()) <= stop_at + 2
    assert not table.residency._pins
    table.residency.check()


def test_a_request_that_was_stopped_before_loads_nothing() -> None:
    table = Table([1] * 2, 2)
    table.stop.set("")
    left = run(
        resolve(table.data, lists_of([[1], []]), table.search, QueryBudget(stop=table.stop), table.spent)
    )
    assert left.tolist() == [0.5, np.inf] and not table.calls and not table.store.loads


@pytest.mark.parametrize("together", [False, True])
def test_voxels_that_are_late_or_unreadable_are_missing(together: bool) -> None:
    table = Table([1] * 4, 4)
    table.store.faults[3] = "corrupt"
    table.load(1, 3)
    lists, late = lists_of([[0, 1], [1, 3], [2]]), QueryBudget(late=LateVoxels())
    left = run(resolve(table.data, lists, table.search, late, table.spent, together=together))
    assert table.seen == {0: [(0, MISSING), (1, HELD)], 1: [(1, HELD), (3, MISSING)], 2: [(2, MISSING)]}
    assert (left == np.inf).all() and not table.store.loads
    assert sorted(table.spent.late) == [0, 2] and len(table.spent.faults) == 1
    assert (table.spent.hits, table.spent.misses) == (1, 0)


def test_a_late_voxel_is_missing_although_another_thread_loads_it_now() -> None:
    table = Table([1] * 2, 2)

    acquire = table.residency.acquire

    def slow(*arguments: Any, **options: Any) -> Any:
        found = acquire(*arguments, **options)
        table.residency.acquire = acquire  # type: ignore[method-assign]
        table.load(1)  # after the hold has found it absent, before the search
        return found

    table.residency.acquire = slow  # type: ignore[method-assign]
    late = QueryBudget(late=LateVoxels())
    run(resolve(table.data, lists_of([[1]]), table.search, late, table.spent))
    assert table.residency.where[1, 0] >= 0
    assert table.seen == {0: [(1, MISSING)]}


@pytest.mark.parametrize("together", [False, True])
def test_settle_is_asked_about_absent_voxels_alone(together: bool) -> None:
    table = Table([1] * 6, 6)
    table.load(1, 2)
    asked: list[list[list[int]]] = []

    def settle(lists: VoxelLists) -> VoxelLists:
        asked.append(rows_of(lists))
        assert not table.store.loads, "before any load"
        assert bool(table.seen) != together, "what is resident was searched before, unless voxels go together"
        return drop_items(lists, np.array([True, False, False]))

    lists = lists_of([[0, 1, 3], [2, 4], [1, 2]])
    left = run(resolve(table.data, lists, table.search, EXACT, table.spent, settle, together=together))
    assert asked == [[[0, 3], [4], []]]
    assert table.rows_seen() == [[1], [2, 4], [1, 2]] and sorted(table.store.loads) == [4]
    assert (left == np.inf).all()
    run(resolve(table.data, lists_of([[1, 2, 4]]), table.search, EXACT, table.spent, settle))
    assert len(asked) == 1, "all of them are resident"


@pytest.mark.parametrize("together", [False, True])
def test_settle_is_not_asked_after_a_stop(together: bool) -> None:
    """It may rely on every resident voxel having been searched, and an answer is due."""
    table = Table([1] * 4, 4)
    table.load(0, 1)
    table.stop_at = 1
    if together:
        table.stop.set("")

    def settle(_: VoxelLists) -> VoxelLists:
        raise AssertionError("asked after a stop")

    lists, budget = lists_of([[0, 1, 2], [3]]), QueryBudget(stop=table.stop)
    left = run(resolve(table.data, lists, table.search, budget, table.spent, settle, together=together))
    assert left.tolist() == [0.5 if together else 1.5, 0.5] and not table.store.loads


def test_entries_and_items_are_dropped() -> None:
    lists = lists_of([[5, 6], [], [7, 8, 9]])
    assert drop_entries(lists, np.zeros(5, bool)) is lists
    fewer = drop_entries(lists, np.array([True, False, True, False, True]))
    assert rows_of(fewer) == [[6], [], [8]] and fewer.near.tolist() == [1.5, 1.5]
    assert rows_of(drop_items(lists, np.array([True, False, False]))) == [[], [], [7, 8, 9]]
