"""The nearest pair of two bounding sphere hierarchies under a pose: [Fig12] figures 5 and 6, made to measure.

Depth first, the nearest child first, with the best pair so far as the bound (branch and bound). A node pair is left
alone only when its lower bound, less what float32 may have lost, is above the best; a pair of points that float32
cannot tell from the best is squared in integers (NUMERICS.md N5). So the least square and which pair has it are those
of the definition, whatever the trees and the order.
"""

import math
from typing import NamedTuple

import numba as nb
import numpy as np
from numpy.typing import NDArray

from .layout import BLOCK_WORDS, COUNT, FIRST, LANES, ROW_WORDS
from .overlap import STACK
from .placed import ONE_SLACK, SLACK, make_limits, make_placed, place_block, place_nodes
from .placing import lattice_to_units, place, to_units

_1, _2, _3, _4, _5, _6, _7, _8, _9 = (np.uint64(column) for column in range(1, 10))


class Nearest(NamedTuple):
    """The nearest pair of each of k poses, among what was looked at.

    square: (k,) int64, |a - b|^2, exact units; -1: none within reach.  pair: (k, 6) int64, the scan point's lattice
    x, y, z, then the avatar's placed centre [exact units].  gap: (k,) float64, what missing voxels hold is at least so
    far from the avatar's centres [steps]; inf: nothing is missing.
    """

    square: NDArray[np.int64]
    pair: NDArray[np.int64]
    gap: NDArray[np.float64]


class Best(NamedTuple):
    """The nearest pair of one pose so far, and what it rules out; scratch of one call.

    found: (7,) int64, square or -1, then a row of `Nearest.pair`.  cut: (2,) float32, no node pair whose
    `lower_bound` is above cut[0] [steps] and no points whose square is above cut[1] can be nearer, or tie.
    frame: (4,) float64, extent and farthest of `make_limits`, units per step, voxel steps.  corner: (3,) int64, of the
    voxel looked at [steps].  keep, squares: (LANES,), of `keep_near` and `list_squares`.  units: (1,) int64, the reach.
    counters: (2,) int64, node visits, point tests.
    """

    found: NDArray[np.int64]
    cut: NDArray[np.float32]
    frame: NDArray[np.float64]
    corner: NDArray[np.int64]
    keep: NDArray[np.bool_]
    squares: NDArray[np.float32]
    units: NDArray[np.int64]
    counters: NDArray[np.int64]


@nb.njit(nogil=True, cache=True)
def make_best():
    """Scratch, nothing found."""
    return Best(
        np.empty(7, np.int64), np.empty(2, np.float32), np.empty(4), np.empty(3, np.int64), np.empty(LANES, np.bool_),
        np.empty(LANES, np.float32), np.empty(1, np.int64), np.zeros(2, np.int64),
    )  # fmt: skip


@nb.njit(nogil=True, cache=True)
def lower_bound(words, row, x, y, z, radius):
    """How far a sphere's points (float32, from the voxel's low corner) are from a node's at least [steps].

    The larger of the sphere's and the slab's bound, less all that float32 rounds here; negative where it says
    nothing. The errors of placed coordinates are not in it: they are in `Best.cut`.
    """
    at = np.uint64(row)  # not negative: spares a comparison for every index
    dx, dy, dz = x - words[at], y - words[at + _1], z - words[at + _2]
    apart = np.sqrt(dx * dx + dy * dy + dz * dz)
    both = words[at + _3] + radius
    along = words[at + _4] * dx + words[at + _5] * dy + words[at + _6] * dz
    gap = max(along - words[at + _9], words[at + _8] - along)
    # Without a slab gap is 0; its length is never 0, and rounded up.
    bound = max(apart - both, gap / words[at + _7] - radius)
    return bound - SLACK * (apart + both)


@nb.njit(nogil=True, cache=True)
def set_cut(cut, scales, units, square):
    """Rule out what is farther than a square (int64), or than the reach, `units`, where it is -1; see `Best`."""
    if square >= 0:
        # Two more than the root rounded down: nothing that ties is ruled out.
        units = np.int64(math.sqrt(np.float64(square))) + 2
    limits = make_limits(units, scales[2], scales[0], scales[1], scales[3])
    cut[0] = (limits.reach + limits.error) * ONE_SLACK
    cut[1] = limits.far


