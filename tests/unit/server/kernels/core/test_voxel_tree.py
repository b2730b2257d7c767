"""The lists of voxels that rays and loose points reach: those that numpy finds among all boxes, nearest first."""

import numpy as np
import pytest
from numpy.typing import NDArray
from solidcloud.server.kernels.core.voxel_tree import FAN, VoxelLists, list_voxels, make_voxel_tree
from solidcloud.server.runtime.stop_flag import NO_STOP

pytestmark = pytest.mark.interpreted

UNITS = 1024.0  # exact units a step
BOXES = [0, 1, FAN + 1, 70]


def boxes(rng: np.random.Generator, count: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Boxes (v, 3) of up to 20 steps in a cube of 200."""
    low = rng.integers(-100, 100, (count, 3))
    return low, low + rng.integers(0, 20, (count, 3))


def entered(
    at: NDArray[np.float64], direction: NDArray[np.float64], low: NDArray, high: NDArray, grow: float
) -> NDArray[np.float64]:
    """Where a ray enters each of the boxes grown, inf where it does not."""
    found = np.full(len(low), np.inf)
    for row, (a, b) in enumerate(zip(low - grow - at, high + grow - at, strict=True)):
        first, last = 0.0, np.inf
        for u, begin, end in zip(direction, a, b, strict=True):
            if u:
                first, last = max(first, min(begin / u, end / u)), min(last, max(begin / u, end / u))
            elif begin > 0 or end < 0:
                last = -np.inf
        if first <= last:
            found[row] = first
    return found


def apart(at: NDArray[np.float64], low: NDArray, high: NDArray, slack: float) -> NDArray[np.float64]:
    """How far a point is from each of the boxes, less the slack."""
    gap = np.maximum(np.maximum(low - at, at - high), 0)
    return np.maximum(np.sqrt((gap**2).sum(axis=1)) - slack, 0)


def listed(
    tree: tuple, at: NDArray, direction: NDArray, along: bool, reach: float, radius: float
) -> VoxelLists:
    """The kernel's lists, asked with too little room first."""
    k = len(at)
    room = 0
    while True:
        lists = VoxelLists(np.zeros(k + 1, np.int64), np.full(room, -1), np.full(room, np.nan), np.zeros(k))
        units = np.rint(at * UNITS).astype(np.int64)
        needed = list_voxels(
            tree,
            units,
            direction,
            along,
            round(reach * UNITS),
            round(radius * UNITS),
            UNITS,
            NO_STOP.flag,
            lists,
        )
        assert needed == lists.starts[k]
        if needed <= room:
            assert (lists.rows[needed:] == -1).all()
            return lists
        assert (lists.rows >= 0).all(), "what fits is written"
        room = needed if room else 3


@pytest.mark.parametrize("reach", [0.0, 30.0])
@pytest.mark.parametrize("count", BOXES)
@pytest.mark.parametrize("along", [True, False])
def test_lists_hold_what_is_reached_nearest_first(along: bool, count: int, reach: float) -> None:
    rng = np.random.default_rng([count, int(reach), along])
    low, high = boxes(rng, count)
    unknown = np.stack(boxes(rng, 3), axis=1)
    tree = make_voxel_tree(low, high, unknown)
    k = 12
    at = np.rint(rng.uniform(-130, 130, (k, 3)) * UNITS) / UNITS
    if count:
        at[:4] = (low[rng.integers(count, size=4)] + high[rng.integers(count, size=4)]) // 2
    direction = rng.normal(size=(k, 3))
    direction[::3] = np.eye(3)[rng.integers(3, size=len(direction[::3]))] * -1.0
    direction[1::3, 1] = 0.0
    direction /= np.sqrt((direction**2).sum(axis=1))[:, None]
    radius = 2.5 if along else 0.0
    lists = listed(tree, at, direction, along, reach, radius)
    for i in range(k):
        if along:
            near = entered(at[i], direction[i], low, high, radius + 1)
            hidden = entered(at[i], direction[i], unknown[:, 0], unknown[:, 1], radius + 1)
        else:
            near, hidden = apart(at[i], low, high, 1.0), apart(at[i], unknown[:, 0], unknown[:, 1], 1.0)
        rows = lists.rows[lists.starts[i] : lists.starts[i + 1]]
        said = lists.near[lists.starts[i] : lists.starts[i + 1]] / UNITS
        assert len(set(rows.tolist())) == len(rows)
        assert np.abs(said - near[rows]).max(initial=0) <= 1e-9
        # Up to the reach and a step all, beyond it none.
        assert set(np.flatnonzero(near <= reach + 1 - 1e-9)) <= set(rows.tolist())
        assert (near[rows] <= reach + 1 + 1e-9).all()
        assert list(zip(said, rows, strict=True)) == sorted(zip(said, rows, strict=True))
        least = hidden.min() if hidden.min() <= reach + 1 else np.inf
        assert lists.unseen[i] / UNITS == pytest.approx(least, abs=1e-9)


def test_equal_distances_are_sorted_by_row() -> None:
    low = np.zeros((50, 3), np.int64)
    tree = make_voxel_tree(low, low + 9, np.zeros((0, 2, 3), np.int64))
    lists = listed(tree, np.ones((1, 3)), np.eye(3)[:1], False, 5.0, 0.0)
    assert lists.rows.tolist() == list(range(50)) and not lists.near.any()


@pytest.mark.parametrize("along", [True, False])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_boxes_far_away_are_grown_by_what_rounding_takes(along: bool, sign: float) -> None:
    """A step and 2^-46 of the largest figure, 17 steps at 2^50: once beside a ray, twice before a point."""
    far = np.array([[1 << 50, 0, 0]])
    tree = make_voxel_tree(far, far, np.zeros((0, 2, 3), np.int64))
    direction = np.array([[0.0, 1.0, 0.0]])
    for away, found in ((16.5, 1), (17.5, 0)) if along else ((33.5, 1), (34.5, 0)):
        at = np.array([[float(1 << 50), sign * away, 0.0]])
        if along:
            at[0] = [(1 << 50) + 0.0, -5.0, sign * away]
        units = np.rint(at * 4).astype(np.int64)
        lists = VoxelLists(np.zeros(2, np.int64), np.full(4, -1), np.zeros(4), np.zeros(1))
        reach = 40 if along else 0
        assert list_voxels(tree, units, direction, along, reach, 0, 4.0, NO_STOP.flag, lists) == found
