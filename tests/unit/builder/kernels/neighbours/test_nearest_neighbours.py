"""Compare the closest distinct points with brute force, ties included, for any order and boxes."""

import numpy as np
import pytest
from numpy.typing import NDArray
from solidcloud.builder.kernels.neighbours.nearest_neighbours import (
    BLOCK,
    FAN,
    STACK,
    _box_distance2,
    _insert,
    bound_boxes,
    box_starts,
    closest_distinct,
)
from solidcloud.builder.kernels.points.octree_cells import voxel_codes
from synthetic_scans import make_steps


def in_morton_order(points: NDArray[np.int32]) -> NDArray[np.int32]:
    """The distinct points."""
    return points[np.unique(voxel_codes(points), return_index=True)[1]]


def found(points: NDArray[np.int32], i: int, k: int, limit2: int) -> list[list[int]]:
    """What `closest_distinct` finds, by rows."""
    starts = box_starts(len(points))
    closest, stack = np.full((k, 4), -1, np.int64), np.empty((STACK, 2), np.int64)
    held = closest_distinct(points, bound_boxes(points, starts), starts, i, limit2, closest, stack)
    return closest[:held].tolist()


def judged(points: NDArray[np.int32], i: int, k: int, limit2: int) -> list[list[int]]:
    """The same by sorting all."""
    apart = points.astype(np.int64) - points[i]
    rows = np.column_stack([(apart**2).sum(axis=1), apart])
    rows = rows[(rows[:, 0] > 0) & (rows[:, 0] <= limit2)]
    return sorted(rows.tolist())[:k]


@pytest.mark.interpreted
@pytest.mark.parametrize("count", [1, 2, BLOCK, BLOCK + 1, BLOCK * FAN, BLOCK * FAN + 1, 3000])
def test_boxes_hold_their_points(count: int) -> None:
    points = in_morton_order(make_steps("noise", 3, count, 1 << 20))
    starts = box_starts(count)
    boxes = bound_boxes(points, starts)
    for level in range(len(starts) - 1):
        size = BLOCK * FAN**level
        assert starts[level + 1] - starts[level] == -(-count // size)
        for box in range(starts[level], starts[level + 1]):
            held = points[(box - starts[level]) * size :][:size]
            assert boxes[box].tolist() == [*held.min(axis=0), *held.max(axis=0)]
    assert starts[-1] - starts[-2] == 1


@pytest.mark.interpreted
@pytest.mark.parametrize("kind", ["plane", "corner", "noise", "duplicates"])
@pytest.mark.parametrize("k", [1, 6, 24])
def test_the_closest_equal_brute_force(kind: str, k: int) -> None:
    # Coordinates of few steps, so that many points are equally far from one; and of many.
    for steps in (12, 1000, 1 << 21):
        points = in_morton_order(make_steps(kind, 5, 300, steps))
        for limit2 in (2, 9, (steps // 9) ** 2, 3 * steps**2):
            for i in range(0, len(points), 17):
                assert found(points, i, k, limit2) == judged(points, i, k, limit2)


def test_the_order_of_points_changes_nothing() -> None:
    points = in_morton_order(make_steps("corner", 8, 2000, 40))
    order = np.random.default_rng(8).permutation(len(points))
    for i in range(0, len(points), 7):
        assert found(points[order], int(np.flatnonzero(order == i)[0]), 12, 400) == found(points, i, 12, 400)


def test_ties_go_to_lesser_coordinates() -> None:
    axes = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [-1, 0, 0], [0, -1, 0], [0, 0, -1]]) + 5
    points = in_morton_order(axes.astype(np.int32))
    i = int(np.flatnonzero((points == 5).all(axis=1))[0])
    assert found(points, i, 4, 100) == [[1, -1, 0, 0], [1, 0, -1, 0], [1, 0, 0, -1], [1, 0, 0, 1]]


@pytest.mark.interpreted
def test_a_distance_at_the_limit_counts() -> None:
    points = np.array([[0, 0, 0], [3, 4, 0]], np.int32)
    assert found(points, 0, 2, 25) == [[25, 3, 4, 0]]
    assert found(points, 0, 2, 24) == []


@pytest.mark.interpreted
@pytest.mark.parametrize("k", [1, 2, 5])
def test_what_is_inserted_is_among_the_first_in_order(k: int) -> None:
    """Of few values, so that many tie in one, two or three of the four."""
    rng = np.random.default_rng(k)
    for _ in range(30):
        rows = rng.integers(-1, 2, (8, 4))
        closest, held = np.full((k, 4), -9, np.int64), 0
        for count, row in enumerate(rows, 1):
            held = _insert(closest, held, *row)
            expected = sorted(rows[:count].tolist())[:k]
            assert held == len(expected) and closest[:held].tolist() == expected


@pytest.mark.interpreted
def test_the_distance_of_a_box_is_that_of_its_nearest_place() -> None:
    rng = np.random.default_rng(4)
    for wide in (3, 1 << 21):
        for _ in range(100):
            edges = np.sort(rng.integers(-wide, wide, (2, 3)), axis=0)
            at = rng.integers(-2 * wide, 2 * wide, 3)
            nearest = np.clip(at, edges[0], edges[1])
            boxes = edges.reshape(1, 6).astype(np.int32)
            assert _box_distance2(boxes, 0, *at) == ((at - nearest) ** 2).sum()


def test_a_far_cluster_is_dense_and_one_point_alone() -> None:
    # One in a million of the others' density, in one order with them.
    dense = make_steps("noise", 2, 20_000, 100)
    points = in_morton_order(np.concatenate([dense, [[60_000, 60_000, 60_000]]]).astype(np.int32))
    alone = int(np.flatnonzero(points[:, 0] == 60_000)[0])
    for i in (alone, 0, 999):
        assert found(points, i, 6, 1 << 40) == judged(points, i, 6, 1 << 40)