@nb.njit(nogil=True, cache=True)
def _consider(
    points, m, shift, block, lane, ints, halves, corner, block_at, lane_at, j, units_per_step, units, found
):  # fmt: skip
    """Take a pair as the best one if it is: nearer, or as near with the lesser scan point, then avatar's centre.

    points, shift: of Avatar and Placed.  corner: (3,) int64, of the voxel [steps]. The square is that of
    `pair_square`. Returns whether it is nearer.
    """
    square = np.int64(0)
    for r in range(3):
        world = place(m, shift, r, points[block, 0, lane], points[block, 1, lane], points[block, 2, lane])
        steps = corner[r] + np.int64(ints[block_at + r]) + np.int64(halves[lane_at + r * LANES + j])
        difference = to_units(world) - lattice_to_units(steps, units_per_step)
        if abs(difference) > units:
            return False
        square += difference * difference
    if square > units * units or (found[0] >= 0 and square > found[0]):
        return False
    nearer = found[0] < 0 or square < found[0]
    lesser = nearer
    for r in range(6):
        if r < 3:
            value = corner[r] + np.int64(ints[block_at + r]) + np.int64(halves[lane_at + r * LANES + j])
        else:
            world = place(
                m, shift, r - 3, points[block, 0, lane], points[block, 1, lane], points[block, 2, lane]
            )
            value = to_units(world)
        if not lesser:
            if value > found[1 + r]:
                return False
            lesser = value < found[1 + r]
        # While all before are equal this writes what is there.
        found[1 + r] = value
    found[0] = square
    return nearer


@nb.njit(nogil=True, cache=True)
def keep_near(lanes, block, words, row, off_x, off_y, off_z, cut, keep):
    """Which points of an avatar's block (LANES) may be within `cut` [steps] of a scene node; writes keep (LANES,)."""
    at = np.uint64(row)
    cx, cy, cz = words[at] + off_x, words[at + _1] + off_y, words[at + _2] + off_z
    nx, ny, nz = words[at + _4], words[at + _5], words[at + _6]
    both = words[at + _3] + cut
    room = words[at + _7] * (cut + SLACK * both + SLACK * both)
    least, most = words[at + _8] - room, words[at + _9] + room
    limit = both * both * ONE_SLACK
    for j in range(LANES):
        dx, dy, dz = lanes[block, 0, j] - cx, lanes[block, 1, j] - cy, lanes[block, 2, j] - cz
        along = nx * dx + ny * dy + nz * dz
        keep[j] = (dx * dx + dy * dy + dz * dz <= limit) & (along <= most) & (along >= least)


@nb.njit(nogil=True, cache=True)
def any_near(halves, lane_at, x, y, z, far):
    """Whether any of a scene block's points is within a square of a point, both from the block's low corner."""
    # Unsigned: an index that may be negative, as numba sees it, is not vectorised, 70 ns for 32 lanes and not 5.
    at_x = np.uint64(lane_at)
    at_y, at_z = at_x + np.uint64(LANES), at_x + np.uint64(2 * LANES)
    near = False
    for lane in range(LANES):
        j = np.uint64(lane)
        dx, dy = np.float32(halves[at_x + j]) - x, np.float32(halves[at_y + j]) - y
        dz = np.float32(halves[at_z + j]) - z
        near |= dx * dx + dy * dy + dz * dz <= far
    return near


@nb.njit(nogil=True, cache=True)
def list_squares(halves, lane_at, x, y, z, squares):
    """The squares (LANES,) of the distances of a scene block's points to a point; returns the lane of the least."""
    at_x = np.uint64(lane_at)
    at_y, at_z = at_x + np.uint64(LANES), at_x + np.uint64(2 * LANES)
    for lane in range(LANES):
        j = np.uint64(lane)
        dx, dy = np.float32(halves[at_x + j]) - x, np.float32(halves[at_y + j]) - y
        dz = np.float32(halves[at_z + j]) - z
        squares[j] = dx * dx + dy * dy + dz * dz
    first, least = 0, squares[0]
    for lane in range(1, LANES):
        if squares[lane] < least:
            first, least = lane, squares[lane]
    return first


