"""Pairs in contact as they are found: the deepest pairs, and the cells of scan points they touch.

A pair is a record of integers that determines exactly which of two pairs is deeper, namely the one
with the smaller separation of its spheres. No tree and no order of visits can therefore change the
result. Touched scan points fall into cells of a uniform grid over the lattice. Memory grows with
the cells touched and the pairs listed, never with the pairs found.

Cells that share a face, an edge or a corner belong to one cluster. Clusters are found by union-find
(Tarjan, "Efficiency of a good but not linear set union algorithm", 1975).
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ....schemas.runtime import compiling as nb
from ..core.kernel_decorators import njit_no_refcount
from ..core.node_bounds import U32, ClassThresholds
from ..core.placed_avatar import PlacedAvatar, compare_separations, place_units, square_apart
from ..core.scene_arrays import stopped

# Columns of a record. The first ORDER of them determine which pair is deeper: |a - b|^2 [exact
# units^2], and the largest radius minus that of the scan point [exact units]. Pairs of equal
# separation compare, in turn: scan point x, y, z [lattice], avatar centre x, y, z [exact units],
# row of the avatar's point, scan number.
SQUARE, DEFICIT, POINT, CENTER, ROW, SCAN, ORDER, TAG, RECORD = 0, 1, 2, 5, 8, 9, 10, 10, 11
# A cluster is the record of its deepest pair, then the number of its pairs and the box of its
# touched points. A cell is the same, followed by its place in the grid.
PAIRS, LOW, HIGH, CLUSTER, PLACE, CELL = 11, 12, 15, 18, 18, 21
# Edge of cells of which each holds the points of one scan. Only the deepest pair of each counts then.
BY_SCAN = 0
# Cells moved between two looks at the stop flag: some hundred microseconds.
ROWS_AT_ONCE = 512
# Counters of `ContactState.sizes`: cells, pairs kept, pairs listed, clusters listed, the last cell
# used, depth of the stack, and the pose whose pairs these are (-1: none).
CELLS, KEPT, LISTED, CLUSTERS, LAST, DEPTH, POSE = range(7)


class ContactCells(NamedTuple):
    """Grid cells touched under one pose: an open-addressing hash table.

    table: (c, CELL) int64.
    bound: (c,) float64 [steps]: a pair farther apart, the deficit of its sphere included, is not
    the cell's deepest.
    slots: (s,) int64, s a power of two, rows of `table` or -1; at most half of them are taken.
    """

    table: NDArray[np.int64]
    bound: NDArray[np.float64]
    slots: NDArray[np.int64]


class ContactState(NamedTuple):
    """Results and state of a request, so that it can be resumed; the kernels grow it.

    cells: of the current pose.
    heap: (limit, RECORD) int64, its deepest pairs, the least deep first.
    sizes: (7,) int64, see above.
    stack: (STACK, 2) int64.
    pairs: (p, RECORD), clusters: (c, CLUSTER) int64: those of the finished poses, followed by free
    rows; a pair's TAG is its row among the pose's clusters.
    """

    cells: ContactCells
    heap: NDArray[np.int64]
    sizes: NDArray[np.int64]
    stack: NDArray[np.int64]
    pairs: NDArray[np.int64]
    clusters: NDArray[np.int64]


class ContactOptions(NamedTuple):
    """Parameters of a request, in addition to the poses.

    rows: (b, LANES) int32, the row of the avatar's point in each lane.
    edges: (k,) int64, edge of a cell [steps]; BY_SCAN: a cell holds the points of one scan instead.
    with_scan: whether the arena holds scan numbers.
    limit: number of pairs to list for each pose.
    cells: limit of the table of cells, a power of two.  listed: limit of the lists [bytes].
    """

    rows: NDArray[np.int32]
    edges: NDArray[np.int64]
    with_scan: bool
    limit: int
    cells: int
    listed: int


class ContactScratch(NamedTuple):
    """Scratch of one call.

    placed: the avatar under the pose in hand.  by_class: the pose's thresholds.
    keep: (LANES,) bool.  avatar_lanes: (3, LANES), squares: (LANES,) float32.
    bound: (1,) float64, as in `ContactCells`, of the pairs listed.  error: (1,) float64, that of
    the pose's `Thresholds`.
    record: (1, RECORD) int64.
    """

    placed: PlacedAvatar
    by_class: ClassThresholds
    keep: NDArray[np.bool_]
    avatar_lanes: NDArray[np.float32]
    squares: NDArray[np.float32]
    bound: NDArray[np.float64]
    error: NDArray[np.float64]
    record: NDArray[np.int64]


@njit_no_refcount
def deeper(a, i, b, j):
    """Return whether record a[i] precedes record b[j]: the deeper pair precedes."""
    order = compare_separations(a[i, SQUARE], -a[i, DEFICIT], b[j, SQUARE], -b[j, DEFICIT])
    if order != 0:
        return order < 0
    for c in range(POINT, ORDER):
        if a[i, c] != b[j, c]:
            return a[i, c] < b[j, c]
    return False


@njit_no_refcount
def _swap(rows, i, j):
    for c in range(rows.shape[1]):
        rows[i, c], rows[j, c] = rows[j, c], rows[i, c]


@njit_no_refcount
def _sift_down(rows, n, at):
    """Restore the heap rows[:n], least deep first, below row `at`."""
    while True:
        child = 2 * at + 1
        if child >= n:
            return
        if child + 1 < n and deeper(rows, child, rows, child + 1):
            child += 1
        if not deeper(rows, at, rows, child):
            return
        _swap(rows, at, child)
        at = child


@nb.njit(nogil=True, cache=True)
def sort_rows(rows, n, stop):
    """Sort rows[:n] deepest first, in place (Williams, heapsort), until the stop flag is set."""
    for at in range(n // 2 - 1, -1, -1):
        if stopped(stop):
            return
        _sift_down(rows, n, at)
    for end in range(n - 1, 0, -1):
        if stopped(stop):
            return
        _swap(rows, 0, end)
        _sift_down(rows, end, 0)


@njit_no_refcount
def copy_record(table, row, rows, at):
    """Write the first columns of table[row], as many as `rows` has, to rows[at]."""
    for c in range(rows.shape[1]):
        rows[at, c] = table[row, c]


@njit_no_refcount
def keep_deepest(heap, kept, record):
    """Insert record[0] into the `kept` deepest pairs if it belongs there; return the new number."""
    if kept < heap.shape[0]:
        copy_record(record, 0, heap, kept)
        at = kept
        while at > 0 and deeper(heap, (at - 1) // 2, heap, at):
            _swap(heap, (at - 1) // 2, at)
            at = (at - 1) // 2
        return kept + 1
    if kept > 0 and deeper(record, 0, heap, 0):
        copy_record(record, 0, heap, 0)
        _sift_down(heap, kept, 0)
    return kept


@njit_no_refcount
def bound_after(record, at, units_per_step, error):
    """Return the bound, as in `ContactCells`, set by record[at].

    Every pair that is not deeper lies beyond it, whatever float32 rounds.
    """
    gap = np.sqrt(np.float64(record[at, SQUARE])) + np.float64(record[at, DEFICIT])
    return gap / units_per_step * (1.0 + 2.0 * U32) + error


@njit_no_refcount
def square_below(bound, deficit_steps):
    """Return the float32 square above which no pair with this deficit is within a bound.

    deficit_steps: the deficit [steps]. The counterpart is `far` of make_thresholds.
    """
    above = bound - deficit_steps
    # 8 as there, plus 2 for the rounding to float32: np.nextafter is a call, and this runs for
    # every scan point in contact.
    return np.float32(above * above * (1.0 + 10.0 * U32)) if above >= 0.0 else np.float32(-1.0)


@njit_no_refcount
def listing_bound(heap, kept, units_per_step, error):
    """Return the bound, as in `ContactCells`, of pairs that may be among those listed.

    kept: how many are listed so far.
    """
    if heap.shape[0] == 0:
        return -1.0
    if kept < heap.shape[0]:
        return np.inf
    return bound_after(heap, 0, units_per_step, error)


@nb.njit(nogil=True, cache=True)
def make_cells(count):
    """Allocate `count` cells, a power of two."""
    return ContactCells(np.empty((count, CELL), np.int64), np.empty(count), np.full(2 * count, -1, np.int64))


@njit_no_refcount
def find_slot(cells, x, y, z):
    """Return the slot of cell (x, y, z), or the free slot where it belongs."""
    # 21 bits of each, so that every product fits 63 bits.
    h = ((x & 0x1FFFFF) * 73856093) ^ ((y & 0x1FFFFF) * 19349663) ^ ((z & 0x1FFFFF) * 83492791)
    last = cells.slots.shape[0] - 1
    slot = (h ^ (h >> 19)) & last
    table = cells.table
    while True:
        row = cells.slots[slot]
        if row < 0 or (table[row, PLACE] == x and table[row, PLACE + 1] == y and table[row, PLACE + 2] == z):
            return slot
        slot = (slot + 1) & last


@njit_no_refcount
def cell_of(cells, sizes, record, edge):
    """Return the row of the cell of the record's scan point, or of its scan.

    There must be a free row for a new cell.
    """
    table, last = cells.table, sizes[LAST]
    x, y, z = record[0, POINT], record[0, POINT + 1], record[0, POINT + 2]
    if edge == BY_SCAN:
        x, y, z, edge = record[0, SCAN], 0, 0, 1
    if last >= 0:  # nearly always the last cell, and divisions are slow
        x0, y0, z0 = table[last, PLACE] * edge, table[last, PLACE + 1] * edge, table[last, PLACE + 2] * edge
        if x0 <= x < x0 + edge and y0 <= y < y0 + edge and z0 <= z < z0 + edge:
            return last
    x, y, z = x // edge, y // edge, z // edge
    slot = find_slot(cells, x, y, z)
    cell = cells.slots[slot]
    if cell < 0:
        cell = sizes[CELLS]
        sizes[CELLS] += 1
        cells.slots[slot], cells.bound[cell] = cell, np.inf
        table[cell, PLACE], table[cell, PLACE + 1], table[cell, PLACE + 2] = x, y, z
        # Every pair is deeper than this one, whose root is 2^31.5: a reach plus a deficit is below
        # 2^31.
        table[cell, SQUARE], table[cell, DEFICIT], table[cell, PAIRS] = np.iinfo(np.int64).max, 0, 0
        for r in range(3):
            table[cell, LOW + r], table[cell, HIGH + r] = np.iinfo(np.int64).max, np.iinfo(np.int64).min
    sizes[LAST] = cell
    return cell


@nb.njit(nogil=True, cache=True)
def grow_cells(cells, used, stop):
    """Return the same `used` cells with twice the capacity; those given once the stop flag is set."""
    grown = make_cells(2 * cells.table.shape[0])
    table = grown.table
    table[:used], grown.bound[:used] = cells.table[:used], cells.bound[:used]
    for row in range(used):
        if row % ROWS_AT_ONCE == 0 and stopped(stop):
            return cells
        grown.slots[find_slot(grown, table[row, PLACE], table[row, PLACE + 1], table[row, PLACE + 2])] = row
    return grown


@nb.njit(nogil=True, cache=True)
def empty_cells(cells, used):
    """Remove all `used` cells, in time proportional to them and not to the capacity."""
    table = cells.table
    if 8 * used > cells.slots.shape[0]:  # the slots in order take less time: 3 ms for 2^20 cells, not 240
        cells.slots[:] = -1
        return
    # Last in, first out: the entries between a cell's hash and its slot were inserted before it.
    for row in range(used - 1, -1, -1):
        cells.slots[find_slot(cells, table[row, PLACE], table[row, PLACE + 1], table[row, PLACE + 2])] = -1


@njit_no_refcount
def _measure(avatar, m, block, lane, shift, scene, record):
    """Write |a - b|^2 and the avatar's centre of one pair, exact units, into `record`.

    shift: of PlacedAvatar.  record: holds the scan's point. Returns the square, see `square_apart`.
    """
    center = place_units(avatar.points, m, shift, block, lane)
    point = (record[0, POINT], record[0, POINT + 1], record[0, POINT + 2])
    record[0, CENTER], record[0, CENTER + 1], record[0, CENTER + 2] = center
    record[0, SQUARE] = square_apart(center, point, scene.units_per_step)
    return record[0, SQUARE]


@njit_no_refcount
def gather_point(avatar, m, a, block, scene, own, options, edge, state, scratch):
    """Count the pairs of one scan point with the points of a block.

    The scan point is in scratch.record, the float32 squares of the block's points in
    scratch.squares.
    own: the scan point's radius class. Returns how many are in contact.
    """
    record, squares, listing, rows = scratch.record, scratch.squares, scratch.bound, options.rows
    cells, heap, sizes, per_step = state.cells, state.heap, state.sizes, scene.units_per_step
    table, bounds, error = cells.table, cells.bound, scratch.error[0]
    deficit, units = scene.radius_deficit[own], scratch.by_class.units[own]
    near, far = scratch.by_class.near[own], scratch.by_class.far[own]
    shift, record[0, DEFICIT] = scratch.placed.shift, deficit
    deficit_steps = np.float64(deficit) / per_step
    listed, deepest = square_below(listing[0], deficit_steps), np.float32(np.inf)
    cell, count = np.int64(-1), np.int64(0)
    for lane in range(avatar.count[a]):
        square = squares[lane]
        if square > far:
            continue
        if square > near and not 0 <= _measure(avatar, m, block, lane, shift, scene, record) <= units * units:
            continue
        if cell < 0:
            cell = cell_of(cells, sizes, record, edge)
            deepest = square_below(bounds[cell], deficit_steps)
        count += 1
        if square <= near:
            if square > deepest and square > listed:
                continue
            _measure(avatar, m, block, lane, shift, scene, record)
        record[0, ROW] = rows[block, lane]
        record[0, TAG] = cell
        if deeper(record, 0, table, cell):
            for c in range(ORDER):
                table[cell, c] = record[0, c]
            bounds[cell] = bound_after(record, 0, per_step, error)
            deepest = square_below(bounds[cell], deficit_steps)
        if square <= listed:
            sizes[KEPT] = keep_deepest(heap, sizes[KEPT], record)
            listing[0] = listing_bound(heap, sizes[KEPT], per_step, error)
            listed = square_below(listing[0], deficit_steps)
    if count > 0:
        table[cell, PAIRS] += count
        for r in range(3):
            table[cell, LOW + r] = min(table[cell, LOW + r], record[0, POINT + r])
            table[cell, HIGH + r] = max(table[cell, HIGH + r], record[0, POINT + r])
    return count


@nb.njit(nogil=True, cache=True)
def _root(parent, row):
    while parent[row] != row:
        parent[row] = parent[parent[row]]
        row = parent[row]
    return row


@nb.njit(nogil=True, cache=True)
def _join_neighbours(cells, used, parent, stop):
    """Fill parent (used,) by union-find over cells that share a face, an edge or a corner.

    Ends early once the stop flag is set.
    """
    table = cells.table
    for row in range(used):
        parent[row] = row
    for row in range(used):
        if stopped(stop):
            return
        # 13 of the 26 neighbours: of two neighbouring cells, only one looks for the other.
        for n in range(14, 27):
            x, y = table[row, PLACE] + n // 9 - 1, table[row, PLACE + 1] + n // 3 % 3 - 1
            other = cells.slots[find_slot(cells, x, y, table[row, PLACE + 2] + n % 3 - 1)]
            if other >= 0:
                a, b = _root(parent, row), _root(parent, other)
                parent[max(a, b)] = min(a, b)


@nb.njit(nogil=True, cache=True)
def _with_capacity(rows, used, more):
    """Return `rows` with space for `more` rows after the used ones."""
    if used + more <= rows.shape[0]:
        return rows
    grown = np.empty((2 * (used + more), rows.shape[1]), np.int64)
    grown[:used] = rows[:used]
    return grown


@nb.njit(nogil=True, cache=True)
def list_pose(state, runs, stop):
    """List the pairs and clusters of the current pose, deepest first, and remove its cells.

    Writes runs (4,) int64: first pair, number of pairs, first cluster, number of clusters. Returns
    the state, whose lists may have grown. When the stop flag (1,) is set, the pose has no pairs and
    no clusters.
    """
    cells, heap, sizes = state.cells, state.heap, state.sizes
    table, used, kept = cells.table, sizes[CELLS], sizes[KEPT]
    parent, found = np.empty(used, np.int64), 0
    _join_neighbours(cells, used, parent, stop)
    for row in range(used):
        found += 1 if parent[row] == row else 0
    clusters = _with_capacity(state.clusters, sizes[CLUSTERS], found)
    own = clusters[sizes[CLUSTERS] :]
    rank, at = np.empty(used, np.int64), 0
    for row in range(used):  # a root precedes all rows below it
        root = _root(parent, row)
        if root == row:
            copy_record(table, row, own, at)
            own[at, TAG] = row
            rank[row] = at
            at += 1
            continue
        mine = rank[root]
        if deeper(table, row, own, mine):
            for c in range(ORDER):
                own[mine, c] = table[row, c]
        own[mine, PAIRS] += table[row, PAIRS]
        for r in range(3):
            own[mine, LOW + r] = min(own[mine, LOW + r], table[row, LOW + r])
            own[mine, HIGH + r] = max(own[mine, HIGH + r], table[row, HIGH + r])
    sort_rows(own, found, stop)
    for at in range(found):
        rank[own[at, TAG]] = at
    sort_rows(heap, kept, stop)
    pairs = _with_capacity(state.pairs, sizes[LISTED], kept)
    if stopped(stop):  # the rows may be in any order
        kept, found = 0, 0
    for i in range(kept):
        copy_record(heap, i, pairs, sizes[LISTED] + i)
        pairs[sizes[LISTED] + i, TAG] = rank[_root(parent, heap[i, TAG])]
    runs[0], runs[1], runs[2], runs[3] = sizes[LISTED], kept, sizes[CLUSTERS], found
    sizes[LISTED] += kept
    sizes[CLUSTERS] += found
    empty_cells(cells, used)
    sizes[CELLS], sizes[KEPT], sizes[LAST], sizes[POSE] = 0, 0, -1, -1
    return ContactState(cells, heap, sizes, state.stack, pairs, clusters)
