"""Splitting and merging of octree cells until all their hierarchies have the same height.

This is the future work of [Fig12], section 8: "We also would like to design a bounding sphere
hierarchy for the partitions that distributes the point sets among different partitions in order to
make the trees of the complete data model with the same heights."

A packed tree of degree m over leaf nodes of l points has height h exactly when it holds l m^(h-1) +
1 to l m^h points. Cells with more points are split, as in any octree. Cells with fewer points are
merged with the remainders of their siblings, in the cube of their parent, up to the largest
permitted cube. A cell is still an aligned cube around its points, but cubes may nest.

A largest cube (2^16 steps: 6.6 m at 0.1 mm) may itself hold too few points: 10 of the 703 cells of
the generated façade in voxels of 8 m, 2 to 188 points each, and 3 of 717 in voxels of 32 m. Nothing
is left to merge them with, because coordinates in a cell have 16 bits and a voxel is loaded alone.
`raise_trees` puts nodes of one child above the roots of these cells. All trees of an archive then
have the same height.

This is not the default, because splitting alone gives nine in ten trees the same height. Merging
the remainders makes cells of parts that lie apart, and leaf nodes of these cells span the space
between them. server/report/walk/cell_comparison.py compares octrees of
several limits with balanced cells.
"""

import math

import numpy as np
from numpy.typing import NDArray

from ...schemas.archive.voxel import Nodes


def tree_height(cell_points: int, leaf: int, degree: int) -> int:
    """Return the height, in levels below the root, whose trees hold nearest to `cell_points`."""
    return max(0, round(math.log(max(1.0, cell_points / leaf), degree)))


def tree_limits(cell_points: int, leaf: int, degree: int) -> tuple[int, int]:
    """Return the fewest and most points of a cell for which all packed trees have the same height.

    The height is that of `tree_height`.
    """
    height = tree_height(cell_points, leaf, degree)
    return (leaf * degree ** (height - 1) + 1 if height else 1), leaf * degree**height


def packed_heights(points: NDArray[np.int64], leaf: int, degree: int) -> NDArray[np.int64]:
    """Return the heights (c,) of packed trees of `points` (c,) points each, in levels below the root."""
    heights, most = np.zeros(len(points), np.int64), leaf
    while (more := points > most).any():
        heights += more
        most *= degree
    return heights


def raise_trees(
    nodes: Nodes, rows: NDArray[np.int64], levels: NDArray[np.int64]
) -> tuple[Nodes, NDArray[np.int64]]:
    """Put chains of nodes with one child above the roots of trees.

    nodes: m nodes of c trees, tree by tree from its root.  rows: (c + 1,), first node of each tree.
    levels: (c,) number of nodes to put above each root; each bounds the same points as the root.
    Return the nodes and their rows.
    """
    times = np.ones(len(nodes.count), np.int64)
    times[rows[:-1]] += levels
    raised = Nodes._make(np.repeat(column, times, axis=0) for column in nodes)
    moved = np.concatenate([[0], np.cumsum(np.diff(rows) + levels)])
    above = np.repeat(moved[:-1] - (np.cumsum(levels) - levels), levels) + np.arange(int(levels.sum()))
    raised.count[above] = 1
    raised.axis[above] = 0
    raised.block_low[above] = 0
    return raised, moved


def balance_cells(
    codes: NDArray[np.uint64], root_log2: int, largest_log2: int, fewest: int, most: int
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.uint8]]:
    """Cut sorted points into cells of `fewest` to `most` points.

    The edge of a cell's cube is at most 2^largest_log2 steps.
    codes: (n,) uint64 sorted Morton codes of points in [0, 2^root_log2), n >= 1.

    Return the order of the points (n,) and, for each cell, the index of its first point in that
    order and the log2 of its cube's edge. A cell has fewer than `fewest` points only if its largest
    permitted cube has fewer, or if fewest > most / 2 (degree 2) permits no other cut.
    """
    balance = _Balance(codes, largest_log2, fewest, most)
    # Empty if the root cube is larger than the largest permitted cube.
    rest = balance.build_cells(0, len(codes), root_log2)
    balance.absorb_remainder(rest, 0, root_log2)
    order = np.concatenate([points for points, _ in balance.cells])
    sizes = [len(points) for points, _ in balance.cells]
    starts = np.concatenate([[0], np.cumsum(sizes)[:-1]]).astype(np.int64)
    return order, starts, np.array([log2 for _, log2 in balance.cells], np.uint8)


class _Balance:
    """Builder of balanced cells.

    cells: the cells made so far; each has the ranks of its points, ascending, and the log2 of its
    cube's edge.
    """

    def __init__(self, codes: NDArray[np.uint64], largest: int, fewest: int, most: int) -> None:
        self.codes, self.largest, self.fewest, self.most = codes, largest, fewest, most
        self.cells: list[tuple[NDArray[np.int64], int]] = []

    def build_cells(self, begin: int, end: int, log2: int) -> NDArray[np.int64]:
        """Make cells of the cube that holds the points [begin, end).

        Return the ranks of the remaining points, too few for a cell.
        """
        if log2 <= self.largest and end - begin <= self.most:
            return self._merge([np.arange(begin, end)], log2)
        if log2 == 0:  # duplicates
            self._cut(np.arange(begin, end), log2)
            return np.arange(0)
        octants = self.codes[begin:end] >> np.uint64(3 * (log2 - 1)) & np.uint64(7)
        edges = begin + np.searchsorted(octants, np.arange(9))
        rests = []
        for a, b in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True):
            if a < b:
                made = len(self.cells)
                rest = self.build_cells(a, b, log2 - 1)
                if log2 - 1 == self.largest:
                    self.absorb_remainder(rest, made, log2 - 1)
                else:
                    rests.append(rest)
        return self._merge(rests, log2)

    def _merge(self, rests: list[NDArray[np.int64]], log2: int) -> NDArray[np.int64]:
        """Make cells from whole remainders, each cell as large as permitted.

        Return the ranks of the remaining points, too few for a cell.
        """
        held: list[NDArray[np.int64]] = []
        for rest in rests:
            if sum(map(len, held)) + len(rest) > self.most:
                self.cells.append((np.concatenate(held), log2))
                held = []
            held.append(rest)
        if sum(map(len, held)) >= self.fewest:
            self.cells.append((np.concatenate(held), log2))
            held = []
        return np.concatenate([np.arange(0), *held])

    def absorb_remainder(self, rest: NDArray[np.int64], first: int, log2: int) -> None:
        """Merge the remainder of a largest cube into the smallest of its cells, `first` onwards."""
        if len(rest) == 0:
            return
        if len(self.cells) > first:
            at = min(range(first, len(self.cells)), key=lambda i: len(self.cells[i][0]))
            rest = np.sort(np.concatenate([self.cells.pop(at)[0], rest]))
        self._cut(rest, log2)

    def _cut(self, points: NDArray[np.int64], log2: int) -> None:
        """Make as few cells as can hold the points, equal in size to within one point."""
        pieces = np.array_split(points, -(-len(points) // self.most))
        self.cells += [(piece, log2) for piece in pieces]