@nb.njit(nogil=True, cache=True)
def search_lanes(
    points, m, shift, block, lane, ints, halves, corner, block_at, lane_at, x, y, z, scales, units, best_squares,
    best_found, cut,
):  # fmt: skip
    """Take the best of the pairs of one avatar point (float32 x, y, z from the block's low corner) and a scene block.

    The nearest first: it shrinks the cut, and few of the others are asked in integers after it.
    scales: (4,) float64, `Best.frame`.
    """
    first = list_squares(halves, lane_at, x, y, z, best_squares)
    for number in range(-1, LANES):
        j = first if number < 0 else number
        if best_squares[j] <= cut[1] and (number < 0 or j != first):
            nearer = _consider(
                points,
                m,
                shift,
                block,
                lane,
                ints,
                halves,
                corner,
                block_at,
                lane_at,
                j,
                scales[2],
                units,
                best_found,
            )
            if nearer:
                set_cut(cut, scales, units, best_found[0])


@nb.njit(nogil=True, cache=True)
def _push(stack, keys, begin, depth, a, row, key):
    """Put a pair into stack[begin:depth], which descends by key; the least lies on top."""
    at = depth
    while at > begin and keys[at - 1] < key:
        stack[at, 0], stack[at, 1], keys[at] = stack[at - 1, 0], stack[at - 1, 1], keys[at - 1]
        at -= 1
    stack[at, 0], stack[at, 1], keys[at] = a, row, key


@nb.njit(nogil=True, cache=True)
def _nearest_voxel(avatar, m, pose, placed, scene, voxel, stack, keys, off, best):
    """Search one resident voxel for a nearer pair: the two trees descended together, depth first."""
    # Every array by its own name, once: unpacked in the loop they are counted up and down, atomically, which took
    # most of the time.
    words, ints, halves = scene.words, scene.ints, scene.halves
    nodes, lanes, stamp = placed.nodes, placed.lanes, placed.stamp
    cut, keep, squares, counters = best.cut, best.keep, best.squares, best.counters
    found, frame, units, corner = best.found, best.frame, best.units[0], best.corner
    avatar_first, avatar_count, points, shift = avatar.first, avatar.count, avatar.points, placed.shift
    base, block_base, lane_base = scene.where[voxel, 0], scene.where[voxel, 1], scene.where[voxel, 2]
    for r in range(3):
        corner[r] = scene.coordinates[voxel, r] * scene.voxel_steps
        off[r] = np.float32(corner[r] - placed.frame[r])
    counters[0] += 1
    stack[0, 0], stack[0, 1] = 0, base
    keys[0] = lower_bound(
        words, base, nodes[0, 0] - off[0], nodes[1, 0] - off[1], nodes[2, 0] - off[2], nodes[3, 0]
    )
    depth = 1
    while depth > 0:
        depth -= 1
        if keys[depth] > cut[0]:
            continue
        a, row = stack[depth, 0], stack[depth, 1]
        a_first, b_first = avatar_first[a], ints[row + FIRST]
        begin = depth
        if a_first < 0 and b_first < 0:
            block, scene_block = ~a_first, ~b_first
            if stamp[block] != pose:
                place_block(avatar, m, block, placed, scene)
                stamp[block] = pose
            block_at = block_base + scene_block * BLOCK_WORDS
            lane_at = lane_base + scene_block * 3 * LANES
            lx = off[0] + np.float32(ints[block_at])
            ly = off[1] + np.float32(ints[block_at + 1])
            lz = off[2] + np.float32(ints[block_at + 2])
            keep_near(lanes, block, words, row, off[0], off[1], off[2], cut[0], keep)
            for lane in range(avatar_count[a]):
                if not keep[lane]:
                    continue
                x, y, z = lanes[block, 0, lane] - lx, lanes[block, 1, lane] - ly, lanes[block, 2, lane] - lz
                counters[1] += LANES
                if any_near(halves, lane_at, x, y, z, cut[1]):
                    search_lanes(
                        points, m, shift, block, lane, ints, halves, corner, block_at, lane_at, x, y, z, frame, units,
                        squares, found, cut,
                    )  # fmt: skip
        elif b_first < 0 or (a_first >= 0 and nodes[3, a] > words[row + 3]):
            counters[0] += avatar_count[a]
            for child in range(a_first, a_first + avatar_count[a]):
                key = lower_bound(
                    words, row, nodes[0, child] - off[0], nodes[1, child] - off[1], nodes[2, child] - off[2],
                    nodes[3, child],
                )  # fmt: skip
                if key <= cut[0]:
                    _push(stack, keys, begin, depth, child, row, key)
                    depth += 1
        else:
            x, y, z = nodes[0, a] - off[0], nodes[1, a] - off[1], nodes[2, a] - off[2]
            counters[0] += ints[row + COUNT]
            for i in range(ints[row + COUNT]):
                child_row = base + (b_first + i) * ROW_WORDS
                key = lower_bound(words, child_row, x, y, z, nodes[3, a])
                if key <= cut[0]:
                    _push(stack, keys, begin, depth, a, child_row, key)
                    depth += 1


