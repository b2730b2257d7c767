"""Representatives of a voxel's points, one for each leaf node, and bounds of all that they stand for."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ....schemas.kernels.record_rows import LANES
from ....schemas.runtime import compiling as nb
from .voxel_records import U, read_leaf


class Runs(NamedTuple):
    """Runs of points in the leaf nodes of a record, each with its representative; r of them.

    xyz: (r, 3) int32, the representative [voxel steps].  classes: (r,) uint8, its cover class.
    node: (r,) int32, the leaf node.  begin, end: (r,) uint8, the run in the leaf node.
    chosen: (r,) uint8, the place of the representative in the leaf node.
    """

    xyz: NDArray[np.int32]
    classes: NDArray[np.uint8]
    node: NDArray[np.int32]
    begin: NDArray[np.uint8]
    end: NDArray[np.uint8]
    chosen: NDArray[np.uint8]


def empty_runs(count: int) -> Runs:
    """Return arrays for `count` runs."""
    return Runs(
        np.empty((count, 3), np.int32),
        np.empty(count, np.uint8),
        np.empty(count, np.int32),
        np.empty(count, np.uint8),
        np.empty(count, np.uint8),
        np.empty(count, np.uint8),
    )


@nb.njit(nogil=True, cache=True)
def choose_representatives(leaves, squares, runs):
    """Write the runs of all leaf nodes and their representatives; return the number of runs.

    Return -1 if `runs` has no room for all; there are at most as many as points.

    leaves: of a checked record.  squares: (c,) int64, ascending, the greatest squared distance
    within the cover radius of each class [steps].
    The run of a leaf node is all its points, and its representative is the point nearest the middle
    of the box around them, the first of equals. If some are farther from it than the largest cover
    radius, the points are divided in their stored order: the first one represents those that
    follow, up to one that is too far away, with which the next run begins.
    """
    lanes = np.empty((3, LANES), np.int32)
    corner, middle = np.empty(3, np.int64), np.empty(3, np.int64)
    found, largest, room = 0, squares[squares.shape[0] - 1], runs.node.shape[0]
    for i in range(U(leaves.first.shape[0])):
        if not leaves.is_leaf[i]:
            continue
        held, cell = np.int64(read_leaf(leaves, i, lanes)), U(leaves.cell[i])
        if found + held > room:
            return -1
        for k in range(U(3)):
            corner[k] = np.int64(leaves.cell_low[k, cell]) + np.int64(leaves.block_low[k, i])
            middle[k] = _twice_middle(lanes[k], held)
        chosen, least = 0, np.int64(-1)
        for j in range(held):
            square = np.int64(0)
            for k in range(3):
                apart = 2 * np.int64(lanes[k, j]) - middle[k]
                square += apart * apart
            if least < 0 or square < least:
                chosen, least = j, square
        farthest = np.int64(0)
        for j in range(held):
            farthest = max(farthest, _square(lanes, chosen, j))
        if farthest <= largest:
            _put(runs, found, lanes, chosen, corner, np.int64(i), 0, held, farthest, squares)
            found += 1
            continue
        first, farthest = 0, np.int64(0)
        for j in range(held):
            square = _square(lanes, first, j)
            if square > largest:
                _put(runs, found, lanes, first, corner, np.int64(i), first, j, farthest, squares)
                found += 1
                first, farthest = j, np.int64(0)
            else:
                farthest = max(farthest, square)
        _put(runs, found, lanes, first, corner, np.int64(i), first, held, farthest, squares)
        found += 1
    return found


@nb.njit(nogil=True, cache=True)
def _twice_middle(numbers, count):
    """Return the sum of the least and the greatest of the first `count` numbers, int64."""
    low, high = np.int64(numbers[0]), np.int64(numbers[0])
    for j in range(count):
        low, high = min(low, np.int64(numbers[j])), max(high, np.int64(numbers[j]))
    return low + high


@nb.njit(nogil=True, cache=True)
def _square(lanes, i, j):
    """Return the squared distance between two points of a leaf node [steps], int64."""
    square = np.int64(0)
    for k in range(3):
        apart = np.int64(lanes[k, j]) - np.int64(lanes[k, i])
        square += apart * apart
    return square


@nb.njit(nogil=True, cache=True)
def _put(runs, at, lanes, chosen, corner, node, begin, end, farthest, squares):
    """Write run number `at`: the points [begin, end) of a leaf node, represented by point `chosen`.

    corner: (3,) int64, of the leaf node's box [voxel steps].  farthest: greatest squared distance of
    the run from the representative, at most the last of `squares`.
    """
    own = 0
    while squares[own] < farthest:
        own += 1
    for k in range(3):
        runs.xyz[at, k] = np.int32(corner[k] + np.int64(lanes[k, chosen]))
    runs.classes[at], runs.node[at] = np.uint8(own), np.int32(node)
    runs.begin[at], runs.end[at], runs.chosen[at] = np.uint8(begin), np.uint8(end), np.uint8(chosen)


@nb.njit(nogil=True, cache=True)
def enclose_runs(leaves, runs, above, parents, centers, normals, reach2, slab):
    """Enlarge the bounds of a level's nodes until they enclose the points of the runs below them.

    leaves: of the record that the runs are of.  above: (r,) int32, the level's leaf node above the
    representative of each run.  parents: (n,) int32, of the level's nodes, -1 for the root.
    centers: (n, 3) int64 [voxel steps].  normals: (n, 3) int64.
    reach2: (n,) int64, squared radius, and slab: (n, 2) int64, as in schemas/archive/voxel.py
    `Nodes`, in steps; both are changed.
    """
    lanes, corner = np.empty((3, LANES), np.int32), np.empty(3, np.int64)
    last = np.int32(-1)
    for r in range(runs.node.shape[0]):
        i = U(runs.node[r])
        if runs.node[r] != last:
            read_leaf(leaves, i, lanes)
            last = runs.node[r]
            cell = U(leaves.cell[i])
            for k in range(U(3)):
                corner[k] = np.int64(leaves.cell_low[k, cell]) + np.int64(leaves.block_low[k, i])
        begin, end = np.int64(runs.begin[r]), np.int64(runs.end[r])
        node = np.int64(above[r])
        while node >= 0:
            x, y, z = corner[0] - centers[node, 0], corner[1] - centers[node, 1], corner[2] - centers[node, 2]
            u, v, w = normals[node, 0], normals[node, 1], normals[node, 2]
            farthest, low, high = reach2[node], slab[node, 0], slab[node, 1]
            for j in range(begin, end):
                a, b, c = x + lanes[0, j], y + lanes[1, j], z + lanes[2, j]
                along = u * a + v * b + w * c
                farthest = max(farthest, a * a + b * b + c * c)
                low, high = min(low, along), max(high, along)
            reach2[node], slab[node, 0], slab[node, 1] = farthest, low, high
            node = np.int64(parents[node])
