"""The arena: runs never overlap or leave the buffer, gaps join again, voxels are moved rather than evicted."""

import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from solidcloud.server.residency.arena import ALIGNMENT, ArenaBuffer, VoxelAllocator
from solidcloud.server.residency.voxel_cache import EvictionPolicy


class Filled:
    """A room whose runs are filled with their row numbers, as a load would."""

    def __init__(self, sizes: list[int], budget: int) -> None:
        self.gone, self.pins = list[int](), set[int]()  # gone: rows evicted so far, in order
        self.policy = EvictionPolicy(budget * ALIGNMENT)
        self.room = VoxelAllocator(
            budget * ALIGNMENT,
            [size * ALIGNMENT for size in sizes],
            self.policy.victims,
            self._evicted,
            self.pins,
            set(),
        )

    def _evicted(self, row: int) -> None:
        self.gone.append(row)
        self.policy.removed(row)

    def forget(self, row: int) -> None:
        """Release a row, as after a failed load."""
        self.room.forget(row)
        self.policy.removed(row)

    def make(self, row: int, stays: frozenset[int] = frozenset(), most: int | None = None) -> bool:
        """Make room for a row that is not there; `stays` neither go nor move."""
        room = self.room
        self.pins.clear()
        self.pins.update(stays)
        if not room.allocate(row, lambda _: False, most):
            return False
        self.policy.added(row, room.sizes[row], scan=False)
        offset = room.offsets[row]
        self.room.where[row] = (offset // 4, offset // 4 + 1, offset // 2 + 3)
        self.room.buffer.arena.ints[offset // 4 : (offset + room.sizes[row]) // 4] = row
        return True

    def check(self) -> None:
        """Every run is whole, and `where` says where."""
        self.room.check()
        for row, offset in self.room.offsets.items():
            run = self.room.buffer.arena.ints[offset // 4 : (offset + self.room.sizes[row]) // 4]
            assert (run == row).all()
            assert self.room.where[row].tolist() == [offset // 4, offset // 4 + 1, offset // 2 + 3]


@pytest.mark.parametrize("budget", [0, 1, 63])
def test_a_budget_below_a_cache_line_holds_nothing(budget: int) -> None:
    assert ArenaBuffer(budget).total_bytes == 0
    filled = Filled([1], 0)
    assert not filled.make(0)
    filled.check()


def test_a_voxel_gets_the_shortest_gap_that_suffices() -> None:
    filled = Filled([1, 2, 1, 2, 1, 1, 3], 8)
    assert all(filled.make(row) for row in range(5))
    assert list(filled.room.offsets.values()) == [0, 64, 192, 256, 384]
    filled.forget(1)
    assert filled.make(5) and filled.room.offsets[5] == 448, "one line is free there, two at 64"
    filled.forget(2)
    assert filled.make(6) and filled.room.offsets[6] == 64, "the gaps on both sides are joined"
    assert filled.room.moved_bytes == 0 and filled.gone == []
    filled.check()


def test_random_use_against_a_model(rng: np.random.Generator) -> None:
    """The model: an array of owners, one a cache line. Nothing may be evicted or moved."""
    lines, sizes = 50, rng.integers(1, 13, 1500).tolist()
    filled, owners = Filled(sizes, lines), np.full(lines, -1)
    for row, size in enumerate(sizes):
        held = list(filled.room.offsets)
        if held and rng.random() < 0.5:
            gone = held[rng.integers(len(held))]
            filled.forget(gone)
            owners[owners == gone] = -1
            continue
        free = "".join("." if owner < 0 else "x" for owner in owners)
        fits = [(len(run[0]), run.start()) for run in re.finditer(r"\.+", free) if len(run[0]) >= size]
        assert filled.make(row, stays=frozenset(held)) == bool(fits)
        if fits:
            at = min(fits)[1]
            assert filled.room.offsets[row] == at * ALIGNMENT
            owners[at : at + size] = row
        filled.room.check()


def test_room_in_pieces_is_joined_by_moving() -> None:
    filled = Filled([1] * 6 + [2], 6)
    assert all(filled.make(row) for row in range(6))
    for row in (1, 4):
        filled.forget(row)
    assert filled.make(6) and filled.gone == []
    # Between the two holes stood 2 and 3; one stretch of those two had to be moved, by one block.
    assert filled.room.moved_bytes == 2 * ALIGNMENT
    filled.check()


def test_what_stays_is_not_moved_and_others_go_instead() -> None:
    filled = Filled([1] * 6 + [2], 6)
    assert all(filled.make(row) for row in range(6))
    for row in (1, 4):
        filled.forget(row)
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
    assert filled.gone == []
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
            filled.forget(row)
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
        longest, at = max(longest, offset // ALIGNMENT - at), offset // ALIGNMENT + sizes[row]
    return max(longest, budget - at)
