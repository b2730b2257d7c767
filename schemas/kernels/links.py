"""Positions of the children of a voxel's nodes: derived from counts alone, and checked on the way."""

from . import compiling as nb


@nb.njit(nogil=True, cache=True)
def _walk(count, total, root, rest, first, is_leaf, cell_of, cell, point, leaves_are_cells):
    """Walk one BSH level by level and fill in its rows.

    Row k of the BSH is `root` for k = 0, else `rest + k - 1`. A level's children are the next
    level. The children of the last level are points from `point` on or, with leaves_are_cells, the
    rows directly after the BSH.
    Returns (levels, items below the last level), or (-1, row) at a node with an impossible count.
    """
    done, size, levels, child = 0, 1, 0, rest
    while True:
        last = done + size == total
        below = 0
        for k in range(done, done + size):
            row = root if k == 0 else rest + k - 1
            if count[row] == 0:
                return -1, row
            cell_of[row] = cell
            if last and not leaves_are_cells:
                is_leaf[row] = True
                first[row] = point + below
            else:
                first[row] = child
                child += int(count[row])
            below += int(count[row])
        done += size
        levels += 1
        if last:
            return levels, below
        if below > total - done:
            return -1, root if done == 1 else rest + done - 2
        size = below


@nb.njit(nogil=True, cache=True)
def link_rows(count, cell_nodes, cell_points, first, is_leaf, cell_of):
    """Fill first, is_leaf and cell_of (n,) of a voxel from its counts.

    schemas/archive/voxel.py defines the node order.
    count: (n,) uint8.
    cell_nodes, cell_points: (c,) uint32, c >= 1, each >= 1; cell_nodes sum to at most n.
    Returns the height in levels, root to leaf; or -1 - row for the first row whose counts do not
    form a tree.
    """
    c = cell_nodes.shape[0]
    top = count.shape[0]
    for i in range(c):
        top -= int(cell_nodes[i])
    top_levels = 0
    if top > 0:
        top_levels, below = _walk(count, top, 0, 1, first, is_leaf, cell_of, -1, 0, True)
        if top_levels < 0:
            return -1 - below
        if below != c:
            return -top
    rest, point, height = top + c, 0, 0
    for i in range(c):
        levels, below = _walk(
            count, int(cell_nodes[i]), top + i, rest, first, is_leaf, cell_of, i, point, False
        )
        if levels < 0:
            return -1 - below
        if below != cell_points[i]:
            return -1 - (top + i)
        rest += int(cell_nodes[i]) - 1
        point += int(cell_points[i])
        height = max(height, levels)
    return top_levels + height
