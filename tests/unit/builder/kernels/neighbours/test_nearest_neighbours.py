"""Compare the closest distinct points with brute force, ties included, for any order and boxes."""

import numpy as np
import pytest
from numpy.typing import NDArray
from solidcloud.builder.kernels.neighbours.nearest_neighbours import (
    STACK,
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
@pytest.mark.parametrize("kind", ["plane", "duplicates"])
@pytest.mark.parametrize("k", [1, 24])
def test_the_closest_equal_brute_force(kind: str, k: int) -> None:
    # Coordinates of few steps, so that many points are equally far from one; and of many.
    for steps in (12, 1000, 1 << 21):
        points = in_morton_order(make_steps(kind, 5, 300, steps))
        for limit2 in (2, 9, (steps // 9) ** 2, 3 * steps**2):
            for i in range(0, len(points), 17):
                assert found(points, i, k, limit2) == judged(points, i, k, limit2)


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
