"""The voxels in reach of balls and moving cubes: those that numpy finds among all boxes, nearest first."""

import numpy as np
import pytest
from numpy.typing import NDArray
from solidcloud.server.kernels.core.reach import (
    FAN,
    Items,
    VoxelLists,
    VoxelTree,
    list_reach,
    make_voxel_tree,
)
from solidcloud.server.runtime.stop_flag import NO_STOP, StopFlag

pytestmark = pytest.mark.interpreted

BOXES = [0, 1, FAN + 1, 70]
Floats = NDArray[np.float64]


def boxes(rng: np.random.Generator, count: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Boxes (v, 3) of up to 20 steps in a cube of 200."""
    low = rng.integers(-100, 100, (count, 3))
    return low, low + rng.integers(0, 20, (count, 3))


def tree_of(low: NDArray[np.int64], high: NDArray[np.int64], unknown: NDArray[np.int64]) -> VoxelTree:
    """The tree over boxes, with boxes of scans that were left out (u, 2, 3)."""
    return make_voxel_tree(low, high, np.array([[-100] * 3, [120] * 3]), unknown)


def apart(begin: Floats, span: float, own: float, low: NDArray, high: NDArray) -> Floats:
    """How far boxes are from a ball's own part, inf beyond its span."""
    gap = np.sqrt((np.maximum(np.maximum(low - begin, begin - high), 0) ** 2).sum(axis=1))
    return np.where(gap <= span, np.maximum(gap - own, 0), np.inf)


def entered(begin: Floats, end: Floats, span: float, low: NDArray, high: NDArray) -> Floats:
    """How far a moving cube goes until it meets each of the boxes, inf where it does not."""
    found = np.full(len(low), np.inf)
    for row, (a, b) in enumerate(zip(low - span - begin, high + span - begin, strict=True)):
        first, last = 0.0, 1.0
        for way, near, far in zip(end - begin, a, b, strict=True):
            if way:
                first, last = max(first, min(near / way, far / way)), min(last, max(near / way, far / way))
            elif near > 0 or far < 0:
                last = -np.inf
        if first <= last:
            found[row] = first * np.linalg.norm(end - begin)
    return found


def listed(tree: VoxelTree, items: Items) -> VoxelLists:
    """The kernel's lists, asked with too little room first."""
    k, room = len(items.span), 0
    while True:
        lists = VoxelLists(np.zeros(k + 1, np.int64), np.full(room, -1), np.full(room, np.nan), np.zeros(k))
        needed = list_reach(tree, items, NO_STOP.flag, lists)
        assert needed == lists.starts[k]
        if needed <= room:
            assert (lists.rows[needed:] == -1).all()
            return lists
        assert (lists.rows >= 0).all(), "what fits is written"
        room = needed if room else 3


@pytest.mark.parametrize("count", BOXES)
@pytest.mark.parametrize("moves", [True, False])
def test_lists_hold_what_is_reached_nearest_first(moves: bool, count: int) -> None:
    rng = np.random.default_rng([count, moves])
    low, high = boxes(rng, count)
    unknown = np.stack(boxes(rng, 3), axis=1)
    begin = rng.uniform(-130, 130, (12, 3))
    way = rng.normal(size=(12, 3)) * rng.uniform(0, 90, (12, 1))
    way[::3] = np.eye(3)[rng.integers(3, size=4)] * -40.0
    span = rng.uniform(0, 40, 12)
    items = Items(begin, begin + way if moves else begin, span, span * rng.uniform(0, 1, 12))
    lists = listed(tree_of(low, high, unknown), items)
    for i, (start, end, wide, own) in enumerate(zip(*items, strict=True)):
        if moves:
            near, hidden = (
                entered(start, end, wide, *both) for both in ((low, high), unknown.swapaxes(0, 1))
            )
        else:
            near, hidden = (apart(start, wide, own, *both) for both in ((low, high), unknown.swapaxes(0, 1)))
        rows = lists.rows[lists.starts[i] : lists.starts[i + 1]]
        said = lists.near[lists.starts[i] : lists.starts[i + 1]]
        assert sorted(rows.tolist()) == np.flatnonzero(near < np.inf).tolist()
        assert (said <= near[rows]).all() and np.abs(said - near[rows]).max(initial=0) <= 1e-6
        assert list(zip(said, rows, strict=True)) == sorted(zip(said, rows, strict=True))
        assert lists.unseen[i] == pytest.approx(hidden.min(), abs=1e-6)


def test_equal_distances_are_sorted_by_row() -> None:
    low = np.zeros((50, 3), np.int64)
    items = Items(np.ones((1, 3)), np.ones((1, 3)), np.full(1, 5.0), np.zeros(1))
    lists = listed(tree_of(low, low + 9, np.zeros((0, 2, 3), np.int64)), items)
    assert lists.rows.tolist() == list(range(50)) and not lists.near.any()


def test_a_stopped_request_knows_nothing() -> None:
    low, high = boxes(np.random.default_rng(4), 70)
    stop = StopFlag()
    stop.set("enough")
    lists = VoxelLists(np.zeros(3, np.int64), np.zeros(99, np.int64), np.zeros(99), np.full(2, np.inf))
    items = Items(np.zeros((2, 3)), np.zeros((2, 3)), np.full(2, 300.0), np.zeros(2))
    assert list_reach(tree_of(low, high, np.zeros((0, 2, 3), np.int64)), items, stop.flag, lists) == 0
    assert not lists.unseen.any()
