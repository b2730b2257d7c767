"""Nearest pair of two bounding sphere hierarchies under a pose, after [Fig12] figures 5 and 6.

This is branch and bound, with the best pair so far as the bound. The scene's tree is descended with
a list of those nodes of the avatar's front that may hold a nearer pair, as in collide_poses.py,
where the reach is the bound. A node is pruned only if its lower bound, minus the largest float32
error, exceeds the best; the radius class of the largest sphere below a node sets its bound.
nearest_pair.py defines nearest and handles the points.

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
from ..core.kernel_decorators import njit_inlined, njit_no_refcount
from ..core.node_bounds import (
    BROAD,
    FLAT,
    U32,
    compact_marked,
    copy_node,
    lanes_meet,
    locate_block,
    locate_voxel,
    mark_meeting,
    nodes_meet,
)
from ..core.placed_avatar import (
    AvatarFront,
    PlacedAvatar,
    lattice_to_units,
    make_front,
    make_placed,
    pad_list,
    place_block_once,
    place_front,
    place_lanes,
    place_nodes,
    place_root,
)
from ..core.reach import HELD, NOT_HELD, VALID, find_reach, resident_front, state_of
from ..core.scene_arrays import (
    COUNT,
    COUNTED,
    FIRST,
    LANES,
    ROW_WORDS,
    leaf_class,
    node_class,
    stopped,
)
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

    placed, front: the avatar under the pose in hand.  best: the pair found.
    gaps: for each voxel of the pose's list, its `near`; inf: missing.  classes: of their largest
    spheres.
    """

    placed: PlacedAvatar
    front: AvatarFront
    best: BestPair
    gaps: NDArray[np.float64]
    classes: NDArray[np.uint64]


@njit_inlined
def _search_leaves(m, a, row, avatar, placed, scene, location, best):
    """Update the best pair from an avatar's leaf node (its marked points) and a scene's."""
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


@njit_no_refcount
def _push(below, keys, begin, depth, a, key):
    """Insert a node into below[begin:depth], sorted by descending key; the least key is on top."""
    at = depth
    while at > begin and keys[at - 1] < key:
        below[at], keys[at] = below[at - 1], keys[at - 1]
        at -= 1
    below[at], keys[at] = a, key


@njit_no_refcount
def _search_below(avatar, m, pose, a, row, placed, scene, location, best):
    """Search a scene leaf node for a point nearer to a point below a node of the avatar's front.

    The avatar's node is descended depth first, the nearest child first. This is for avatars whose
    front is not their leaf nodes.
    """
    words, nodes, firsts, held = scene.words, placed.nodes, avatar.first, avatar.count
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
                _search_leaves(m, a, row, avatar, placed, scene, location, best)
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


