"""Broad phase of every query: the voxels in reach of poses, points, rays and motions, nearest first.

No voxel is read. The rows of the index are in Morton order; a tree of boxes over them therefore
groups FAN consecutive rows at a time. An *item* is a ball that stands still, or a cube that moves
along a straight line. A pose is the ball around the avatar's root sphere, a point the ball of its
reach; a ray and a part of a motion are moving cubes. All tests are wider than their rounding.

An entry of a list carries `near`, a lower bound of how far away the voxel's points are. It serves
order and pruning, and bounds what is not in memory. It never decides an answer.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ....schemas.kernels import compiling as nb
from .kernel_decorators import njit_no_refcount
from .scene_arrays import ROWS_AT_ONCE, stopped

# What a search may do with a voxel: stop before it, examine it, or count it as missing. An array of
# states (v,) uint8; an empty one says that all voxels are held.
NOT_HELD, HELD, MISSING = 0, 1, 2
FAN = 8
# On each level, FAN - 1 siblings stay on the stack; 2^63 rows have 21 levels.
REACH_STACK = 22 * FAN
INFINITE = np.inf


class VoxelTree(NamedTuple):
    """Boxes around the points of the v voxels of an index, level by level, beginning with the voxels.

    low, high: (n, 3) float64 [steps], exact; the first v are those of the voxels.
    levels: (l + 1,) int64, the start of each level; the last level is one box.
    scene: (2, 3) float64 [steps], the box of all points.
    unknown: (u, 2, 3) float64 [steps], boxes of scans that were left out.
    """

    low: NDArray[np.float64]
    high: NDArray[np.float64]
    levels: NDArray[np.int64]
    scene: NDArray[np.float64]
    unknown: NDArray[np.float64]


class Items(NamedTuple):
    """What k items reach, in the frame of the dataset's origin [steps].

    begin, end: (k, 3), equal for an item that stands still.
    span: (k,) radius of the ball, or half the edge of the moving cube.
    own: (k,) the part of the span that is the item itself: `near` is the distance beyond it. Unused
    for items that move, whose `near` is the way to the voxel.
    """

    begin: NDArray[np.float64]
    end: NDArray[np.float64]
    span: NDArray[np.float64]
    own: NDArray[np.float64]


class VoxelLists(NamedTuple):
    """Voxels that k items reach, for each of them by ascending `near`, then row.

    starts: (k + 1,) int64: the entries of item i are [starts[i], starts[i + 1]).
    rows: int64, index rows.  near: float64 [steps].
    unseen: (k,) float64 [steps], the least `near` of a scan that was left out; inf where there is none.
    """

    starts: NDArray[np.int64]
    rows: NDArray[np.int64]
    near: NDArray[np.float64]
    unseen: NDArray[np.float64]


class ReachStack(NamedTuple):
    """Scratch of `list_item`: a box and its level, (REACH_STACK,) int64 each."""

    box: NDArray[np.int64]
    level: NDArray[np.int64]


def make_voxel_tree(
    low: NDArray[np.int64], high: NDArray[np.int64], scene: NDArray[np.int64], unknown: NDArray[np.int64]
) -> VoxelTree:
    """Build the tree over voxels whose points lie in the boxes low, high (v, 3) [steps].

    Rows are in Morton order.  scene: (2, 3).  unknown: (u, 2, 3).
    """
    lows, highs = [low.astype(np.float64)], [high.astype(np.float64)]
    while len(lows[-1]) > 1:
        groups = np.arange(0, len(lows[-1]), FAN)
        lows.append(np.minimum.reduceat(lows[-1], groups))
        highs.append(np.maximum.reduceat(highs[-1], groups))
    levels = np.cumsum([0, *map(len, lows)])
    return VoxelTree(
        np.concatenate(lows), np.concatenate(highs), levels, scene.astype(np.float64), unknown.astype(np.float64)
    )  # fmt: skip


@njit_no_refcount
def state_of(state, voxel):
    """Return the state of a voxel."""
    return np.uint8(HELD) if state.shape[0] == 0 else state[voxel]


@njit_no_refcount
def all_resident(where, rows, needed):
    """Return whether a list of `needed` rows was written, and all of its voxels are resident."""
    if needed < 0 or needed > rows.shape[0]:
        return False
    for at in range(needed):
        if where[rows[at], 0] < 0:
            return False
    return True


@nb.njit(nogil=True, cache=True)
def make_reach_stack():
    """Allocate the scratch of `list_item`."""
    return ReachStack(np.empty(REACH_STACK, np.int64), np.empty(REACH_STACK, np.int64))


@njit_no_refcount
def entry_fraction(begin, end, span, low, high):
    """Return the fraction of its way at which a moving cube first meets the box [low, high].

    begin, end: (3,), its centre.  span: half its edge. Rounded down; inf if it does not meet the box.
    """
    least, most = 0.0, 1.0
    for r in range(3):
        displacement = end[r] - begin[r]
        near, far = low[r] - span - begin[r], high[r] + span - begin[r]
        if displacement == 0.0:
            if near > 0.0 or far < 0.0:
                return INFINITE
            continue
        first, last = near / displacement, far / displacement
        if displacement < 0.0:
            first, last = last, first
        # near and far are rounded to 2^-52 of terms; spans are wider than necessary by that much.
        least, most = max(least, first), min(most, last)
    if least > most * (1.0 + 1e-12) + 1e-12:
        return INFINITE
    return max(0.0, least - 1e-9)


@njit_no_refcount
def _near(begin, end, still, way, span, own, low, high):
    """Return `near` of an item and a box; inf if the box is not in reach.

    still: whether the item stands still.  way: length of its way.
    """
    if not still:
        return entry_fraction(begin, end, span, low, high) * way
    square = 0.0
    for r in range(3):
        gap = max(low[r] - begin[r], begin[r] - high[r], 0.0)
        square += gap * gap
    if not square <= span * span:
        return INFINITE
    return max(math.sqrt(square) * (1.0 - 1e-9) - own, 0.0)


@njit_no_refcount
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
            while j >= begin + gap and (
                near[j - gap] > key or (near[j - gap] == key and rows[j - gap] > row)
            ):
                rows[j], near[j] = rows[j - gap], near[j - gap]
                j -= gap
            rows[j], near[j] = row, key
        gap //= 3


@njit_no_refcount
def list_item(tree, begin, end, span, own, stop, stack, rows, near, count):
    """Append the voxels in reach of one item to rows and near, from `count` on, sorted.

    begin, end, span, own: of one item, see `Items`.  stop: the request's stop flag; once it is set,
    the list is incomplete and unsorted.
    Returns the new count. Entries beyond the capacity are not written, and the list is then not
    sorted.
    """
    still, square = True, 0.0
    for r in range(3):
        still &= begin[r] == end[r]
        square += (end[r] - begin[r]) ** 2
    way, depth, first = math.sqrt(square), 0, count
    if tree.low.shape[0] > 0:
        stack.box[0], stack.level[0] = 0, tree.levels.shape[0] - 2
        depth = 1
    while depth > 0 and not stopped(stop):
        depth -= 1
        number, level = stack.box[depth], stack.level[depth]
        at = tree.levels[level] + number
        gap = _near(begin, end, still, way, span, own, tree.low[at], tree.high[at])
        if gap == INFINITE:
            continue
        if level == 0:
            if count < rows.shape[0]:
                rows[count], near[count] = number, gap
            count += 1
            continue
        below = tree.levels[level] - tree.levels[level - 1]
        for child in range(number * FAN, min((number + 1) * FAN, below)):
            stack.box[depth], stack.level[depth] = child, level - 1
            depth += 1
    if count <= rows.shape[0]:
        _sort(rows, near, first, count, stop)
    return count


@njit_no_refcount
def unknown_near(tree, begin, end, span, own):
    """Return the least `near` of one item and a scan that was left out; inf where none is in reach."""
    still, square, least = True, 0.0, INFINITE
    for r in range(3):
        still &= begin[r] == end[r]
        square += (end[r] - begin[r]) ** 2
    for u in range(tree.unknown.shape[0]):
        gap = _near(begin, end, still, math.sqrt(square), span, own, tree.unknown[u, 0], tree.unknown[u, 1])
        least = min(least, gap)
    return least


@nb.njit(nogil=True, cache=True)
def list_reach(tree, items, stop, lists):
    """List the voxels in reach of k items.

    stop: the request's stop flag. Once it is set, the remaining items have no entries, and `unseen`
    is 0 for these and for the one in hand.
    Fills `lists`. Returns how many entries are needed; those beyond the capacity are not written.
    """
    stack, needed = make_reach_stack(), 0
    for i in range(items.span.shape[0]):
        begin, end, span, own = items.begin[i], items.end[i], items.span[i], items.own[i]
        lists.starts[i] = needed
        if not stopped(stop):
            needed = list_item(tree, begin, end, span, own, stop, stack, lists.rows, lists.near, needed)
            lists.unseen[i] = unknown_near(tree, begin, end, span, own)
        if stopped(stop):
            lists.unseen[i] = 0.0
    lists.starts[items.span.shape[0]] = needed
    return needed
