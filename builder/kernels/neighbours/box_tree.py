"""Nearest boxes of a point: a tree over boxes in their given order, ideally a space-filling curve."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ....schemas.kernels import compiling as nb
from .nearest_points import FAR

# Boxes per box of the next level.
DEGREE = 8
# Differences from here on count as FAR: their squares would overflow.
_MOST = 1 << 31


class BoxTree(NamedTuple):
    """Boxes level by level, up to a single root; each encloses DEGREE boxes of the level below.

    low, high: (t, 3) int64, inclusive corners.
    starts: (levels + 1,) int64, where each level begins; level 0 holds the given boxes.
    """

    low: NDArray[np.int64]
    high: NDArray[np.int64]
    starts: NDArray[np.int64]


def make_box_tree(low: NDArray[np.int64], high: NDArray[np.int64]) -> BoxTree:
    """Build the tree over boxes low, high (v, 3), v >= 1."""
    lows, highs = [low], [high]
    while len(lows[-1]) > 1:
        cuts = np.arange(0, len(lows[-1]), DEGREE)
        lows.append(np.minimum.reduceat(lows[-1], cuts))
        highs.append(np.maximum.reduceat(highs[-1], cuts))
    starts = np.cumsum([0, *map(len, lows)]).astype(np.int64)
    return BoxTree(np.concatenate(lows), np.concatenate(highs), starts)


@nb.njit(nogil=True, inline="always")
def _box_distance2(low, high, box, x, y, z):
    """Return the squared distance of (x, y, z) from a box, at most FAR."""
    gx = max(low[box, 0] - x, x - high[box, 0], 0)
    gy = max(low[box, 1] - y, y - high[box, 1], 0)
    gz = max(low[box, 2] - z, z - high[box, 2], 0)
    if gx >= _MOST or gy >= _MOST or gz >= _MOST:
        return FAR
    # Compare in float64 first: three squares below 2^62 may sum to more than int64 holds.
    if np.float64(gx) * gx + np.float64(gy) * gy + np.float64(gz) * gz > 1.1 * FAR:
        return FAR
    return min(gx * gx + gy * gy + gz * gz, FAR)


@nb.njit(nogil=True, cache=True)
def near_boxes(tree, queries, own, best, after, rows, distances):
    """Find the boxes nearer to each query than best, nearest first; on a tie the first box.

    tree: BoxTree.
    queries: (q, 3) int64.
    own: (q,) int64, a box to exclude.
    best: (q,) int64, squared distances; where it is FAR, only one box is found.
    after: (q, 2) int64, squared distance and number of the last box of the previous call, to
    continue after it; -1, -1 for the first call.
    Writes rows and distances (q, k) int64, with rows -1 after the last, and writes the last box
    found into `after`. Boxes at a distance of FAR or more are not found.
    """
    stack = np.empty((128, 2), np.int64)
    levels = tree.starts.shape[0] - 1
    for q in range(queries.shape[0]):
        x, y, z = queries[q, 0], queries[q, 1], queries[q, 2]
        most = 1 if best[q] >= FAR else rows.shape[1]
        rows[q, :] = -1
        held = 0
        stack[0, 0], stack[0, 1] = levels - 1, 0
        depth = 1
        while depth > 0:
            depth -= 1
            level, item = stack[depth, 0], stack[depth, 1]
            d2 = _box_distance2(tree.low, tree.high, tree.starts[level] + item, x, y, z)
            if d2 >= best[q] or (held == most and d2 > distances[q, held - 1]):
                continue
            if level > 0:
                end = min((item + 1) * DEGREE, tree.starts[level] - tree.starts[level - 1])
                for child in range(item * DEGREE, end):
                    stack[depth, 0], stack[depth, 1] = level - 1, child
                    depth += 1
                continue
            if item == own[q] or d2 < after[q, 0] or (d2 == after[q, 0] and item <= after[q, 1]):
                continue
            at = held
            while at > 0 and (
                distances[q, at - 1] > d2 or (distances[q, at - 1] == d2 and rows[q, at - 1] > item)
            ):
                at -= 1
            if at == most:
                continue
            held = min(held + 1, most)
            for i in range(held - 1, at, -1):
                rows[q, i], distances[q, i] = rows[q, i - 1], distances[q, i - 1]
            rows[q, at], distances[q, at] = item, d2
        if held:
            after[q, 0], after[q, 1] = distances[q, held - 1], rows[q, held - 1]
