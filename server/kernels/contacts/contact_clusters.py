"""Clusters of touched cells: cells that share a face, an edge or a corner belong to one cluster.

They are found by union-find (Tarjan, "Efficiency of a good but not linear set union algorithm",
1975).
"""

import numpy as np

from ....schemas.kernels import compiling as nb
from ..core.scene_arrays import copy_rows, stopped
from .contact_cells import (
    CELLS,
    CLUSTER,
    CLUSTERS,
    HIGH,
    KEPT,
    LAST,
    LISTED,
    LOW,
    ORDER,
    PAIRS,
    PLACE,
    POSE,
    TAG,
    ContactState,
    deeper,
    empty_cells,
    find_slot,
    sort_rows,
)


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
            slot = find_slot(
                cells,
                table[row, PLACE] + n // 9 - 1,
                table[row, PLACE + 1] + n // 3 % 3 - 1,
                table[row, PLACE + 2] + n % 3 - 1,
            )
            other = cells.slots[slot]
            if other >= 0:
                a, b = _root(parent, row), _root(parent, other)
                parent[max(a, b)] = min(a, b)


@nb.njit(nogil=True, cache=True)
def _with_capacity(rows, used, more, stop):
    """Return `rows` with space for `more` rows after the used ones.

    Returns the rows unchanged once the stop flag is set.
    """
    if used + more <= rows.shape[0]:
        return rows
    grown = np.empty((2 * (used + more), rows.shape[1]), np.int64)
    copy_rows(rows, grown, used, stop)
    return rows if stopped(stop) else grown


@nb.njit(nogil=True, cache=True)
def list_pose(state, runs, stop):
    """List the pairs and clusters of the current pose, deepest first, and remove its cells.

    Writes runs (4,) int64: first pair, number of pairs, first cluster, number of clusters. Returns
    the state, whose lists may have grown. When the stop flag (1,) is set, the pose has no pairs and
    no clusters, and the state must not be used for further poses.
    """
    cells, heap, sizes = state.cells, state.heap, state.sizes
    table, used, kept = cells.table, sizes[CELLS], sizes[KEPT]
    parent, found = np.empty(used, np.int64), 0
    _join_neighbours(cells, used, parent, stop)
    for row in range(used):
        found += 1 if parent[row] == row else 0
    clusters = _with_capacity(state.clusters, sizes[CLUSTERS], found, stop)
    own = clusters[sizes[CLUSTERS] :]
    rank, at = np.empty(used, np.int64), 0
    for row in range(used):  # a root precedes all rows below it
        if stopped(stop):  # there may then be too few rows
            break
        root = _root(parent, row)
        if root == row:
            own[at] = table[row, :CLUSTER]
            own[at, TAG] = row
            rank[row] = at
            at += 1
            continue
        mine = rank[root]
        if deeper(table, row, own, mine):
            own[mine, :ORDER] = table[row, :ORDER]
        own[mine, PAIRS] += table[row, PAIRS]
        for r in range(3):
            own[mine, LOW + r] = min(own[mine, LOW + r], table[row, LOW + r])
            own[mine, HIGH + r] = max(own[mine, HIGH + r], table[row, HIGH + r])
    sort_rows(own, found, stop)
    if not stopped(stop):
        for at in range(found):
            rank[own[at, TAG]] = at
    sort_rows(heap, kept, stop)
    pairs = _with_capacity(state.pairs, sizes[LISTED], kept, stop)
    if stopped(stop):  # the rows above may be in any order
        runs[0], runs[1], runs[2], runs[3] = sizes[LISTED], 0, sizes[CLUSTERS], 0
        sizes[CELLS], sizes[KEPT], sizes[LAST], sizes[POSE] = 0, 0, -1, -1
        return ContactState(cells, heap, sizes, state.stack, pairs, clusters)
    for i in range(kept):
        pairs[sizes[LISTED] + i] = heap[i]
        pairs[sizes[LISTED] + i, TAG] = rank[_root(parent, heap[i, TAG])]
    runs[0], runs[1], runs[2], runs[3] = sizes[LISTED], kept, sizes[CLUSTERS], found
    sizes[LISTED] += kept
    sizes[CLUSTERS] += found
    empty_cells(cells, used, stop)
    sizes[CELLS], sizes[KEPT], sizes[LAST], sizes[POSE] = 0, 0, -1, -1
    return ContactState(cells, heap, sizes, state.stack, pairs, clusters)
