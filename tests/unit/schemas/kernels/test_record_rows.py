"""Compare the kernels of a record's rows with a few lines of plain Python each."""

from typing import NamedTuple

import numpy as np
import pytest
from solidcloud.schemas.kernels.record_rows import (
    LANES,
    NO_AXIS,
    lanes_to_points,
    leaf_lanes,
    link_rows,
)

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


def test_deltas_that_add_up_beyond_16_bits_are_outside() -> None:
    # 3 * 30,000 wraps to 24,464, which would lie inside.
    links = np.zeros(1, np.int32), np.ones(1, bool), np.zeros(1, np.int32)
    nodes = np.full(1, 3, np.uint8), np.zeros(1, np.uint8), np.zeros((3, 1), np.uint16)
    cells = np.zeros((3, 1), np.int32), np.full(1, 16, np.uint8)
    planes = planes_of(np.array([[30_000, 0, 0]] * 3))
    lanes = np.empty((1, 3, LANES), np.uint16)
    assert not leaf_lanes(planes, links, nodes, cells, 1 << 20, lanes, bounds())
    planes = planes_of(np.array([[20_000, 0, 0]] * 3))
    assert leaf_lanes(planes, links, nodes, cells, 1 << 20, lanes, bounds())
    assert lanes[0, 0].tolist() == [20_000, 40_000] + [60_000] * (LANES - 2)


Levels = list[list[int]]  # counts of a BSH, level by level from its root


def grown(rng: np.random.Generator, levels: int, most: int) -> Levels:
    """A tree of so many levels; counts from 1 to `most`."""
    tree: Levels = [rng.integers(1, most + 1, 1).tolist()]
    for _ in range(levels - 1):
        tree.append(rng.integers(1, most + 1, sum(tree[-1])).tolist())
    return tree


def laid_out(top: Levels, cells: list[Levels]) -> tuple[list[int], list[int], list[bool], list[int]]:
    """count, first, is_leaf and cell of all rows: the top BSH, every cell's root, then the cells' other nodes."""
    tops, c = sum(map(len, top)), len(cells)
    count = [k for level in top for k in level] + [tree[0][0] for tree in cells]
    leaf, cell = [False] * tops + [len(tree) == 1 for tree in cells], [-1] * tops + list(range(c))
    # The children of the top's nodes follow one another from row 1 on, its last level's are the cells' roots.
    first = (np.cumsum([1, *count[:tops]])[:-1]).tolist()
    point, rest = 0, tops + c
    roots, others = [], []
    for number, tree in enumerate(cells):
        firsts, child = [], rest
        for level, counts in enumerate(tree):
            for k in counts:
                last = level == len(tree) - 1
                firsts.append(point if last else child)
                point, child = (point + k, child) if last else (point, child + k)
        roots.append(firsts[0])
        others += firsts[1:]
        below = [(k, level == len(tree) - 1) for level, counts in enumerate(tree) if level for k in counts]
        count += [k for k, _ in below]
        leaf += [is_leaf for _, is_leaf in below]
        cell += [number] * len(below)
        rest += len(below)
    return count, first + roots + others, leaf, cell


def link(count: list[int], nodes: list[int], points: list[int]) -> tuple[int, list, list, list]:
    """What the kernel says of counts: its word, first, is_leaf and cell."""
    n = len(count)
    first, leaf, cell = np.full(n, -9, np.int32), np.zeros(n, bool), np.full(n, -9, np.int32)
    said = link_rows(
        np.array(count, np.uint8), np.array(nodes, np.uint32), np.array(points, np.uint32), first, leaf, cell
    )
    return int(said), first.tolist(), leaf.tolist(), cell.tolist()


def sizes(cells: list[Levels]) -> tuple[list[int], list[int]]:
    """Nodes and points of every cell."""
    return [sum(map(len, tree)) for tree in cells], [sum(tree[-1]) for tree in cells]


@pytest.mark.parametrize("seed", range(12))
def test_links_are_where_the_rows_were_put(seed: int) -> None:
    rng = np.random.default_rng(seed)
    top = grown(rng, int(rng.integers(1, 4)), 3) if seed % 4 else []
    c = sum(top[-1]) if top else 1
    cells = [grown(rng, int(rng.integers(1, 4)), 3) for _ in range(c)]
    count, *expected = laid_out(top, cells)
    said, *found = link(count, *sizes(cells))
    assert said == len(top) + max(map(len, cells))
    assert found == expected


# A top of two levels, [2] and [1, 2]; three cells: a leaf node; a root with two leaf nodes; three levels.
TOP: Levels = [[2], [1, 2]]
CELLS: list[Levels] = [[[4]], [[2], [5, 6]], [[1], [2], [1, 1]]]
# Rows: 0 top root, 1-2 top, 3-5 cell roots, 6-7 leaf nodes of cell 1, 8 inner node of cell 2, 9-10 its leaf nodes.


@pytest.mark.parametrize(
    ("row", "count", "named"),
    [
        (0, 0, 0), (1, 0, 1), (2, 0, 2), (3, 0, 3), (4, 0, 4), (5, 0, 5), (6, 0, 6), (8, 0, 8), (10, 0, 10),
        (0, 3, 0), (4, 3, 4), (5, 3, 5), (8, 3, 8), (5, 4, 5),  # more children than rows are left
        (0, 1, 2),  # then the top is a chain, and its last row has two cells
        (1, 2, 2), (2, 1, 2), (2, 3, 2),  # four cells, or two: named is the top's last row
        (3, 5, 3), (6, 4, 4), (7, 7, 4), (9, 2, 5),  # points: named is the cell's root
        (4, 1, 6),  # a level of one leaf node, which holds five nodes then
    ],
)  # fmt: skip
def test_the_first_row_that_does_not_add_up_is_named(row: int, count: int, named: int) -> None:
    counts = laid_out(TOP, CELLS)[0]
    counts[row] = count
    assert -1 - link(counts, *sizes(CELLS))[0] == named