@njit_no_refcount
def _nearest_voxel(avatar, m, pose, scene, voxel, count, scratch):
    """Search one resident voxel for a nearer pair; return `_least_left`.

    The descent is that of collide_poses.py, and the function is long for the same reason.
    """
    words, ints, placed, front, best = scene.words, scene.ints, scratch.placed, scratch.front, scratch.best
    nodes, lanes, stamp = placed.nodes, placed.lanes, placed.stamp
    cut, keep, counters, corner, off = best.cut, best.keep, best.counters, best.corner, best.off
    bounds, which, listed, listed8 = front.bounds, front.which, front.keep, front.keep8
    firsts, front_first, points = avatar.first, avatar.front_first, avatar.points
    stack, mask = best.stack, best.mask
    shift, frame, step, stop = placed.shift, placed.frame, scene.step, scene.stop
    location = locate_voxel(scene, voxel, placed)
    off_x, off_y, off_z = location.x, location.y, location.z
    off[0], off[1], off[2] = off_x, off_y, off_z
    for r in range(3):
        corner[r] = scene.corners[voxel, r]
    counters[0] += 1
    x, y, z, radius = nodes[0, 0] - off_x, nodes[1, 0] - off_y, nodes[2, 0] - off_z, nodes[3, 0]
    broad = BROAD * radius
    if not nodes_meet(words, location.rows, x, y, z, radius, cut[node_class(ints, location.rows, mask)]):
        return np.inf
    stack[0, 0], stack[0, 1], stack[0, 2] = location.rows, 0, count
    depth, cut_short = 1, False
    while depth > 0 and not stopped(stop):
        depth -= 1
        row, at, count = stack[U(depth), 0], stack[U(depth), 1], stack[U(depth), 2]
        first = np.int64(ints[U(row + FIRST)])
        c = node_class(ints, row, mask)
        if first < 0 or words[U(row + 3)] < broad:
            counters[0] += count
            steps = (count + LANES - 1) // LANES
            if not mark_meeting(words, row, bounds, at, steps, off_x, off_y, off_z, cut[c], listed):
                continue
            to = at + steps * LANES
            count = compact_marked(bounds, which, listed, listed8, at, steps, to)
            at = to
            thick = words[U(row + 9)] - words[U(row + 8)]
            if first < 0 or thick < FLAT * abs(words[U(row + 7)]) * bounds[3, U(at)]:
                left = at
                for i in range(at, at + count):
                    a = front_first + np.int64(which[U(i)])
                    a_first = np.int64(firsts[U(a)])
                    if a_first < 0:
                        block = ~a_first
                        if stamp[U(block)] != pose:
                            place_lanes(points, m, block, lanes, shift, frame, step)
                            stamp[U(block)] = pose
                        counters[0] += 1
                        if not lanes_meet(words, row, lanes, block, off_x, off_y, off_z, cut[c], keep):
                            continue
                        if first < 0:
                            _search_leaves(m, a, row, avatar, placed, scene, location, best)
                            continue
                    elif first < 0:
                        _search_below(avatar, m, pose, a, row, placed, scene, location, best)
                        cut_short = stopped(stop)
                        continue
                    copy_node(bounds, which, U(i), U(left))
                    left += 1
                if left == at:  # always true at a leaf
                    continue
                pad_list(bounds, left, at + (count + LANES - 1) // LANES * LANES)
                count = left - at
        children = np.int64(ints[U(row + COUNT)] & COUNTED)
        child = location.rows + first * ROW_WORDS
        counters[0] += children
        for _ in range(children):
            stack[U(depth), 0], stack[U(depth), 1], stack[U(depth), 2] = child, at, count
            if nodes_meet(words, child, x, y, z, radius, cut[node_class(ints, child, mask)]):
                depth += 1
            child += ROW_WORDS
    settle_candidates(best, points, m, placed.shift, ints, scene.halves, lanes)
    # The last node taken from the stack is still there, and may be searched only in part.
    return _least_left(words, bounds, stack, depth + 1 if cut_short else depth, off, best.frame[4])


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
def _search_widening(m, pose, avatar, scene, rows, beyond, first, last, count, scratch):
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
                left = _nearest_voxel(avatar, m, pose, scene, rows[first + at], count, scratch)
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
    best, most = make_best_pair(scene.radius_deficit), 0
    best.frame[5], best.frame[6] = share, tolerance
    for number in range(which.shape[0]):
        i = which[number]
        most = max(most, reach.lists.starts[i + 1] - cursor[i])
    scratch = _SearchScratch(
        make_placed(avatar), make_front(avatar), best, np.empty(most), np.empty(most, np.uint64)
    )
    _nearest_poses(poses, avatar, scene, reach, which, cursor, state, beyond, nearest, counts, scratch)


@njit_no_refcount
def nothing_nearer(nearest, i, near, scene):
    """Return whether no voxel `near` steps away or farther has a nearer pair for pose i, or one that ties."""
    square = nearest.square[i]
    return square >= 0 and near * scene.units_per_step > pair_units(square, nearest.deficit[i])


@njit_no_refcount
def _nearest_poses(poses, avatar, scene, reach, which, cursor, state, beyond, nearest, counts, scratch):
    """Implement `nearest_poses` with its scratch passed in."""
    placed, best, gaps, classes = scratch.placed, scratch.best, scratch.gaps, scratch.classes
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
        best.frame[0], best.frame[1] = place_root(avatar, poses[i], placed, scene)
        if avatar.first[avatar.front_first] >= 0:  # there are nodes below the front
            place_nodes(avatar, poses[i], placed, scene)
        count = place_front(avatar, poses[i], placed, scene, best.frame[0], scratch.front.bounds)
        best.units[0], best.units[1] = reach.units[i], reach.units[i]
        best.found[0] = nearest.square[i]
        for r in range(6):
            best.found[1 + r] = nearest.pair[i, r]
        best.found[7] = nearest.deficit[i]
        best.counters[0], best.counters[1], best.counters[2] = 0, 0, 0
        best.frame[2], best.frame[3] = scene.units_per_step, scene.voxel_steps
        left = _search_widening(poses[i], i, avatar, scene, rows, beyond, first, last, count, scratch)
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
    queries/context/queries/distance.py defines the signed distance, in this order of operations.
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
