"""Test the closest points of a record, and the nearest boxes, by brute force."""

import numpy as np
import pytest
from opened_records import open_points, open_scan, points_of
from solidcloud.builder.kernels.neighbours.nearest_points import (
    FAR,
    closest_in_record,
    make_box_tree,
    near_boxes,
)
from solidcloud.builder.voxel.record_points import leaves_of, spheres_of
from solidcloud.builder.voxel.voxel_octree import VoxelPoints
from solidcloud.schemas.archive.codec import DecompressedRecord

pytestmark = pytest.mark.interpreted


def brute(points: np.ndarray, queries: np.ndarray) -> np.ndarray:
    """Squared distances to the closest distinct points."""
    d2 = ((queries[:, None] - points) ** 2).sum(axis=2)
    return np.where(d2 > 0, d2, FAR).min(axis=1)


def asked(
    record: DecompressedRecord, queries: np.ndarray, best: np.ndarray, homes: np.ndarray | None = None
) -> np.ndarray:
    """What `closest_in_record` makes of best: queries one by one, or with the leaf node of each, a node's together."""
    starts = np.arange(len(queries)) if homes is None else np.flatnonzero(np.diff(homes, prepend=-1))
    home = np.full(len(starts), -1, np.int32) if homes is None else homes[starts].astype(np.int32)
    lowered = best.copy()
    groups = np.append(starts, len(queries)).astype(np.int64)
    closest_in_record(leaves_of(record), spheres_of(record), queries, groups, home, lowered)
    return lowered


@pytest.mark.parametrize("kind", ["noise", "duplicates", "one point"])
@pytest.mark.parametrize("steps", [50, 1 << 21])
def test_the_closest_in_a_record_is_that_of_brute_force(kind: str, steps: int) -> None:
    record = open_scan(kind, 2, 120, steps)
    points, nodes = points_of(record)
    rng = np.random.default_rng(3)
    far = np.full(len(points), FAR)
    expected = brute(points, points)
    assert asked(record, points, far, nodes).tolist() == expected.tolist()
    others = np.concatenate([points[:30], rng.integers(-2 * steps, 3 * steps, (30, 3))])
    expected = brute(points, others)
    assert asked(record, others, np.full(len(others), FAR)).tolist() == expected.tolist()
    # What is known before is never raised, and what is farther out is not found.
    known = np.clip(expected - rng.integers(-1, 2, len(others)), 0, FAR)
    assert asked(record, others, known).tolist() == np.minimum(known, expected).tolist()


def test_the_closest_in_a_record_is_found_from_very_far_off() -> None:
    """Where squares take 62 bits; and none where they would not fit."""
    record = open_points(VoxelPoints(np.array([[0, 0, 0], [9, 0, 0], [100, 50, 7]], np.int32)), 1000)
    away = (1 << 31) - 1
    queries = np.array([[away, 0, 0], [0, -away, 0], [-(1 << 31), 0, 0], [9, 1 << 30, 1 << 30]])
    found = asked(record, queries, np.full(4, FAR)).tolist()
    assert found == [
        (away - 100) ** 2 + 50**2 + 7**2,
        away**2,
        FAR,
        (2 << 60) - 2 * 50 * (1 << 30) - 2 * 7 * (1 << 30) + 91**2 + 50**2 + 7**2,
    ]


def test_long_differences_are_told_from_clamped_ones() -> None:
    """Around the greatest difference that three squares of fit 32 bits, on every axis."""
    for far in (26753, 26754, 26755, 46340, 65535):
        for axis in range(3):
            points = np.zeros((2, 3), np.int32)
            points[1, axis] = far
            record = open_points(VoxelPoints(points), 1 << 17, leaf=32)
            for known in (int(FAR), far * far + 1, far * far, 26754**2, 26754**2 + 1):
                expected = min(known, far * far)
                stored, nodes = points_of(record)
                assert asked(record, stored, np.full(2, known), nodes).tolist() == [expected] * 2


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


@pytest.mark.parametrize("count", [1, 9, 200])
@pytest.mark.parametrize("most", [1, 8])
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


def test_boxes_too_far_for_their_squares_are_none() -> None:
    near, far = (1 << 31) - 1, 1 << 31
    none = [[0, far, 0], [0, 0, 1 << 50], [near, near, near], [-near, near, 0]]
    # Three squares that int64 does not hold, two of them not a tenth above FAR.
    none += [[near, near, 1 << 17], [near, 1 << 17, near], [1 << 17, near, near]]
    low = np.array([[0, 0, 0], [near, 0, 0], *none])
    assert found_for(low, low, np.zeros(3, np.int64), 0, int(FAR), 4) == [[1]]
    assert found_for(low, low, np.zeros(3, np.int64), 0, int(FAR) - 1, 4) == [[1]]
