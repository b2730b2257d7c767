"""Broad phase of every query: the voxels in reach of poses, points, rays and motions, nearest first.

No voxel is read. The rows of the index are in Morton order; a tree of boxes over them therefore
groups FAN consecutive rows at a time. An *item* is a ball that stands still, or a cube that moves
along a straight line. A pose is the ball around the avatar's root sphere, a point the ball of its
reach; a ray and a part of a motion are moving cubes. All tests are wider than their rounding.

An entry of a list carries `near`, a lower bound of how far away the voxel's points are. It serves
order and pruning, and bounds what is not in memory. It never decides an answer.

Poses are checked here too, before their reach is computed.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ....schemas.archive.rigid_pose import RIGID_TOLERANCE
from ....schemas.archive.units import UNITS_PER_METRE
from ....schemas.archive.voxel_grid import MAX_COORDINATE
from ....schemas.runtime import compiling as nb
from .kernel_decorators import njit_inlined, njit_no_refcount
from .placed_avatar import MAX_REACH_UNITS, largest_term, place
from .scene_arrays import stopped

# What a search may do with a voxel: stop before it, examine it, or count it as missing. An array of
# states (v,) uint8; an empty one says that all voxels are held.
NOT_HELD, HELD, MISSING = 0, 1, 2
U = np.uint64  # see placed_avatar.py
FAN = 8
# On each level, FAN - 1 siblings stay on the stack; 2^63 rows have 21 levels.
REACH_STACK = 22 * FAN
INFINITE = np.inf
# Poses checked, and entries sorted, between two checks of the stop flag: tens of microseconds.
POSES_AT_ONCE, ENTRIES_AT_ONCE = 64, 512
# Voxels in reach of a query of one item that is answered in one call.
MAX_ROWS_OF_ONE = 64
# Coordinates near a pose must be exact in float32, with a bit to spare (collide_poses.py).
MAX_FRAME_STEPS = 1 << 23
VALID, NOT_FINITE, BAD_LAST_ROW, MIRRORED, SHEARED, SCALED, TOO_FAR, LONG_REACH, LARGE_AVATAR = range(9)


class VoxelTree(NamedTuple):
    """Boxes around the points of the v voxels of an index, level by level, beginning with the voxels.

    low, high: (n, 3) float64 [steps], exact; the first v are those of the voxels, the last is the root.
    below: (n, 2) int64, first and end of the boxes below a box, at most FAN; -1 for those of voxels.
    voxels: their number v.
    scene: (2, 3) float64 [steps], the box of all points.
    unknown: (u, 2, 3) float64 [steps], boxes of scans that were left out.
    """

    low: NDArray[np.float64]
    high: NDArray[np.float64]
    below: NDArray[np.int64]
    voxels: int
    scene: NDArray[np.float64]
    unknown: NDArray[np.float64]


class Items(NamedTuple):
    """Hold what k items reach, in the frame of the dataset's origin [steps].

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


class VoxelsInReach(NamedTuple):
    """Voxels that k poses could touch.

    units: (k,) int64, r_a + r_b + margin in exact units.
    lists: the voxels; `near` bounds the distance between centres, and `unseen` is that of scans that
    were left out.
    outside: (k,) bool, whether the box of the root sphere and its reach extends beyond the scene's box.
    """

    units: NDArray[np.int64]
    lists: VoxelLists
    outside: NDArray[np.bool_]


class OneReach(NamedTuple):
    """Scratch for the reach of one pose or point: reach, with space for MAX_ROWS_OF_ONE rows.

    which, cursor: (1,) int64, zero, and entries examined.  all_held: (0,) uint8, states.  never: (1,)
    int64, a stop flag that is not set.
    """

    reach: VoxelsInReach
    which: NDArray[np.int64]
    cursor: NDArray[np.int64]
    all_held: NDArray[np.uint8]
    never: NDArray[np.int64]


