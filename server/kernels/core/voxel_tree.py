"""Lists of the voxels that rays and query points reach, nearest first, from the index alone.

No voxel is read. The rows of the index are in Morton order; a tree of boxes over them therefore
groups FAN consecutive rows at a time. An entry of a list carries `near`, a lower bound of the
distance to any point of that voxel. It serves pruning only and never decides an answer.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ....schemas.kernels import compiling as nb
from .scene_arrays import ROWS_AT_ONCE, stopped

FAN = 8
# On each level, FAN - 1 siblings stay on the stack; 2^63 rows have 21 levels.
STACK = 22 * FAN


class VoxelTree(NamedTuple):
    """Boxes over the v voxels of an index, level by level, beginning with the voxels themselves.

    low, high: (n, 3) float64 [steps].  levels: (l + 1,) int64, the start of each level; the last
    level is one box.
    unknown: (u, 2, 3) float64 [steps], boxes of excluded scans.
    """

    low: NDArray[np.float64]
    high: NDArray[np.float64]
    levels: NDArray[np.int64]
    unknown: NDArray[np.float64]


class VoxelLists(NamedTuple):
    """Voxels that k rays or points reach, for each of them by ascending `near`.

    starts: (k + 1,) int64: the entries of i are [starts[i], starts[i + 1]).  rows: int64, index
    rows.
    near: float64, exact units, a lower bound of the distance of any hit in that voxel.
    unseen: (k,) float64, exact units, the same bound for the nearest region that cannot be
    examined; inf where there is no such region.
    """

    starts: NDArray[np.int64]
    rows: NDArray[np.int64]
    near: NDArray[np.float64]
    unseen: NDArray[np.float64]


def make_voxel_tree(low: NDArray[np.int64], high: NDArray[np.int64], unknown: NDArray[np.int64]) -> VoxelTree:
    """Build the tree over voxels whose points lie in the boxes low, high (v, 3) [steps].

    Rows are in Morton order.
    """
    lows, highs = [low.astype(np.float64)], [high.astype(np.float64)]
    while len(lows[-1]) > 1:
        groups = np.arange(0, len(lows[-1]), FAN)
        lows.append(np.minimum.reduceat(lows[-1], groups))
        highs.append(np.maximum.reduceat(highs[-1], groups))
    levels = np.cumsum([0, *map(len, lows)])
    return VoxelTree(np.concatenate(lows), np.concatenate(highs), levels, unknown.astype(np.float64))


@nb.njit(nogil=True, cache=True)
def tighten(tree, row, low, high):
    """Shrink the box of one voxel and the boxes that contain it, except the box of the whole scene.

    low, high: (3,) int64 [steps], inside the voxel's box. A thread that reads the tree at the same
    time reads boxes that contain the points. The box of the whole scene stays as it is, and with it
    the slack of `list_voxels`.
    """
    for r in range(3):
        tree.low[row, r], tree.high[row, r] = low[r], high[r]
    number = row
    for level in range(1, tree.levels.shape[0] - 2):
        number //= FAN
        begin = tree.levels[level - 1] + number * FAN
        end = min(begin + FAN, tree.levels[level])
        for r in range(3):
            least, most = np.inf, -np.inf
            for child in range(begin, end):
                least, most = min(least, tree.low[child, r]), max(most, tree.high[child, r])
            tree.low[tree.levels[level] + number, r] = least
            tree.high[tree.levels[level] + number, r] = most


@nb.njit(nogil=True, cache=True)
def _enter(at, direction, low, high, grow, limit):
    """Return the distance at which a ray enters the box [low, high] grown by `grow`.

    0 when it starts inside; inf when it does not enter before `limit`.
    """
    first, last = 0.0, limit
    for r in range(3):
        below, above = low[r] - grow - at[r], high[r] + grow - at[r]
        u = direction[r]
        if u == 0.0:
            if below > 0.0 or above < 0.0:
                return np.inf
            continue
        a, b = below / u, above / u
        first, last = max(first, min(a, b)), min(last, max(a, b))
        if first > last:
            return np.inf
    return first


@nb.njit(nogil=True, cache=True)
def _distance(at, low, high, grow, limit):
    """Return the distance of a point from the box [low, high] minus `grow`, at least 0.

    inf when it is beyond `limit`.
    """
    square = 0.0
    for r in range(3):
        gap = max(low[r] - at[r], at[r] - high[r], 0.0)
        square += gap * gap
    gap = math.sqrt(square) - grow
    return max(gap, 0.0) if gap <= limit else np.inf


@nb.njit(nogil=True, cache=True)
def _sort(rows, near, begin, end, stop):
    """Sort entries [begin, end) by near, then row (Shell 1959, gaps after Knuth).

    Ends early, unsorted, once `stop` is set.
    """
    gap = 1
    while gap < (end - begin) // 3:
        gap = 3 * gap + 1
    while gap > 0:
        for i in range(begin + gap, end):
            if i % ROWS_AT_ONCE == 0 and stopped(stop):
                return
            row, key = rows[i], near[i]
            j = i
            while j >= begin + gap and (near[j - gap], rows[j - gap]) > (key, row):
                rows[j], near[j] = rows[j - gap], near[j - gap]
                j -= gap
            rows[j], near[j] = row, key
        gap //= 3


@nb.njit(nogil=True, cache=True)
def list_voxels(tree, at_units, direction, along, reach_units, radius_units, units_per_step, stop, lists):
    """List the voxels with a point that could be hit within reach, for each of k rays or points.

    along: whether these are rays.
    at_units: (k, 3) int64, origins, exact units.  direction: (k, 3) float64, unit vectors, read for
    rays only.
    reach_units: the reach of all.  radius_units: radius of the scan's largest sphere; 0 for points.
    Boxes grow by it, by one step, and by more than the rounding of this function: 2^-46 of the
    largest number in it.
    stop: the request's stop flag. Once it is set, the remaining voxels are not listed, and `unseen`
    is 0 for these rays.
    Fills `lists`. Returns how many entries are needed; those beyond the capacity are not written.
    """
    at, far = np.empty(3), 0.0
    top = tree.levels.shape[0] - 2
    here, level_of = np.empty(STACK, np.int64), np.empty(STACK, np.int64)
    reach = np.float64(reach_units) / units_per_step
    needed = 0
    last = tree.low.shape[0] - 1
    for i in range(at_units.shape[0]):
        lists.starts[i], lists.unseen[i] = needed, np.inf
        if stopped(stop):
            lists.unseen[i] = 0.0
            continue
        far = reach
        for r in range(3):
            at[r] = np.float64(at_units[i, r]) / units_per_step
            far = max(far, abs(at[r]))
            if last >= 0:
                far = max(far, abs(tree.low[last, r]), abs(tree.high[last, r]))
        slack = 1.0 + far * 2.0**-46
        grow, limit = np.float64(radius_units) / units_per_step + slack, reach + slack
        for box in tree.unknown:
            if along:
                near = _enter(at, direction[i], box[0], box[1], grow, limit)
            else:
                near = _distance(at, box[0], box[1], slack, limit)
            lists.unseen[i] = min(lists.unseen[i], near * units_per_step)
        depth = 0
        if last >= 0:
            here[0], level_of[0] = 0, top
            depth = 1
        while depth > 0:
            if stopped(stop):
                lists.unseen[i] = 0.0
                break
            depth -= 1
            number, level = here[depth], level_of[depth]
            box = tree.levels[level] + number
            if along:
                near = _enter(at, direction[i], tree.low[box], tree.high[box], grow, limit)
            else:
                near = _distance(at, tree.low[box], tree.high[box], slack, limit)
            if near == np.inf:
                continue
            if level == 0:
                if needed < lists.rows.shape[0]:
                    lists.rows[needed], lists.near[needed] = number, near * units_per_step
                needed += 1
                continue
            below = tree.levels[level] - tree.levels[level - 1]
            for child in range(number * FAN, min((number + 1) * FAN, below)):
                here[depth], level_of[depth] = child, level - 1
                depth += 1
        if needed <= lists.rows.shape[0]:
            _sort(lists.rows, lists.near, lists.starts[i], needed, stop)
            if stopped(stop):  # the entries are not sorted
                lists.unseen[i] = 0.0
    lists.starts[at_units.shape[0]] = needed
    return needed
