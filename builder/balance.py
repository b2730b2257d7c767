"""Octree cells split and merged until all their hierarchies have one height: the future work of [Fig12], section 8.

"We also would like to design a bounding sphere hierarchy for the partitions that distributes the point sets among
different partitions in order to make the trees of the complete data model with the same heights." A packed tree of
degree m over leaf nodes of l points has height h exactly when it holds l m^(h-1) + 1 to l m^h points. So cells above
that are split, as in any octree, and what lies below it is merged with its siblings' rest, in the cube of their parent,
up to the largest cube that a cell may be. A cell is then still an aligned cube around its points, but cubes may nest.

Not the default: splitting alone gives nine trees in ten one height, and merging the rest makes cells of parts that lie
apart, whose leaf nodes reach across the gap. server/report/cells.py compares the three.
"""

import math

import numpy as np
from numpy.typing import NDArray


def tree_limits(cell_points: int, leaf: int, degree: int) -> tuple[int, int]:
    """Fewest and most points of a cell, such that all trees have one height: the one nearest to `cell_points`."""
    height = max(0, round(math.log(max(1.0, cell_points / leaf), degree)))
    return (leaf * degree ** (height - 1) + 1 if height else 1), leaf * degree**height


def balance_cells(
    codes: NDArray[np.uint64], root_log2: int, largest_log2: int, fewest: int, most: int
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.uint8]]:
    """Cut sorted points into cells of `fewest` to `most` points, in cubes of at most 2^largest_log2 steps.

    codes: (n,) uint64 sorted Morton codes of points in [0, 2^root_log2), n >= 1. Returns the order of the points
    (n,), and for every cell its first point in that order and the log2 of its cube's edge. A cell has fewer points
    only where a largest cube has, or where fewest > most / 2 (degree 2) leaves no other cut.
    """
    balance = _Balance(codes, largest_log2, fewest, most)
    balance.settle(balance.rest_of(0, len(codes), root_log2), 0, root_log2)  # nothing, above the largest cube
    order = np.concatenate([points for points, _ in balance.cells])
    sizes = [len(points) for points, _ in balance.cells]
    starts = np.concatenate([[0], np.cumsum(sizes)[:-1]]).astype(np.int64)
    return order, starts, np.array([log2 for _, log2 in balance.cells], np.uint8)


class _Balance:
    """The cells made so far: the ranks of their points, ascending, and the log2 of their cube's edge."""

    def __init__(self, codes: NDArray[np.uint64], largest: int, fewest: int, most: int) -> None:
        self.codes, self.largest, self.fewest, self.most = codes, largest, fewest, most
        self.cells: list[tuple[NDArray[np.int64], int]] = []

    def rest_of(self, begin: int, end: int, log2: int) -> NDArray[np.int64]:
        """Make cells of the cube that holds the points [begin, end); returns what is left, too few for one."""
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
                rest = self.rest_of(a, b, log2 - 1)
                if log2 - 1 == self.largest:
                    self.settle(rest, made, log2 - 1)
                else:
                    rests.append(rest)
        return self._merge(rests, log2)

    def _merge(self, rests: list[NDArray[np.int64]], log2: int) -> NDArray[np.int64]:
        """Make cells of whole rests, each as large as may be; returns what is left, too few for one."""
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

    def settle(self, rest: NDArray[np.int64], first: int, log2: int) -> None:
        """Put the rest of a cube that cannot grow into the smallest of its cells, those from `first` on."""
        if len(rest) == 0:
            return
        if len(self.cells) > first:
            at = min(range(first, len(self.cells)), key=lambda i: len(self.cells[i][0]))
            rest = np.sort(np.concatenate([self.cells.pop(at)[0], rest]))
        self._cut(rest, log2)

    def _cut(self, points: NDArray[np.int64], log2: int) -> None:
        """Make as few cells as hold the points, equal to within one point."""
        pieces = np.array_split(points, -(-len(points) // self.most))
        self.cells += [(piece, log2) for piece in pieces]
