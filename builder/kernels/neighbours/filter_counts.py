"""Kernels of the filter stage: number of points or scans near each point, best point of a cell.

All arithmetic is in integers. Positions are int32 lattice steps from a corner chosen to make all of
them non-negative. Points are sorted by the grid cell they are in, with cells numbered by
`cell_numbers`. The cell edge is the search distance: all points near a point are in its own cell
and the 26 around it, nine runs of three cells.
"""

import numpy as np

from ....schemas.runtime import compiling as nb
from ..points.octree_cells import first_at_least


@nb.njit(nogil=True, cache=True)
def cell_numbers(positions, edge, across, deep):
    """Return the cell (n,) uint64 of positions (n, 3) int32 >= 0 [steps].

    edge: of a cell [steps].
    across, deep: number of cells along y and z, two more than any position needs: cells are
    numbered from 1 on each axis, and every cell has a neighbour below and above.
    """
    n = positions.shape[0]
    cells = np.empty(n, np.uint64)
    for i in range(n):
        x = np.uint64(positions[i, 0] // edge + 1)
        y = np.uint64(positions[i, 1] // edge + 1)
        z = np.uint64(positions[i, 2] // edge + 1)
        cells[i] = (x * np.uint64(across) + y) * np.uint64(deep) + z
    return cells


@nb.njit(nogil=True, cache=True)
def _no_runs():
    """Allocate the result of `_runs_around`: cell, begins, ends. No cell has the number 0."""
    return np.zeros(1, np.uint64), np.empty(9, np.int64), np.empty(9, np.int64)


@nb.njit(nogil=True, cache=True)
def _runs_around(cells, cell, across, deep, runs):
    """Write the cells around a cell, as nine runs in sorted `cells`, to runs; the central run first.

    Does nothing where runs (`_no_runs`) already holds those of this cell: queries come cell by
    cell.
    """
    known, begins, ends = runs
    if known[0] == cell:
        return
    known[0] = cell
    n = cells.shape[0]
    k = 0
    for turn in range(2):
        for dx in range(-1, 2):
            for dy in range(-1, 2):
                middle = dx == 0 and dy == 0
                if middle == (turn == 0):
                    # dx and dy may be negative: unsigned sums modulo 2^64 give the right result.
                    shift = np.uint64(np.int64(dx) * np.int64(across * deep) + np.int64(dy) * np.int64(deep))
                    at = cell + shift
                    begins[k] = first_at_least(cells, 0, n, at - np.uint64(1))
                    ends[k] = first_at_least(cells, 0, n, at + np.uint64(2))
                    k += 1


@nb.njit(nogil=True, cache=True)
def count_others(queries, query_cells, points, cells, across, deep, reach2, most, counts):
    """Count up to `most` points within reach of each query, without points equal to the query.

    queries: (q, 3) int32.
    query_cells: (q,) uint64.
    points: (n, 3) int32, distinct, in the order of their cells.
    cells: (n,) uint64, ascending.
    reach2: square of the reach [steps^2], inclusive.
    counts: (q,) int64, increased; a query that has reached `most` is skipped.
    """
    runs = _no_runs()
    begins, ends = runs[1], runs[2]
    for i in range(queries.shape[0]):
        if counts[i] >= most:
            continue
        _runs_around(cells, query_cells[i], across, deep, runs)
        x, y, z = np.int64(queries[i, 0]), np.int64(queries[i, 1]), np.int64(queries[i, 2])
        found = counts[i]
        for k in range(9):
            for j in range(begins[k], ends[k]):
                dx, dy, dz = points[j, 0] - x, points[j, 1] - y, points[j, 2] - z
                d2 = dx * dx + dy * dy + dz * dz
                if 0 < d2 <= reach2:
                    found += 1
                    if found >= most:
                        break
            if found >= most:
                break
        counts[i] = found


@nb.njit(nogil=True, cache=True)
def _has(row, count, value):
    """Return whether one of the first `count` entries of a row is value."""
    for k in range(count):  # noqa: SIM110  numba has no any() of a generator
        if row[k] == value:
            return True
    return False


@nb.njit(nogil=True, cache=True)
def _group_in_reach(points, begin, end, low, high, x, y, z, reach2):
    """Return whether one of points[begin:end] lies within reach of x, y, z.

    low, high: (3,), the bounding box of these points.
    """
    least, most = np.int64(0), np.int64(0)
    for axis in range(3):
        q = x if axis == 0 else (y if axis == 1 else z)
        below, above = np.int64(low[axis]) - q, q - np.int64(high[axis])
        out = max(below, above, np.int64(0))
        far = max(-below, -above)  # to the box's far side, also for a q outside the box
        least += out * out
        most += far * far
    if least > reach2:
        return False
    if most <= reach2:
        return True
    for j in range(begin, end):
        dx, dy, dz = points[j, 0] - x, points[j, 1] - y, points[j, 2] - z
        if dx * dx + dy * dy + dz * dz <= reach2:
            return True
    return False


@nb.njit(nogil=True, cache=True)
def other_scans(
    queries, query_cells, query_scans, points, groups, group_cells, group_scans, across, deep, reach2, found,
    counts,
):  # fmt: skip
    """Find other scans with a point within reach of each query, up to the capacity of `found`.

    queries: (q, 3) int32.
    query_cells: (q,) uint64.
    query_scans: (q,) int64.
    points: (n, 3) int32 in the order of their groups; a group is the points of one scan in one
    cell.
    groups: (g + 1,) int64, where each group begins, ordered by cell.
    group_cells: (g,) uint64.
    group_scans: (g,) int64.
    reach2: inclusive [steps^2].
    found: (q, most) int64, the scans found so far, the first counts[i] of row i.
    counts: (q,) int64.
    Adds to both found and counts.
    """
    most = found.shape[1]
    count = group_scans.shape[0]
    low, high = np.empty((count, 3), np.int32), np.empty((count, 3), np.int32)
    for g in range(count):
        for axis in range(3):
            low[g, axis] = high[g, axis] = points[groups[g], axis]
            for j in range(groups[g], groups[g + 1]):
                low[g, axis] = min(low[g, axis], points[j, axis])
                high[g, axis] = max(high[g, axis], points[j, axis])
    runs = _no_runs()
    begins, ends = runs[1], runs[2]
    for i in range(queries.shape[0]):
        if counts[i] >= most:
            continue
        _runs_around(group_cells, query_cells[i], across, deep, runs)
        x, y, z = np.int64(queries[i, 0]), np.int64(queries[i, 1]), np.int64(queries[i, 2])
        for k in range(9):
            for g in range(begins[k], ends[k]):
                scan = group_scans[g]
                if counts[i] >= most or scan == query_scans[i] or _has(found[i], counts[i], scan):
                    continue
                if _group_in_reach(points, groups[g], groups[g + 1], low[g], high[g], x, y, z, reach2):
                    found[i, counts[i]] = scan
                    counts[i] += 1


@nb.njit(nogil=True, cache=True)
def best_of_cells(order, cells, away, ranks, scans, intensities, looks):
    """Return the index of the best point of each cell: (c,) int64, cells ascending.

    order: (n,) int64, n >= 1, sorts the points by cell.
    cells: (n,) uint64.
    away: (n,) int64.
    ranks: (n,) uint64.
    scans: (n,) int64.
    intensities: (n,) float32.
    looks: (n,) uint32.
    The least away is best, then the least rank, scan, intensity, NaN last, and look; of equals the
    first in `order`.
    """
    n = order.shape[0]
    best = np.empty(n, np.int64)
    count = 0
    held = order[0]
    for k in range(1, n):
        i = order[k]
        if cells[i] != cells[held]:
            best[count] = held
            count += 1
            held = i
        elif away[i] != away[held]:
            if away[i] < away[held]:
                held = i
        elif ranks[i] != ranks[held]:
            if ranks[i] < ranks[held]:
                held = i
        elif scans[i] != scans[held]:
            if scans[i] < scans[held]:
                held = i
        elif intensities[i] < intensities[held] or (
            np.isnan(intensities[held]) and not np.isnan(intensities[i])
        ):
            held = i
        elif intensities[i] > intensities[held] or (
            np.isnan(intensities[i]) and not np.isnan(intensities[held])
        ):
            continue
        elif looks[i] < looks[held]:
            held = i
    best[count] = held
    return best[: count + 1].copy()
