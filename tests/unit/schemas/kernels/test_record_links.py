"""Test the links of a voxel's nodes by the kernel alone: trees given as lists of levels, and each fault."""

import numpy as np
import pytest
from solidcloud.schemas.kernels.record_rows import link_rows

pytestmark = pytest.mark.interpreted

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


def test_the_tree_of_the_faults_below_is_sound() -> None:
    count, first, leaf, cell = laid_out(TOP, CELLS)
    assert count == [2, 1, 2, 4, 2, 1, 5, 6, 2, 1, 1]
    assert link(count, *sizes(CELLS)) == (5, first, leaf, cell)
    assert first == [1, 3, 4, 0, 6, 8, 4, 9, 9, 15, 16]


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


def test_more_rows_than_links_need_are_a_fault() -> None:
    count = laid_out([], CELLS[1:2])[0]
    assert link(count, [3], [11])[0] == 2
    assert link([*count, 1], [4], [11])[0] == -1 - 2
    assert link([*count, 11], [4], [11])[0] == -1 - 2