def make_voxel_tree(
    low: NDArray[np.int64], high: NDArray[np.int64], scene: NDArray[np.int64], unknown: NDArray[np.int64]
) -> VoxelTree:
    """Build the tree over voxels whose points lie in the boxes low, high (v, 3) [steps].

    Rows are in Morton order.  scene: (2, 3).  unknown: (u, 2, 3).
    """
    lows, highs, below = [low.astype(np.float64)], [high.astype(np.float64)], [np.full((len(low), 2), -1)]
    start = 0
    while len(lows[-1]) > 1:
        count = len(lows[-1])
        groups = np.arange(0, count, FAN)
        below.append(start + np.column_stack([groups, np.minimum(groups + FAN, count)]))
        start += count
        lows.append(np.minimum.reduceat(lows[-1], groups))
        highs.append(np.maximum.reduceat(highs[-1], groups))
    return VoxelTree(
        np.concatenate(lows), np.concatenate(highs), np.concatenate(below), len(low), scene.astype(np.float64),
        unknown.astype(np.float64),
    )  # fmt: skip


def find_lists(tree: VoxelTree, items: Items, stop: NDArray[np.int64]) -> VoxelLists:
    """Return the voxels in reach of k items; see `list_reach`."""
    k = len(items.span)
    capacity = max(64, 8 * k)
    while True:
        lists = make_reach(k, capacity).lists
        needed = list_reach(tree, items, stop, lists)
        if needed <= capacity:
            return lists
        capacity = needed


def make_reach(k: int, rows: int) -> VoxelsInReach:
    """Return an empty `VoxelsInReach` for k poses, with space for `rows` voxel rows."""
    lists = VoxelLists(
        np.zeros(k + 1, np.int64), np.empty(rows, np.int64), np.empty(rows), np.full(k, np.inf)
    )
    return VoxelsInReach(np.empty(k, np.int64), lists, np.zeros(k, bool))


def make_one_reach() -> OneReach:
    """Allocate the scratch for one pose or point."""
    which, cursor, never = np.zeros(1, np.int64), np.zeros(1, np.int64), np.zeros(1, np.int64)
    return OneReach(make_reach(1, MAX_ROWS_OF_ONE), which, cursor, np.empty(0, np.uint8), never)


@njit_no_refcount
def state_of(state, voxel):
    """Return the state of a voxel."""
    return np.uint8(HELD) if state.shape[0] == 0 else state[voxel]


@njit_no_refcount
def resident_front(where, rows, needed):
    """Return how many voxels at the front of a list of `needed` rows are resident; -1 if it was not written."""
    if needed < 0 or needed > rows.shape[0]:
        return -1
    at = 0
    while at < needed and where[rows[at], 0] >= 0:
        at += 1
    return at


@njit_no_refcount
def all_resident(where, rows, needed):
    """Return whether a list of `needed` rows was written, and all of its voxels are resident."""
    return needed >= 0 and resident_front(where, rows, needed) == needed


@njit_inlined
def _entry(bx, by, bz, ex, ey, ez, span, low, high, at):
    """Return the fraction of its way at which a moving cube first meets box `at`; see `entry_fraction`.

    b, e: its centre at both ends.  low, high: (n, 3).
    """
    least, most, misses = 0.0, 1.0, False
    for r in range(3):
        begin = bx if r == 0 else by if r == 1 else bz
        way = (ex if r == 0 else ey if r == 1 else ez) - begin
        near, far = low[at, r] - span - begin, high[at, r] + span - begin
        if way == 0.0:
            misses |= near > 0.0 or far < 0.0
            continue
        first, last = near / way, far / way
        if way < 0.0:
            first, last = last, first
        # near and far are rounded to 2^-52 of terms; spans are wider than necessary by that much.
        least, most = max(least, first), min(most, last)
    if misses or least > most * (1.0 + 1e-12) + 1e-12:
        return INFINITE
    return max(0.0, least - 1e-9)


