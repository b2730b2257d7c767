"""VoxelAllocator: voxels moved together rather than evicted, and nothing lost on the way."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from solidcloud.server.residency.allocator import VoxelAllocator
from solidcloud.server.residency.arena import ALIGNMENT as BLOCK
from solidcloud.server.residency.arena import ArenaBuffer
from solidcloud.server.residency.eviction import EvictionPolicy


class Filled:
    """A room whose runs are filled with their row numbers, as a load would."""

    def __init__(self, sizes: list[int], budget: int) -> None:
        self.buffer = ArenaBuffer(budget * BLOCK)
        self.where = np.full((len(sizes), 3), -1, np.int64)
        self.room = VoxelAllocator(
            self.buffer, [s * BLOCK for s in sizes], self.where, EvictionPolicy(budget * BLOCK)
        )
        self.gone: list[int] = []

    def make(self, row: int, stays: frozenset[int] = frozenset(), most: int | None = None) -> bool:
        """Make room for a row that is not there; `stays` neither go nor move."""
        room = self.room
        may = lambda other: other not in stays  # noqa: E731
        if not room.allocate(row, may, may, self.gone.append, scan=False, most=most):
            return False
        offset = room.offsets[row]
        self.where[row] = (offset // 4, offset // 4 + 1, offset // 2 + 3)
        self.buffer.arena.ints[offset // 4 : (offset + room.sizes[row]) // 4] = row
        return True

    def check(self) -> None:
        """Every run is whole, and `where` says where."""
        self.room.check()
        for row, offset in self.room.offsets.items():
            run = self.buffer.arena.ints[offset // 4 : (offset + self.room.sizes[row]) // 4]
            assert (run == row).all()
            assert self.where[row].tolist() == [offset // 4, offset // 4 + 1, offset // 2 + 3]


def test_room_in_pieces_is_joined_by_moving() -> None:
    filled = Filled([1] * 6 + [2], 6)
    assert all(filled.make(row) for row in range(6))
    for row in (1, 4):
        filled.room.forget(row)
    assert filled.make(6) and filled.gone == []
    # Between the two holes stood 2 and 3; one stretch of those two had to be moved, by one block.
    assert filled.room.moved_bytes == 2 * BLOCK
    filled.check()


def test_what_stays_is_not_moved_and_others_go_instead() -> None:
    filled = Filled([1] * 6 + [2], 6)
    assert all(filled.make(row) for row in range(6))
    for row in (1, 4):
        filled.room.forget(row)
    before = dict(filled.room.offsets)
    assert filled.make(6, stays=frozenset({2, 3}))
    assert filled.gone == [0]
    assert all(filled.room.offsets[row] == before[row] for row in (2, 3))
    filled.check()


def test_nothing_goes_where_all_that_may_is_too_little() -> None:
    filled = Filled([1, 1, 1, 3], 3)
    assert all(filled.make(row) for row in range(3))
    assert not filled.make(3, stays=frozenset({2}))
    assert not filled.make(3, most=2)
    assert filled.gone == [] and filled.room.evictions == 0
    assert filled.make(3) and filled.gone == [0, 1, 2]
    filled.check()


@given(
    sizes=st.lists(st.integers(1, 5), min_size=1, max_size=12),
    steps=st.lists(st.tuples(st.integers(0, 11), st.sets(st.integers(0, 11), max_size=4)), max_size=40),
)
@settings(max_examples=200, deadline=None, derandomize=True)
def test_whatever_comes_and_goes_stays_whole(sizes: list[int], steps: list[tuple[int, set[int]]]) -> None:
    """A row is refused only where those that stay leave no room in one run, however the others are placed."""
    budget = max(12, max(sizes))
    filled = Filled(sizes, budget)
    for row, stays in steps:
        row %= len(sizes)
        if row in filled.room.offsets:
            filled.room.forget(row)
            continue
        held = {other: filled.room.offsets[other] for other in stays if other in filled.room.offsets}
        made = filled.make(row, stays=frozenset(stays))
        assert all(filled.room.offsets[other] == offset for other, offset in held.items())
        assert made == (_longest_gap(held, sizes, budget) >= sizes[row])
        filled.check()


def _longest_gap(held: dict[int, int], sizes: list[int], budget: int) -> int:
    """Blocks of the longest stretch without any of these."""
    at, longest = 0, 0
    for row, offset in sorted(held.items(), key=lambda item: item[1]):
        longest, at = max(longest, offset // BLOCK - at), offset // BLOCK + sizes[row]
    return max(longest, budget - at)
