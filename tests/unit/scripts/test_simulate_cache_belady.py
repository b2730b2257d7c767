"""Test Belady's optimum against every possible order of eviction."""

import numpy as np
import pytest
from simulate_cache_cases.belady_optimum import next_uses, optimum


def fewest(rows: list[int], capacity: int) -> int:
    """Return the fewest misses, by brute force over all sets that could be resident."""
    states: dict[frozenset[int], int] = {frozenset(): 0}
    for row in rows:
        after: dict[frozenset[int], int] = {}
        for resident, misses in states.items():
            if row in resident:
                ways = [(resident, misses)]
            elif len(resident) < capacity:
                ways = [(resident | {row}, misses + 1)]
            else:
                ways = [(resident - {victim} | {row}, misses + 1) for victim in resident]
            for state, count in ways:
                after[state] = min(count, after.get(state, count))
        states = after
    return min(states.values())


def of_lru(rows: list[int], capacity: int) -> int:
    """Return the misses of LRU."""
    order: list[int] = []
    misses = 0
    for row in rows:
        if row in order:
            order.remove(row)
        else:
            misses += 1
            order = order[-(capacity - 1) :] if capacity > 1 else []
        order.append(row)
    return misses


@pytest.mark.parametrize("capacity", [1, 2, 3, 5])
@pytest.mark.parametrize("seed", range(10))
def test_no_order_of_eviction_has_fewer_misses(seed: int, capacity: int) -> None:
    rows = np.random.default_rng(seed).integers(0, 6, 40)
    missed = optimum(rows, capacity)
    assert int(missed.sum()) == fewest(rows.tolist(), capacity) <= of_lru(rows.tolist(), capacity)
    first = np.unique(rows, return_index=True)[1]
    assert missed[first].all(), "what was never there is missed"


def test_it_is_better_than_lru_where_lru_is_worst() -> None:
    rows = np.tile(np.arange(5), 20)
    assert of_lru(rows.tolist(), 4) == 100
    assert int(optimum(rows, 4).sum()) == 5 + 95 // 4, "every fourth, once there are five"
    assert optimum(rows, 5).sum() == 5 and optimum(rows[:0], 3).sum() == 0


def test_next_uses_are_those_of_the_same_row() -> None:
    assert next_uses(np.array([4, 7, 4, 4, 9, 7])).tolist() == [2, 5, 3, 9, 10, 11]
