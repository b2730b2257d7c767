"""Nearest pair by priority, within a budget: a search that can stop at any time with a valid bound.

The search is best first, with a heap of node pairs, as in Hubbard, "Approximating polyhedra with
spheres for time-critical collision detection" (1996), and Klein and Zachmann, "ADB-Trees:
controlling the error of time-critical collision detection" (2003). The error of an answer is at
most the distance of the best pair minus the least lower bound of the open pairs. The search
therefore opens the pair of the least lower bound next. Among pairs of equal bound it opens the one
with the least upper bound, which is the likeliest to hold a contact.

The order of visits depends on the request alone. A larger budget therefore continues what a smaller
one began, and no bound gets worse (NUMERICS.md case 30). All state lies in arrays: the search can
be suspended and resumed. Pairs that do not fit the heap are searched depth first, to the end,
before the heap continues: memory is bounded, and no pair is dropped.

Where scan points have spheres of several sizes, all bounds are bounds of |a - b| + deficit
(nearest_pair.py). Below a node, no deficit is less than that of its radius class, and the deficit
of some point is at most the class's `sure` deficit.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ....schemas.archive.radius_model import RIM_BIT
from ....schemas.kernels import compiling as nb
from ..core.kernel_decorators import njit_no_refcount
from ..core.node_overlap import STACK, lanes_meet
from ..core.placed_avatar import MAX_REACH_UNITS, PlacedAvatar, make_placed, place_block, place_nodes
from ..core.scene_arrays import (
    COUNT,
    COUNTED,
    FIRST,
    LANES,
    NO_LIMIT,
    ROW_WORDS,
    ROWS_AT_ONCE,
    node_class,
    stopped,
)
from .block_distances import any_near
from .missing_voxels import box_distance
from .nearest_pair import (
    BestPair,
    found_units,
    lower_bound_with_deficit,
    make_best_pair,
    search_lanes,
    set_cut,
    upper_bound,
)
from .pair_heap import pop_top, sift_up

# Status of a search: it continues; it ended because no pair is open, because the answer has the
# requested accuracy, or because the budget of visits is spent.
OPEN, DONE, ENOUGH, BUDGET_SPENT = range(4)
NO_VOXEL = -1  # in place of a row: the voxel has not been visited


class SearchResults(NamedTuple):
    """Results for k poses, accumulated over the pieces of a request.

    square, pair, deficit, missing_bound: of `NearestPairs`.
    lower: (k,) float64 [steps], a lower bound of |a - b| + deficit of everything left open; inf:
    nothing was.
    upper: (k,) float64 [steps], an upper bound of |a - b| + deficit of some pair.
    spent: (k,) bool, the budget has ended a search. Further pieces then get no budget; otherwise a
    larger budget would see less of them.
    """

    square: NDArray[np.int64]
    pair: NDArray[np.int64]
    deficit: NDArray[np.int64]
    missing_bound: NDArray[np.float64]
    lower: NDArray[np.float64]
    upper: NDArray[np.float64]
    spent: NDArray[np.bool_]


class BestFirstSearch(NamedTuple):
    """Search that can be resumed; scratch of one request.

    keys: (h + STACK, 2) float32, lower and upper bound of a pair [steps], without the error of
    placing.
    pairs: (h + STACK, 3) int64: avatar node, row or NO_VOXEL, voxel. The first h are the heap; the
    others are the stack of pairs that did not fit the heap.
    sizes: (2,) int64, of heap and stack.
    bounds: (4,) float64 [steps]: lower and upper bound of the answer, lower bound of the stack,
    error of placing.
    status: (1,) int64.
    deficits: (2, n) float32 [steps], by radius class of a node: a lower bound of the deficit of
    every point below it, rounded down; an upper bound of the deficit of some point, rounded up.
    """

    keys: NDArray[np.float32]
    pairs: NDArray[np.int64]
    sizes: NDArray[np.int64]
    bounds: NDArray[np.float64]
    status: NDArray[np.int64]
    deficits: NDArray[np.float32]
    placed: PlacedAvatar
    best: BestPair


class SearchGoal(NamedTuple):
    """Conditions that end a search.

    first: end at the first pair within reach plus `early` (`collide`).
    early: exact units by which a pair may exceed the reach and still be accepted, with `first`.
    enough: (k,) float64 [steps], with `first`: a pair whose upper bound is at most this is accepted
    although the pair itself is not known.
    tolerance: without `first`, the difference of the bounds at which the search ends [steps].
    share: the same, as a share of |a - b|; the larger of both counts, if `tolerance` is above 0.
    visits: node visits a pose.
    """

    first: bool
    early: int
    enough: NDArray[np.float64]
    tolerance: float
    share: float
    visits: int


@nb.njit(nogil=True, cache=True)
def make_search(avatar, scene, heap):
    """Allocate scratch for one avatar (not empty) and a heap of `heap` pairs."""
    deficit = scene.radius_deficit
    mask = deficit.shape[0] - 1
    deficits = np.empty((2, deficit.shape[0]), np.float32)
    for c in range(deficit.shape[0]):
        # Some point has the node's local class, on a rim or not; where not all are on a rim, one
        # that is not on a rim may have any class.
        sure = min(deficit[(c | RIM_BIT) & mask], deficit[c & RIM_BIT & mask])
        deficits[0, c] = np.float32(np.float64(deficit[c]) / scene.units_per_step * (1.0 - 1e-6))
        deficits[1, c] = np.float32(np.float64(sure) / scene.units_per_step * (1.0 + 1e-6))
    return BestFirstSearch(
        np.empty((heap + STACK, 2), np.float32), np.empty((heap + STACK, 3), np.int64), np.zeros(2, np.int64),
        np.zeros(4), np.zeros(1, np.int64), deficits, make_placed(avatar), make_best_pair(deficit),
    )  # fmt: skip


@nb.njit(nogil=True, cache=True)
def _begin_search(poses, avatar, scene, index, reach, i, search, goal, results, counts):
    """Start a search for pose i: all voxels in reach, with bounds from the index."""
    best, placed = search.best, search.placed
    best.frame[0], best.frame[1] = place_nodes(avatar, poses[i], placed, scene)
    best.frame[2], best.frame[3] = scene.units_per_step, scene.voxel_steps
    best.units[0] = reach.units[i] + min(goal.early, MAX_REACH_UNITS - reach.units[i])
    best.found[0], best.found[7] = results.square[i], results.deficit[i]
    best.found[1:7] = results.pair[i]
    best.counters[:3] = 0
    set_cut(best.cut, best.far, best.frame, best.deficit, reach.units[i])
    search.bounds[0], search.bounds[1], search.bounds[2], search.bounds[3] = 0.0, np.inf, 0.0, best.frame[4]
    within = best.units[0] if best.found[0] < 0 else found_units(best.found)
    # `collide` searches nodes for pairs within reach, and accepts a pair slightly beyond if it
    # meets one. `squares`, a scratch of LANES, holds a cut for each of at most RADIUS_CLASSES,
    # which are as many.
    set_cut(best.squares if goal.first else best.cut, best.far, best.frame, best.deficit, within)
    search.sizes[0], search.sizes[1], search.status[0] = 0, 0, OPEN
    keys, pairs = search.keys, search.pairs
    root = avatar.radius[0]
    for at in range(reach.starts[i], reach.starts[i + 1]):
        if at % ROWS_AT_ONCE == 0 and stopped(scene.stop):
            results.missing_bound[i] = 0.0  # as though the remaining voxels were missing
            break
        voxel = reach.rows[at]
        gap = box_distance(root, placed, best.frame[1], scene, index, voxel)
        if scene.where[voxel, 0] < 0:
            counts[0, i] += np.uint32(1)
            results.missing_bound[i] = min(results.missing_bound[i], gap)
            continue
        size = search.sizes[0]
        deficit = search.deficits[0, node_class(scene.ints, scene.where[voxel, 0], best.mask)]
        keys[size, 0], keys[size, 1] = np.float32(gap * (1.0 - 1e-6)) + deficit, np.float32(np.inf)
        pairs[size, 0], pairs[size, 1], pairs[size, 2] = 0, NO_VOXEL, voxel
        sift_up(keys, pairs, size)
        search.sizes[0] = size + 1


@njit_no_refcount
def _enough(goal, enough, best, bounds):
    """Return whether the answer is known as accurately as requested."""
    if goal.first:
        return best.found[0] >= 0 or bounds[1] <= enough
    if best.found[0] < 0 or goal.tolerance <= 0.0:
        return False
    found = math.sqrt(np.float64(best.found[0])) + np.float64(best.found[7])
    nearest = max(bounds[0] - best.frame[7] / best.frame[2], 0.0)  # a lower bound of |a - b|
    return found / best.frame[2] - bounds[0] <= max(goal.tolerance, goal.share * nearest)


@njit_no_refcount
def _push_pair(keys, pairs, sizes, heap, spilling, cut, bounds, parent, low, high, a, row, voxel):
    """Add a pair to the heap, or to the stack if spilling.

    low, high: its bounds.  parent: the lower bound of its parent.  cut: pairs above it are useless.
    """
    bounds[1] = min(bounds[1], np.float64(high) + bounds[3])
    # A lower bound of the parent is one of the child.
    low = max(low, parent)
    if low > cut:
        return
    at = heap + sizes[1] if spilling else sizes[0]
    keys[at, 0], keys[at, 1] = low, high
    pairs[at, 0], pairs[at, 1], pairs[at, 2] = a, row, voxel
    if spilling:
        sizes[1] += 1
    else:
        sizes[0] += 1
        sift_up(keys, pairs, at)


@njit_no_refcount
def _resume(m, pose, avatar, scene, search, goal, enough, budget, until):
    """Visit node pairs until the search ends, or `until` pairs are visited; set the status.

    budget: how many visits are allowed.
    """
    words, ints, halves = scene.words, scene.ints, scene.halves
    where, coordinates, placed, best = scene.where, scene.coordinates, search.placed, search.best
    nodes, lanes, stamp, frame_at, shift = (
        placed.nodes,
        placed.lanes,
        placed.stamp,
        placed.frame,
        placed.shift,
    )
    found, cut, far, frame, corner, keep = best.found, best.cut, best.far, best.frame, best.corner, best.keep
    squares, counters, units, deficit, mask = (
        best.squares,
        best.counters,
        best.units[0],
        best.deficit,
        best.mask,
    )
    deficits, largest = search.deficits, np.argmin(deficit)
    keys, pairs, sizes, bounds = search.keys, search.pairs, search.sizes, search.bounds
    avatar_first, avatar_count, points = avatar.first, avatar.count, avatar.points
    heap = keys.shape[0] - STACK
    while True:
        limit = cut[largest]
        if sizes[1] == 0 and (sizes[0] == 0 or keys[0, 0] > limit):
            search.status[0] = DONE
            return
        least = np.float64(keys[0, 0]) if sizes[1] == 0 else bounds[2]
        bounds[0] = max(bounds[0], least * (1.0 - 2e-6) - bounds[3])
        if _enough(goal, enough, best, bounds):
            search.status[0] = ENOUGH
            return
        if counters[0] >= until:
            return
        if stopped(scene.stop):
            search.status[0] = BUDGET_SPENT
            return
        at = 0 if sizes[1] == 0 else heap + sizes[1] - 1
        key, a, row, voxel = keys[at, 0], pairs[at, 0], pairs[at, 1], pairs[at, 2]
        a_first = avatar_first[a]
        b_first = 0 if row == NO_VOXEL else np.int64(ints[row + FIRST])
        leaves = row != NO_VOXEL and a_first < 0 and b_first < 0
        avatar_side = b_first < 0 or (a_first >= 0 and row != NO_VOXEL and nodes[3, a] > words[row + 3])
        cost = np.int64(1)
        if row != NO_VOXEL and not leaves:
            cost = np.int64(avatar_count[a]) if avatar_side else np.int64(ints[row + COUNT] & COUNTED)
        if counters[0] + cost > budget:
            search.status[0] = BUDGET_SPENT
            return
        # A nearer pair may have overtaken a pair on the stack; visits are counted nevertheless.
        counters[0] += cost
        spilling = sizes[1] > 0 or sizes[0] - 1 + cost > heap
        if sizes[1] > 0:
            sizes[1] -= 1
        else:
            bounds[2] = np.float64(key)
            pop_top(keys, pairs, sizes[0])
            sizes[0] -= 1
        if key > limit:
            continue
        base = where[voxel, 0]
        for r in range(3):
            corner[r] = coordinates[voxel, r] * scene.voxel_steps
        off_x = np.float32(corner[0] - frame_at[0])
        off_y = np.float32(corner[1] - frame_at[1])
        off_z = np.float32(corner[2] - frame_at[2])
        x, y, z = nodes[0, a] - off_x, nodes[1, a] - off_y, nodes[2, a] - off_z
        c = node_class(ints, base if row == NO_VOXEL else row, mask)
        if row == NO_VOXEL:
            low = lower_bound_with_deficit(words, base, x, y, z, nodes[3, a], deficits[0, c])
            high = upper_bound(words, base, x, y, z, nodes[3, a]) + deficits[1, c]
            _push_pair(keys, pairs, sizes, heap, spilling, limit, bounds, key, low, high, a, base, voxel)
        elif leaves:
            block, scene_block = ~a_first, ~b_first
            if stamp[block] != pose:
                place_block(avatar, m, block, placed, scene)
                stamp[block] = pose
            block_at = where[voxel, 1] + scene_block * scene.block_words
            lane_at = where[voxel, 2] + scene_block * 3 * LANES
            lx, ly = off_x + np.float32(ints[block_at]), off_y + np.float32(ints[block_at + 1])
            lz = off_z + np.float32(ints[block_at + 2])
            lanes_meet(words, row, lanes, block, off_x, off_y, off_z, cut[c], keep)
            for lane in range(avatar_count[a]):
                if not keep[lane]:
                    continue
                px, py = lanes[block, 0, lane] - lx, lanes[block, 1, lane] - ly
                pz = lanes[block, 2, lane] - lz
                counters[1] += LANES
                if any_near(halves, lane_at, px, py, pz, far[c]):
                    search_lanes(
                        points, m, shift, block, lane, ints, halves, corner, block_at, lane_at, c, px, py, pz,
                        frame, units, squares, found, cut, far, deficit, mask,
                    )  # fmt: skip
        elif avatar_side:
            for child in range(a_first, a_first + cost):
                x, y, z = nodes[0, child] - off_x, nodes[1, child] - off_y, nodes[2, child] - off_z
                low = lower_bound_with_deficit(words, row, x, y, z, nodes[3, child], deficits[0, c])
                high = upper_bound(words, row, x, y, z, nodes[3, child]) + deficits[1, c]
                _push_pair(
                    keys, pairs, sizes, heap, spilling, limit, bounds, key, low, high, child, row, voxel
                )
        else:
            for number in range(cost):
                child = base + (b_first + number) * ROW_WORDS
                c = node_class(ints, child, mask)
                low = lower_bound_with_deficit(words, child, x, y, z, nodes[3, a], deficits[0, c])
                high = upper_bound(words, child, x, y, z, nodes[3, a]) + deficits[1, c]
                _push_pair(keys, pairs, sizes, heap, spilling, limit, bounds, key, low, high, a, child, voxel)


@nb.njit(nogil=True, cache=True)
def end_search(search, i, results, counts):
    """Merge the results of a search into `results` and `counts` of pose i."""
    best = search.best
    results.square[i], results.deficit[i] = best.found[0], best.found[7]
    results.pair[i] = best.found[1:7]
    results.upper[i] = min(results.upper[i], search.bounds[1])
    results.spent[i] |= search.status[0] == BUDGET_SPENT
    if search.status[0] != DONE:
        results.lower[i] = min(results.lower[i], search.bounds[0])
    counts[1, i] += np.uint32(best.counters[0])
    counts[2, i] += np.uint32(best.counters[1])


@nb.njit(nogil=True, cache=True)
def resume_search(poses, avatar, scene, index, reach, i, fresh, until, search, goal, results, counts):
    """Search for the nearest pair of pose i: from the start if `fresh`, else from where it stopped.

    poses: (k, 4, 4), checked.  avatar: not empty.  reach: VoxelsInReach of the poses; a voxel in it
    that is not resident is counted as missing.  until: the number of visits, in this piece, at
    which to suspend.
    Once the search has ended, its results are merged into `results` and counts (3, k) uint32; for a
    suspended search, `end_search` does that. Returns the status.
    """
    if fresh:
        _begin_search(poses, avatar, scene, index, reach, i, search, goal, results, counts)
    budget = np.int64(0) if results.spent[i] else goal.visits - np.int64(counts[1, i])
    _resume(poses[i], i, avatar, scene, search, goal, goal.enough[i], budget, until)
    if search.status[0] != OPEN:
        end_search(search, i, results, counts)
    return search.status[0]


@nb.njit(nogil=True, cache=True)
def search_poses(poses, avatar, scene, index, reach, which, heap, goal, results, counts):
    """Run `resume_search` to the end for the poses numbered in `which`.

    One call answers a request without a deadline.
    """
    search = make_search(avatar, scene, heap)
    for number in range(which.shape[0]):
        if stopped(scene.stop):
            results.lower[which[number]] = 0.0
            continue
        resume_search(
            poses, avatar, scene, index, reach, which[number], True, np.int64(NO_LIMIT), search, goal, results, counts
        )  # fmt: skip
