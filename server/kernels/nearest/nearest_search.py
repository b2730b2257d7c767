"""Nearest pair of two bounding sphere hierarchies under a pose, after [Fig12] figures 5 and 6.

This is branch and bound, with the best pair so far as the bound. The descent is that of
front_descent.py. A node is pruned only if its lower bound, minus the largest float32 error, exceeds
the best; the radius class of the largest sphere below a node sets its bound. nearest_pair.py defines
nearest and handles the points.

The first bound is narrow and is widened while nothing is found within it. Two alternatives are
slower. A single descent of both trees, taking the nearest child each time, gives a poor first
bound: it ended ten times as far as the nearest pair, and the search took twice as long. Visiting
children in the order of their bounds, which are nearly equal over a floor, took a tenth longer than
visiting them in stored order (scripts/bench_engine, distance on the walk).
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ....schemas.archive.units import UNITS_PER_METRE
from ....schemas.runtime import compiling as nb
from ..core.array_references import with_flag
from ..core.front_descent import GO_ON, Descent, descend_voxel, make_descent
from ..core.kernel_decorators import njit_inlined, njit_no_refcount
from ..core.node_bounds import U32, lanes_meet, locate_block, locate_voxel, nodes_meet
from ..core.placed_avatar import (
    lattice_to_units,
    make_front,
    place_block_once,
    place_front,
    place_nodes,
    place_root,
)
from ..core.reach import HELD, NOT_HELD, VALID, find_reach, resident_front, state_of
from ..core.scene_arrays import LANES, leaf_class, node_class, stopped
from .nearest_pair import (
    BestPair,
    NearestPairs,
    found_units,
    lower_bound,
    make_best_pair,
    nearest_squares,
    pair_units,
    set_cut,
    settle_candidates,
    take_candidates,
    units_to_beat,
    unmark_beyond_box,
    unsearched_bound,
)

U = np.uint64  # see placed_avatar.py
# Columns of the result of `nearest_resident`.
SIGNED, LOWER, NORMAL, AVATAR, CLOUD, COLUMNS = 0, 1, 2, 5, 8, 11


class _SearchScratch(NamedTuple):
    """Scratch of one call.

    best: the pair found.
    gaps: for each voxel of the pose's list, its `near`; inf: missing.  classes: of their largest
    spheres.
    """

    descent: Descent
    best: BestPair
    gaps: NDArray[np.float64]
    classes: NDArray[np.uint64]


@njit_inlined
def _search_leaves(avatar, m, a, scene, voxel, location, row, scratch):
    """Update the best pair from an avatar's leaf node (its marked points) and a scene's."""
    placed, best = scratch.descent.placed, scratch.best
    ints, lanes, keep, block = scene.ints, placed.lanes, best.keep, ~np.int64(avatar.first[U(a)])
    for lane in range(avatar.count[U(a)], LANES):
        keep[U(lane)] = False  # repeats the last point
    block_at, lane_at, low_x, low_y, low_z = locate_block(ints, location, row, scene.block_words)
    halves, c = scene.halves, leaf_class(ints, row, best.mask)
    unmark_beyond_box(halves, lane_at, low_x, low_y, low_z, lanes, block, best.far[c], keep)
    least, tested = nearest_squares(
        halves, lane_at, low_x, low_y, low_z, lanes, block, keep, best.keep8, best.squares
    )
    best.counters[1] += LANES * tested
    if least <= best.far[c]:
        take_candidates(
            least, c, block, block_at, lane_at, best, avatar.points, m, placed.shift, ints, scene.halves, lanes
        )  # fmt: skip
    return GO_ON


@njit_no_refcount
def _push(below, keys, begin, depth, a, key):
    """Insert a node into below[begin:depth], sorted by descending key; the least key is on top."""
    at = depth
    while at > begin and keys[at - 1] < key:
        below[at], keys[at] = below[at - 1], keys[at - 1]
        at -= 1
    below[at], keys[at] = a, key


@njit_no_refcount
def _search_below(avatar, m, extent, pose, scene, voxel, location, a, row, scratch):
    """Search a scene leaf node for a point nearer to a point below a node of the avatar's front.

    The avatar's node is descended depth first, the nearest child first. This is for avatars whose
    front is not their leaf nodes.
    """
    placed, best, words = scratch.descent.placed, scratch.best, scene.words
    nodes, firsts, held = placed.nodes, avatar.first, avatar.count
    below, keys, off, cut = best.below, best.keys, best.off, best.cut
    of_class = node_class(scene.ints, row, best.mask)
    below[0], keys[0] = a, np.float32(-1.0)
    depth = 1
    while depth > 0 and not stopped(scene.stop):
        depth -= 1
        a, within = below[depth], cut[of_class]
        if keys[depth] > within:
            continue
        a_first = np.int64(firsts[a])
        if a_first < 0:
            block = ~a_first
            place_block_once(avatar, m, pose, block, placed, scene)
            if lanes_meet(words, row, placed.lanes, block, off[0], off[1], off[2], within, best.keep):
                _search_leaves(avatar, m, a, scene, voxel, location, row, scratch)
            continue
        begin = depth
        best.counters[0] += held[a]
        for child in range(a_first, a_first + held[a]):
            key = lower_bound(
                words, row, nodes[0, child] - off[0], nodes[1, child] - off[1], nodes[2, child] - off[2],
                nodes[3, child],
            )  # fmt: skip
            if key <= within:
                _push(below, keys, begin, depth, child, key)
                depth += 1
    return GO_ON


@njit_inlined
def _pass_flat(scene, location, row, x, y, z, block, threshold, scratch):
    """Let the descent go on below a flat node: a tolerance only narrows the cut."""
    return GO_ON


@njit_no_refcount
def _nearest_voxel(avatar, m, extent, pose, scene, voxel, front, count, scratch):
    """Search one resident voxel for a nearer pair; return `_least_left`."""
    words, best, descent = scene.words, scratch.best, scratch.descent
    placed, nodes, cut, off = descent.placed, descent.placed.nodes, best.cut, best.off
    location = locate_voxel(scene, voxel, placed)
    off[0], off[1], off[2] = location.x, location.y, location.z
    for r in range(3):
        best.corner[r] = scene.corners[voxel, r]
    descent.counters[0] += 1
    x, y, z = nodes[0, 0] - off[0], nodes[1, 0] - off[1], nodes[2, 0] - off[2]
    threshold = cut[node_class(scene.ints, location.rows, best.mask)]
    if not nodes_meet(words, location.rows, x, y, z, nodes[3, 0], threshold):
        return np.inf
    _, entries = descend_voxel(
        avatar, m, extent, pose, scene, voxel, location, front, count, scratch, cut, best.mask, False, False,
        _pass_flat, _search_leaves, _search_below,
    )  # fmt: skip
    settle_candidates(best, avatar.points, m, placed.shift, scene.ints, scene.halves, placed.lanes)
    return _least_left(words, front.bounds, descent.stack, entries, off, best.frame[4])


@njit_no_refcount
def _least_left(words, bounds, stack, entries, off, error):
    """Return a lower bound of |a - b| of what a search left on its stack [steps]; inf: nothing.

    error: of `make_thresholds`, for a shorter distance; 8 U32 cover the difference.
    """
    least = np.float32(np.inf)
    for entry in range(entries):
        row, begin, count = stack[entry, 0], stack[entry, 1], stack[entry, 2]
        for i in range(begin, begin + count):
            x, y, z = bounds[0, i] - off[0], bounds[1, i] - off[1], bounds[2, i] - off[2]
            least = min(least, lower_bound(words, row, x, y, z, bounds[3, i]))
    return max(np.float64(least) * (1.0 - 8.0 * U32) - error, 0.0)


@njit_no_refcount
def _search_widening(avatar, m, extent, pose, scene, rows, beyond, first, last, front, count, scratch):
    """Search the voxels rows[first:last] for the nearest pair, within widening bounds.

    The bounds widen until a pair is found. A search that finds nothing costs little: nearly all
    nodes are far. Returns a lower bound of |a - b| + deficit of what was not searched because of
    the stop flag [steps]; inf: nothing.
    """
    best, gaps, classes = scratch.best, scratch.gaps, scratch.classes
    units, found, deficit, cut = best.units, best.found, best.deficit, best.cut
    # Under the radius model, no sphere here is larger than the largest minus this.
    base = deficit[classes[0]]
    for other in range(1, last - first):
        base = min(base, deficit[classes[other]])
    # Twice the radii: a distance of the size of the spheres. For spheres of radius 0, a share of
    # the reach.
    near = max(2 * (units[0] - base - beyond), (units[0] - base) >> 6, 1)
    searched = 0.0  # no pair is nearer: the bound of the last round that was completed
    while True:
        limit = units[0]
        if found[0] >= 0:
            limit = min(limit, units_to_beat(found_units(found), best.frame))
        bound = min(base + near, limit)
        units[1] = bound
        set_cut(cut, best.far, best.frame, deficit, bound)
        while True:
            # The nearest voxel first. Few are searched, therefore they are not sorted.
            at, least = -1, np.inf
            for other in range(last - first):
                if 0.0 <= gaps[other] <= min(least, np.float64(cut[classes[other]])):
                    at, least = other, gaps[other]
            if at < 0:
                break
            left = least
            if not stopped(scene.stop):
                gaps[at] = -1.0 - least
                left = _nearest_voxel(avatar, m, extent, pose, scene, rows[first + at], front, count, scratch)
            if left < np.inf:
                for other in range(last - first):
                    if gaps[other] >= 0.0:
                        left = min(left, gaps[other])
                # Nothing was pruned that is nearer than the pair found, or else than the bound.
                if found[0] < 0:
                    left = min(left, np.float64(units[1]) / best.frame[2] * (1.0 - 1e-12))
                return max(left, searched)
        if units[1] < bound or bound == limit:
            break
        # With a tolerance, a pair just beyond the bound may leave nothing within it worth finding.
        loose = best.frame[5] > 0.0 or best.frame[6] > 0.0
        if loose and found[0] >= 0 and units_to_beat(found_units(found), best.frame) <= bound:
            break
        near *= 4
        # 4 units: a pair that near to the bound does not lower it (`found_units`).
        searched = max(np.float64(bound - 4), 0.0) / best.frame[2] * (1.0 - 1e-12)
        for at in range(last - first):
            if gaps[at] < 0.0:
                gaps[at] = -1.0 - gaps[at]
    return np.inf


@nb.njit(nogil=True, cache=True)
def nearest_poses(
    poses, avatar, scene, reach, which, cursor, state, beyond, share, tolerance, nearest, counts
):
    """Answer `distance` for the poses numbered in `which`, each from its cursor on.

    poses: (k, 4, 4), checked.  avatar: not empty.  reach: VoxelsInReach of all k poses, to the
    largest distance requested.  cursor, state: as in `collide_poses`.  beyond: the part of the reach
    that is not the radii, exact units.
    share, tolerance: how much farther than the nearest pair the one found may be: this share of
    the nearest pair's |a - b|, or these exact units, whichever is more.
    Accumulates into `nearest` and counts (3, k) uint32 (voxels missing, node visits, point tests),
    whose initial values are -1, inf and 0. Once the scene's stop flag is set, `missing_bound` of the
    pose in hand bounds what was not searched, and the poses after it are not finished.
    """
    descent, front, most = make_descent(avatar), make_front(avatar), 0
    best = make_best_pair(scene.radius_deficit, descent)
    best.frame[5], best.frame[6] = share, tolerance
    for number in range(which.shape[0]):
        i = which[number]
        most = max(most, reach.lists.starts[i + 1] - cursor[i])
    scratch = _SearchScratch(descent, best, np.empty(most), np.empty(most, np.uint64))
    _nearest_poses(poses, avatar, scene, reach, which, cursor, state, beyond, nearest, counts, front, scratch)


@njit_no_refcount
def nothing_nearer(nearest, i, near, scene):
    """Return whether no voxel `near` steps away or farther has a nearer pair for pose i, or one that ties."""
    square = nearest.square[i]
    return square >= 0 and near * scene.units_per_step > pair_units(square, nearest.deficit[i])


@njit_no_refcount
def _nearest_poses(
    poses, avatar, scene, reach, which, cursor, state, beyond, nearest, counts, front, scratch
):
    """Implement `nearest_poses` with its scratch passed in."""
    placed, best, gaps, classes = scratch.descent.placed, scratch.best, scratch.gaps, scratch.classes
    rows, near = reach.lists.rows, reach.lists.near
    for number in range(which.shape[0]):
        i = which[number]
        first, end = cursor[i], reach.lists.starts[i + 1]
        last = first
        while last < end and state_of(state, rows[last]) != NOT_HELD:
            voxel, gap = rows[last], near[last]
            if state_of(state, voxel) == HELD:
                gaps[last - first] = gap
                classes[last - first] = leaf_class(scene.ints, scene.where[voxel, 0], best.mask)
            else:
                gaps[last - first], classes[last - first] = np.inf, U(0)
                counts[0, i] += np.uint32(1)
                nearest.missing_bound[i] = min(nearest.missing_bound[i], gap)
            last += 1
        if first == last:
            continue
        if stopped(scene.stop):
            return
        m = poses[i]
        extent, farthest = place_root(avatar, m, placed, scene)
        if avatar.first[avatar.front_first] >= 0:  # there are nodes below the front
            place_nodes(avatar, m, placed, scene)
        count = place_front(avatar, m, placed, scene, extent, front.bounds)
        best.frame[0], best.frame[1] = extent, farthest
        best.units[0], best.units[1] = reach.units[i], reach.units[i]
        best.found[0] = nearest.square[i]
        for r in range(6):
            best.found[1 + r] = nearest.pair[i, r]
        best.found[7] = nearest.deficit[i]
        best.counters[0], best.counters[1], best.counters[2] = 0, 0, 0
        best.frame[2], best.frame[3] = scene.units_per_step, scene.voxel_steps
        left = _search_widening(avatar, m, extent, i, scene, rows, beyond, first, last, front, count, scratch)
        nearest.missing_bound[i] = min(nearest.missing_bound[i], left, unsearched_bound(best))
        nearest.square[i] = best.found[0]
        for r in range(6):
            nearest.pair[i, r] = best.found[1 + r]
        nearest.deficit[i] = best.found[7]
        counts[1, i] += np.uint32(best.counters[0])
        counts[2, i] += np.uint32(best.counters[1])
        if last < end and nothing_nearer(nearest, i, near[last], scene):
            last = end
        cursor[i] = last


@njit_no_refcount
def _write_result(nearest, i, radii, reach, scene, result):
    """Write the results of pose i, see `nearest_resident`; return whether they are exact.

    radii: sum of the largest radii of avatar and scan, exact units.  reach: the largest distance
    requested [m], which may exceed the same in exact units by a rounding.
    queries/distance.py defines the signed distance, in this order of operations.
    """
    square, pair, deficit, signed = nearest.square[i], nearest.pair[i], nearest.deficit[i], np.inf
    for at in range(NORMAL, COLUMNS):
        result[at] = np.nan
    if square >= 0:
        own = radii - deficit
        above, root = np.float64(square - own * own), math.sqrt(np.float64(square))
        both = root + np.float64(own)
        signed = above / both / UNITS_PER_METRE if both > 0.0 else 0.0
        for r in range(3):
            apart = np.float64(pair[3 + r] - lattice_to_units(pair[r], scene.units_per_step))
            result[NORMAL + r] = apart / root if root > 0.0 else 0.0
            result[AVATAR + r] = np.float64(pair[3 + r]) / UNITS_PER_METRE + scene.origin[r]
            result[CLOUD + r] = np.float64(pair[r]) * scene.step + scene.origin[r]
    # Of what was not examined; no two centres are nearer than 0.
    depth = np.float64(radii) / UNITS_PER_METRE
    floor = nearest.missing_bound[i] * scene.step * (1.0 - 1e-12) - depth - 2.0 / UNITS_PER_METRE
    floor = max(floor, -depth)
    exact = floor >= (signed if square >= 0 else reach)
    result[SIGNED], result[LOWER] = signed, min(signed if exact else min(signed, floor), reach)
    return exact


@nb.njit(nogil=True, cache=True)
def write_results(nearest, radii, reach, scene, results, exact):
    """Write results (k, COLUMNS) of the pairs found, as `nearest_resident` does, and exact (k,) bool.

    radii: (k,) sums of the largest radii of avatar and scan, exact units.  reach: as requested [m].
    exact: whether nothing that was not examined can be nearer.
    """
    for i in range(radii.shape[0]):
        exact[i] = _write_result(nearest, i, radii[i], reach, scene, results[i])


@nb.njit(nogil=True, cache=True)
def nearest_resident(pose, body, radius, radius_units, reach_units, reach, held, stop, result):
    """Answer `distance` for one pose in one call, where the resident voxels suffice.

    They do if all in the pose's reach are resident, or all that can hold a pair nearer than the one
    found. This is `find_reach`, `nearest_poses` and `write_results`.

    pose: (1, 4, 4) float64, unchecked.  body, held: references to the arrays of the avatar and the
    scene (array_references.py).  stop: (1,) int64, the request's stop flag.  radius: of the avatar's
    points [m].  radius_units: radius of the scan's largest sphere, exact units.  reach_units: the
    reach, exact units.  reach: the same [m].
    Writes held.one, the voxels in reach, and result (COLUMNS,) float64: signed distance and its lower
    bound [m], normal, witness of the avatar, witness of the cloud, world [m]; inf and NaN where no
    pair is within reach.
    Returns (fault, value found), as `check_poses` does, then the number of voxels examined, node visits,
    point tests. -1 voxels: not answered, because a voxel has to be loaded, the rows do not fit, or the
    request was stopped.
    """
    avatar, scene, around = body.avatar, with_flag(held.scene, stop), held.one.reach
    fault, _, found, needed = find_reach(
        pose, avatar, radius, radius_units + reach_units, scene, held.tree, around
    )
    lists = around.lists
    front = resident_front(scene.where, lists.rows, needed)
    if fault != VALID or front < 0:
        return fault, found, -1, 0, 0
    nearest = NearestPairs(
        np.full(1, -1, np.int64), np.zeros((1, 6), np.int64), np.zeros(1, np.int64), np.full(1, np.inf)
    )
    counts, cursor = np.zeros((3, 1), np.uint32), held.one.cursor
    cursor[0], lists.starts[1] = 0, front
    if needed > 0:
        nearest_poses(
            pose, avatar, scene, around, held.one.which, cursor, held.one.all_held, reach_units, 0.0, 0.0,
            nearest, counts,
        )  # fmt: skip
        if stopped(stop) or (front < needed and not nothing_nearer(nearest, 0, lists.near[front], scene)):
            return fault, found, -1, 0, 0
    nearest.missing_bound[0] = np.inf
    _write_result(nearest, 0, around.units[0] - reach_units, reach, scene, result)
    return fault, found, front, np.int64(counts[1, 0]), np.int64(counts[2, 0])