@njit_no_refcount
def entry_fraction(begin, end, span, box):
    """Return the fraction of its way at which a moving cube first meets a box (2, 3).

    begin, end: (3,), its centre.  span: half its edge. Rounded down; inf if it does not meet the box.
    """
    return _entry(begin[0], begin[1], begin[2], end[0], end[1], end[2], span, box[:1], box[1:], 0)


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
            if i % ENTRIES_AT_ONCE == 0 and stopped(stop):
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
    the list is incomplete.  stack: (REACH_STACK,) int64, scratch.
    Returns the new count. Entries beyond the capacity are not written, and the list is then not
    sorted.
    """
    low, high, below, boxes = tree.low, tree.high, tree.below, tree.low.shape[0]
    bx, by, bz, ex, ey, ez = begin[0], begin[1], begin[2], end[0], end[1], end[2]
    still = bx == ex and by == ey and bz == ez
    way, most = math.sqrt((ex - bx) ** 2 + (ey - by) ** 2 + (ez - bz) ** 2), span * span
    first, depth, capacity = count, 0, rows.shape[0]
    if boxes > 0:
        stack[0], depth = boxes - 1, 1
    while depth > 0 and not stopped(stop):
        depth -= 1
        # Unsigned: numba adds a comparison for every index that may be negative.
        at = U(stack[U(depth)])
        if still:
            dx = max(low[at, 0] - bx, bx - high[at, 0], 0.0)
            dy = max(low[at, 1] - by, by - high[at, 1], 0.0)
            dz = max(low[at, 2] - bz, bz - high[at, 2], 0.0)
            gap = dx * dx + dy * dy + dz * dz
            if not gap <= most:
                continue
        else:
            gap = _entry(bx, by, bz, ex, ey, ez, span, low, high, at)
            if gap == INFINITE:
                continue
        if below[at, 0] >= 0:
            for box in range(below[at, 0], below[at, 1]):
                stack[U(depth)] = box
                depth += 1
            continue
        if count < capacity:
            rows[count] = np.int64(at)
            near[count] = max(math.sqrt(gap) * (1.0 - 1e-9) - own, 0.0) if still else gap * way
        count += 1
    if count - first > 1 and count <= capacity:
        _sort(rows, near, first, count, stop)
    return count


@njit_no_refcount
def unknown_near(tree, begin, end, span, own):
    """Return the least `near` of one item and a scan that was left out; inf where none is in reach."""
    unknown, least = tree.unknown, INFINITE
    still = begin[0] == end[0] and begin[1] == end[1] and begin[2] == end[2]
    for u in range(unknown.shape[0]):
        square = 0.0
        for r in range(3):
            if still:
                gap = max(unknown[u, 0, r] - begin[r], begin[r] - unknown[u, 1, r], 0.0)
                square += gap * gap
            else:
                square += (end[r] - begin[r]) ** 2
        if not still:
            least = min(least, entry_fraction(begin, end, span, unknown[u]) * math.sqrt(square))
        elif square <= span * span:
            least = min(least, max(math.sqrt(square) * (1.0 - 1e-9) - own, 0.0))
    return least


@nb.njit(nogil=True, cache=True)
def list_reach(tree, items, stop, lists):
    """List the voxels in reach of k items.

    stop: the request's stop flag. Once it is set, the remaining items have no entries, and `unseen`
    is 0 for these and for the one in hand.
    Fills `lists`. Returns how many entries are needed; those beyond the capacity are not written.
    """
    stack, needed = np.empty(REACH_STACK, np.int64), 0
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


@njit_no_refcount
def check_poses(poses, node_radius, radius, other_units, scene, units):
    """Check that poses (k, 4, 4) float64 are rigid (N6); compute reaches.

    Writes units (k,) int64, the reach of each pose in exact units.
    node_radius: (a,) of the avatar's nodes, root first, may be empty.  radius: of its points [m].
    other_units: the scan's radius plus the margin, exact units.  scene: SceneArrays.
    Returns (VALID, 0, 0.0), or the first fault, its pose and the value found. Once scene.stop is
    set, it also returns (VALID, 0, 0.0), with the output incomplete: the caller must then check the
    stop flag.
    """
    reach = np.rint(radius * UNITS_PER_METRE) + float(other_units)
    extent = reach / UNITS_PER_METRE + (node_radius[0] if node_radius.shape[0] else 0.0)
    for i in range(poses.shape[0]):
        if i % POSES_AT_ONCE == 0 and stopped(scene.stop):
            break
        m = poses[i]
        for r in range(4):
            for c in range(4):
                if not math.isfinite(m[r, c]):
                    return NOT_FINITE, i, m[r, c]
        if m[3, 0] != 0.0 or m[3, 1] != 0.0 or m[3, 2] != 0.0 or m[3, 3] != 1.0:
            return BAD_LAST_ROW, i, m[3, 3]
        for r in range(3):
            if not abs(m[r, 3]) <= MAX_COORDINATE:
                return TOO_FAR, i, m[r, 3]
        minor0 = m[1, 1] * m[2, 2] - m[1, 2] * m[2, 1]
        minor1 = m[1, 0] * m[2, 2] - m[1, 2] * m[2, 0]
        minor2 = m[1, 0] * m[2, 1] - m[1, 1] * m[2, 0]
        volume = m[0, 0] * minor0 - m[0, 1] * minor1 + m[0, 2] * minor2
        square = 0.0
        for r in range(3):
            for c in range(3):
                square += m[r, c] * m[r, c]
        square /= 3.0
        worst = 0.0
        for a in range(3):
            for b in range(3):
                dot = m[0, a] * m[0, b] + m[1, a] * m[1, b] + m[2, a] * m[2, b]
                worst = max(worst, abs(dot - (square if a == b else 0.0)))
        # Factor 2: an entry that is off by the tolerance changes a product of two entries by twice
        # that.
        if worst > 2.0 * RIGID_TOLERANCE * square:
            return SHEARED, i, worst / square
        if volume < 0.0:
            return MIRRORED, i, volume
        scale = math.sqrt(square)
        if not abs(scale - 1.0) <= RIGID_TOLERANCE:
            return SCALED, i, scale
        if reach > MAX_REACH_UNITS:
            return LONG_REACH, i, reach / UNITS_PER_METRE
        units[i] = np.int64(reach)
        if extent / scene.step + scene.voxel_steps > MAX_FRAME_STEPS:
            return LARGE_AVATAR, i, extent
    return VALID, 0, 0.0


@nb.njit(nogil=True, cache=True)
def find_reach(poses, avatar, radius, other_units, scene, tree, reach):
    """Check poses and list the voxels in reach of each: `check_poses`, then `voxels_in_reach`.

    radius: of the avatar's points [m].  other_units: radius of the scan's points plus the margin,
    exact units. Fills `reach`.
    Returns (fault, pose, value found), as `check_poses` does, and the number of rows needed.
    """
    fault, pose, found = check_poses(poses, avatar.radius, radius, other_units, scene, reach.units)
    if fault != VALID or avatar.radius.shape[0] == 0:
        return fault, pose, found, 0
    # In one function with what follows, numba counts references in the loop: twice the time.
    return fault, pose, found, voxels_in_reach(poses, avatar, scene, tree, reach)


@nb.njit(nogil=True, cache=True)
def voxels_in_reach(poses, avatar, scene, tree, reach):
    """List, for each pose, the voxels whose points the avatar's root sphere could touch, nearest first.

    poses: (k, 4, 4), checked.  avatar: not empty.  scene: SceneArrays.
    Fills lists and outside of `reach` from its units. Returns how many rows are needed; those
    beyond the capacity are not written. Returns -1 when the scene's stop flag is set; `reach` is then
    not filled.
    The reach is widened by more than the rounding of this function: a millionth of itself, one
    step, and 2^-49 of the largest term of the sums.
    """
    outside, lists, stack = reach.outside, reach.lists, np.empty(REACH_STACK, np.int64)
    x, y, z = avatar.center[0, 0], avatar.center[0, 1], avatar.center[0, 2]
    shift, center = np.empty(3), np.empty(3)
    needed = 0
    for i in range(poses.shape[0]):
        m = poses[i]
        for r in range(3):
            shift[r] = m[r, 3] - scene.origin[r]
        rounding = largest_term(m, shift, x, y, z) / scene.step * 2.0**-49
        root = avatar.radius[0] / scene.step
        span = (root + reach.units[i] / scene.units_per_step) * (1.0 + 1e-6) + 1.0 + rounding
        outside[i] = False
        for r in range(3):
            center[r] = place(m, shift, r, x, y, z) / scene.step
            outside[i] |= center[r] - span < tree.scene[0, r] or center[r] + span > tree.scene[1, r]
        own = root * (1.0 + 1e-6) + 1.0 + rounding
        lists.starts[i] = needed
        needed = list_item(tree, center, center, span, own, scene.stop, stack, lists.rows, lists.near, needed)
        lists.unseen[i] = unknown_near(tree, center, center, span, own)
        if stopped(scene.stop):
            return -1
    lists.starts[poses.shape[0]] = needed
    return needed