@nb.njit(nogil=True, cache=True)
def box_gap(root, placed, farthest, scene, index, voxel):
    """How far the avatar's centres are from all points of a voxel at least [steps], from the index; not below 0.

    root: radius of the avatar's root sphere, scaled [m].  farthest: of `place_nodes`.
    """
    square = 0.0
    for r in range(3):
        center = placed.frame[r]  # the root's centre, to half a step an axis
        gap = np.float64(max(index.low[voxel, r] - center, center - index.high[voxel, r], 0))
        square += gap * gap
    # One step for the frame's rounding; for the others see `make_limits`.
    error = 1.0 + 2.0 / scene.units_per_step + farthest * 2.0**-46
    return max(math.sqrt(square) * (1.0 - 1e-9) - root / scene.step * (1.0 + 1e-9) - error, 0.0)


@nb.njit(nogil=True, cache=True)
def nearest_poses(poses, avatar, scene, index, reach, which, nearest, counts):
    """Answer `distance` for the poses numbered in `which`: one call a request, all its poses and voxels.

    poses: (k, 4, 4), checked.  avatar: not empty.  reach: Reach of these poses (reach.py), to the farthest distance of
    interest; a voxel in it that is not resident is counted as missing.
    Adds to what `nearest` and counts (3, k) uint32 (voxels missing, node visits, point tests) hold, -1, inf and 0 to
    begin with, so that a pose may be answered in pieces.
    """
    placed, best = make_placed(avatar), make_best()
    stack, keys = np.empty((STACK, 2), np.int64), np.empty(STACK, np.float32)
    off = np.empty(3, np.float32)
    for number in range(which.shape[0]):
        i = which[number]
        first, last = reach.starts[i], reach.starts[i + 1]
        if first == last:
            continue
        best.frame[0], best.frame[1] = place_nodes(avatar, poses[i], reach.scales[i], placed, scene)
        best.units[0] = reach.units[i]
        best.found[0] = nearest.square[i]
        best.found[1:] = nearest.pair[i]
        best.counters[:] = 0
        best.frame[2], best.frame[3] = scene.units_per_step, scene.voxel_steps
        set_cut(best.cut, best.frame, best.units[0], best.found[0])
        gaps = np.full(last - first, np.inf)
        for at in range(first, last):
            root = avatar.radius[0] * reach.scales[i]
            gap = box_gap(root, placed, best.frame[1], scene, index, reach.rows[at])
            if scene.where[reach.rows[at], 0] >= 0:
                gaps[at - first] = gap
            else:
                counts[0, i] += np.uint32(1)
                nearest.gap[i] = min(nearest.gap[i], gap)
        for at in np.argsort(gaps) if last - first > 1 else np.zeros(1, np.int64):
            if gaps[at] > best.cut[0]:
                break
            _nearest_voxel(avatar, poses[i], i, placed, scene, reach.rows[first + at], stack, keys, off, best)
        nearest.square[i] = best.found[0]
        nearest.pair[i] = best.found[1:]
        counts[1, i] += np.uint32(best.counters[0])
        counts[2, i] += np.uint32(best.counters[1])
