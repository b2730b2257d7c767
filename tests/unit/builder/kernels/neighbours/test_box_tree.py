"""Compare the nearest boxes with brute force, nearest first, over several calls."""

import numpy as np
import pytest
from solidcloud.builder.kernels.neighbours.nearest_points import FAR, make_box_tree, near_boxes

pytestmark = pytest.mark.interpreted


def box_distances(low: np.ndarray, high: np.ndarray, query: np.ndarray) -> list[int]:
    """Squared distances of a point from boxes, in Python's integers."""
    gaps = np.maximum(np.maximum(low - query, query - high), 0).tolist()
    return [sum(g * g for g in gap) for gap in gaps]


def found_for(
    low: np.ndarray, high: np.ndarray, query: np.ndarray, own: int, best: int, most: int
) -> list[list[int]]:
    """What `near_boxes` finds for one point, go by go."""
    tree, after, goes = make_box_tree(low, high), np.full((1, 2), -1), []
    while True:
        rows, distances = np.empty((1, most), np.int64), np.empty((1, most), np.int64)
        near_boxes(tree, query[None], np.array([own]), np.array([best]), after, rows, distances)
        held = rows[0][rows[0] != -1].tolist()
        if not held:
            return goes
        goes.append(held)
        assert distances[0, : len(held)].tolist() == [box_distances(low, high, query)[i] for i in held]


@pytest.mark.parametrize("count", [1, 2, 8, 9, 64, 65, 200])
@pytest.mark.parametrize("most", [1, 3, 8])
def test_near_boxes_are_those_of_brute_force(count: int, most: int) -> None:
    rng = np.random.default_rng([count, most])
    low = rng.integers(-100, 100, (count, 3)) * 4
    low = low[np.lexsort(low.T)]
    high = low + rng.integers(0, 30, (count, 3))
    for _ in range(10):
        query, own = rng.integers(-500, 500, 3), int(rng.integers(0, count))
        best = int(rng.choice([1, 100**2, 250**2, 2000**2]))
        order = sorted((d, i) for i, d in enumerate(box_distances(low, high, query)) if i != own and d < best)
        goes = found_for(low, high, query, own, best, most)
        assert [i for go in goes for i in go] == [i for _, i in order]
        assert all(len(go) == most for go in goes[:-1])


@pytest.mark.parametrize("most", [1, 2, 3, 5, 30])
def test_of_boxes_as_near_as_each_other_the_first_come_first(most: int) -> None:
    rng = np.random.default_rng(most)
    low = rng.integers(-2, 3, (30, 3)) * 10
    for own in range(0, 30, 7):
        order = sorted((d, i) for i, d in enumerate(box_distances(low, low, np.zeros(3))) if i != own)
        goes = found_for(low, low, np.zeros(3, np.int64), own, 10**6, most)
        assert [i for go in goes for i in go] == [i for _, i in order]


def test_where_nothing_is_known_one_box_is_found_at_a_time() -> None:
    low = np.array([[10, 0, 0], [0, 0, 0], [30, 0, 0], [20, 0, 0]])
    assert found_for(low, low + 1, np.array([0, 0, 0]), 1, int(FAR), 8) == [[0], [3], [2]]


def test_boxes_too_far_for_their_squares_are_none() -> None:
    near, far = (1 << 31) - 1, 1 << 31
    none = [[0, far, 0], [0, 0, 1 << 50], [near, near, near], [-near, near, 0]]
    # Three squares that int64 does not hold, two of them not a tenth above FAR.
    none += [[near, near, 1 << 17], [near, 1 << 17, near], [1 << 17, near, near]]
    low = np.array([[0, 0, 0], [near, 0, 0], *none])
    assert found_for(low, low, np.zeros(3, np.int64), 0, int(FAR), 4) == [[1]]
    assert found_for(low, low, np.zeros(3, np.int64), 0, int(FAR) - 1, 4) == [[1]]
