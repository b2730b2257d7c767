"""Compare the kernels of a record's rows with a few lines of plain Python each."""

from typing import NamedTuple

import numpy as np
import pytest
from solidcloud.schemas.kernels.record_rows import LANES, NO_AXIS, lanes_to_points, leaf_lanes

pytestmark = pytest.mark.interpreted

Links = tuple[np.ndarray, np.ndarray, np.ndarray]


class Leaves(NamedTuple):
    """Leaf nodes among other rows. runs: (begin, count, axis) of each, in the order of the rows."""

    points: np.ndarray
    runs: list[tuple[int, int, int]]
    links: Links
    count: np.ndarray
    axis: np.ndarray
    block_low: np.ndarray


def leaves(seed: int, most: int = 300) -> Leaves:
    """Leaf nodes of all sizes, of two cells, with rows of no leaf between; points below `most` from their corner."""
    rng = np.random.default_rng(seed)
    held = [1, LANES, 2, LANES - 1, *rng.integers(1, LANES + 1, 3).tolist()]
    axes = [0, 1, 2, NO_AXIS, 2, 0, 1]
    begins = np.cumsum([0, *held])
    points = rng.integers(0, most, (begins[-1], 3)).astype(np.uint16)
    first, is_leaf, cell, count, axis = [], [], [], [], []
    for k, (a, n, along) in enumerate(zip(begins.tolist(), held, axes, strict=False)):
        if k % 3 == 1:  # a row that is no leaf node, with figures that would do harm as one's
            first, is_leaf, cell = [*first, 1], [*is_leaf, False], [*cell, -1]
            count, axis = [*count, 9], [*axis, 0]
        first, is_leaf, cell = [*first, a], [*is_leaf, True], [*cell, k % 2]
        count, axis = [*count, n], [*axis, along]
        if along != NO_AXIS:
            run = slice(a, a + n)
            points[run] = points[run][np.argsort(points[run, along], kind="stable")]
    n = len(first)
    low = rng.integers(0, 500, (3, n)).astype(np.uint16)
    links = np.array(first, np.int32), np.array(is_leaf), np.array(cell, np.int32)
    runs = [(a, k, along) for a, k, along in zip(begins.tolist(), held, axes, strict=False)]
    return Leaves(points, runs, links, np.array(count, np.uint8), np.array(axis, np.uint8), low)


def plain_deltas(own: Leaves) -> np.ndarray:
    """The points with each run's sort axis as steps from the point before."""
    deltas = own.points.astype(int)
    for begin, count, axis in own.runs:
        if axis != NO_AXIS:
            column = own.points[begin : begin + count, axis].astype(int)
            deltas[begin + 1 : begin + count, axis] = np.diff(column)
    return deltas.astype(np.uint16)


def planes_of(deltas: np.ndarray) -> np.ndarray:
    """Low and high bytes of x, y, z, (6, p), and a plane behind that is another column's."""
    planes = [column >> shift & 255 for column in deltas.T.astype(int) for shift in (0, 8)]
    return np.array([*planes, planes[0] ^ 255], np.uint8)


def padded(run: np.ndarray) -> list:
    """The rows of a run, the last one repeated to LANES."""
    return np.concatenate([run, np.repeat(run[-1:], LANES - len(run), axis=0)]).tolist()


def bounds() -> np.ndarray:
    """Room for the bounds of points."""
    return np.empty((2, 3), np.int64)


def read(
    own: Leaves, voxel_steps: int = 1 << 20, log2: tuple[int, int] = (16, 15)
) -> tuple[bool, np.ndarray]:
    """What `leaf_lanes` says and writes; cells of the sizes given, one at the voxel's corner, one 1,000 steps off."""
    lanes = np.full((len(own.runs) + 1, 3, LANES), 7, np.uint16)
    cells = np.array([[0, 1000], [0, 2000], [0, 3000]], np.int32), np.array(log2, np.uint8)
    nodes = own.count, own.axis, own.block_low
    said = leaf_lanes(planes_of(plain_deltas(own)), own.links, nodes, cells, voxel_steps, lanes, bounds())
    return bool(said), lanes


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_lanes_hold_the_points_of_every_leaf_node(seed: int) -> None:
    own = leaves(seed, 20_000)
    said, lanes = read(own)
    assert said
    for block, (begin, count, _) in enumerate(own.runs):
        assert lanes[block].T.tolist() == padded(own.points[begin : begin + count])
    assert (lanes[-1] == 7).all()
    points = np.zeros_like(own.points)
    lanes_to_points(lanes, own.links, own.count, points)
    assert np.array_equal(points, own.points)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_point_one_step_outside_its_cell_or_voxel_is_seen(seed: int) -> None:
    own = leaves(seed)
    high = np.array([own.points[a : a + n].max(axis=0) + own.block_low[:, i] for i, (a, n) in leaf_rows(own)])
    corner = np.array([[0, 0, 0], [1000, 2000, 3000]])[[own.links[2][i] for i, _ in leaf_rows(own)]]
    inside = int((high + corner).max()) + 1
    assert read(own, inside)[0] and not read(own, inside - 1)[0]
    # A cell of 2^9 steps, and one leaf node moved until its farthest point is on the last step of it.
    for at, (i, _) in enumerate(leaf_rows(own)):
        for axis in range(3):
            moved = own._replace(block_low=np.zeros_like(own.block_low))
            moved.block_low[axis, i] = 511 - (high[at, axis] - own.block_low[axis, i])
            assert read(moved, log2=(9, 9))[0]
            moved.block_low[axis, i] += 1
            assert not read(moved, log2=(9, 9))[0]
            other = (10, 9) if own.links[2][i] == 0 else (9, 10)
            assert read(moved, log2=other)[0]


def leaf_rows(own: Leaves) -> list[tuple[int, tuple[int, int]]]:
    """Row, and (begin, count), of every leaf node."""
    return list(zip(np.flatnonzero(own.links[1]).tolist(), [run[:2] for run in own.runs], strict=True))


Levels = list[list[int]]  # counts of a BSH, level by level from its root


def sizes(cells: list[Levels]) -> tuple[list[int], list[int]]:
    """Nodes and points of every cell."""
    return [sum(map(len, tree)) for tree in cells], [sum(tree[-1]) for tree in cells]
