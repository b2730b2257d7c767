"""The nearest pair of points so far, and what it rules out: what `distance` and the bounded search share.

Float32 tells nearly all pairs of points from the best; those that it cannot tell are squared in integers (NUMERICS.md
N5). So the least square, and which pair has it, are those of the definition, whatever the trees and the order.
"""

import math
from typing import NamedTuple

import numba as nb
import numpy as np
from numpy.typing import NDArray

from .compiled import borrowing, inlined
from .layout import LANES
from .placed import ONE_SLACK, SLACK, U32, make_limits
from .placing import lattice_to_units, place, to_units

U = np.uint64  # see front.py
# Pairs that float32 cannot tell from the best; ties are legion on coarse lattices, so a full list is settled.
MOST_CANDIDATES = 64


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

    found: (7,) int64, square or -1, then a row of `Nearest.pair`.  cut: (3,) float32, no node pair whose
    `lower_bound` is above cut[0] [steps] and no points whose square is above cut[1] can be nearer, or tie; cut[2] is
    the error of a distance [steps].
    frame: (4,) float64, extent and farthest of `make_limits`, units per step, voxel steps.  corner: (3,) int64, of the
    voxel looked at [steps].  keep, squares: (LANES,), a mark and a square for each point of an avatar's block; keep8:
    keep as uint64, eight at a time.  listed: (LANES,) float32, a square for each point of a scene's block.
    units: (2,) int64, the reach, and what is known to be no less than the least distance, exact units.
    counters: (3,) int64, node visits, point tests, candidates.
    candidates: (MOST_CANDIDATES, 4) int64, points of the avatar that may be of the nearest pair, and where in the
    scene: block, lane, block_at, lane_at.  nearly: (MOST_CANDIDATES,) float32, their least squares there.
    """

    found: NDArray[np.int64]
    cut: NDArray[np.float32]
    frame: NDArray[np.float64]
    corner: NDArray[np.int64]
    keep: NDArray[np.bool_]
    keep8: NDArray[np.uint64]
    squares: NDArray[np.float32]
    listed: NDArray[np.float32]
    units: NDArray[np.int64]
    counters: NDArray[np.int64]
    candidates: NDArray[np.int64]
    nearly: NDArray[np.float32]


@nb.njit(nogil=True, cache=True)
def make_best():
    """Scratch, nothing found."""
    keep = np.zeros(LANES, np.bool_)
    return Best(
        np.empty(7, np.int64), np.empty(3, np.float32), np.empty(4), np.empty(3, np.int64), keep,
        keep.view(np.uint64), np.empty(LANES, np.float32), np.empty(LANES, np.float32), np.empty(2, np.int64),
        np.zeros(3, np.int64), np.empty((MOST_CANDIDATES, 4), np.int64), np.empty(MOST_CANDIDATES, np.float32),
    )  # fmt: skip


@borrowing
def lower_bound(words, row, x, y, z, radius):
    """How far a sphere's points (float32, from the voxel's low corner) are from a node's at least [steps].

    The larger of the sphere's and the slab's bound, less all that float32 rounds here; negative where it says
    nothing. The errors of placed coordinates are not in it: they are in `Best.cut`.
    """
    at = U(row)  # not negative: spares a comparison for every index
    dx, dy, dz = x - words[at], y - words[at + U(1)], z - words[at + U(2)]
    apart = np.sqrt(dx * dx + dy * dy + dz * dz)
    both = words[at + U(3)] + radius
    along = words[at + U(4)] * dx + words[at + U(5)] * dy + words[at + U(6)] * dz
    gap = max(along - words[at + U(9)], words[at + U(8)] - along)
    # Without a slab gap is 0; its length is never 0, and rounded up.
    bound = max(apart - both, gap / words[at + U(7)] - radius)
    return bound - SLACK * (apart + both)


@borrowing
def set_cut(cut, scales, units, square):
    """Rule out what is farther than a square (int64), or than the reach, `units`, where it is -1; see `Best`."""
    if square >= 0:
        # Two more than the root rounded down: nothing that ties is ruled out.
        units = np.int64(math.sqrt(np.float64(square))) + 2
    limits = make_limits(units, scales[2], scales[0], scales[1], scales[3])
    cut[0] = (limits.reach + limits.error) * ONE_SLACK
    cut[1] = limits.far
    cut[2] = limits.error


@borrowing
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


@inlined
def keep_near(lanes, block, words, row, off_x, off_y, off_z, cut, keep):
    """Which points of an avatar's block (LANES) may be within `cut` [steps] of a scene node; writes keep (LANES,).

    Returns whether any may.
    """
    at = U(row)
    cx, cy, cz = words[at] + off_x, words[at + U(1)] + off_y, words[at + U(2)] + off_z
    nx, ny, nz = words[at + U(4)], words[at + U(5)], words[at + U(6)]
    both = words[at + U(3)] + cut
    room = words[at + U(7)] * (cut + SLACK * both + SLACK * both)
    least, most = words[at + U(8)] - room, words[at + U(9)] + room
    limit = both * both * ONE_SLACK
    b, any_near = U(block), False
    for lane in range(LANES):
        j = U(lane)
        dx, dy, dz = lanes[b, 0, j] - cx, lanes[b, 1, j] - cy, lanes[b, 2, j] - cz
        along = nx * dx + ny * dy + nz * dz
        near = (dx * dx + dy * dy + dz * dz <= limit) & (along <= most) & (along >= least)
        keep[j] = near
        any_near |= near
    return any_near


@borrowing
def any_near(halves, lane_at, x, y, z, far):
    """Whether any of a scene block's points is within a square of a point, both from the block's low corner."""
    # Unsigned: an index that may be negative, as numba sees it, is not vectorised, 70 ns for 32 lanes and not 5.
    at_x = U(lane_at)
    at_y, at_z = at_x + U(LANES), at_x + U(2 * LANES)
    near = False
    for lane in range(LANES):
        j = U(lane)
        dx, dy = np.float32(halves[at_x + j]) - x, np.float32(halves[at_y + j]) - y
        dz = np.float32(halves[at_z + j]) - z
        near |= dx * dx + dy * dy + dz * dz <= far
    return near


@borrowing
def list_squares(halves, lane_at, x, y, z, squares):
    """The squares (LANES,) of the distances of a scene block's points to a point; returns the lane of the least."""
    at_x = U(lane_at)
    at_y, at_z = at_x + U(LANES), at_x + U(2 * LANES)
    for lane in range(LANES):
        j = U(lane)
        dx, dy = np.float32(halves[at_x + j]) - x, np.float32(halves[at_y + j]) - y
        dz = np.float32(halves[at_z + j]) - z
        squares[j] = dx * dx + dy * dy + dz * dz
    first, least = 0, squares[0]
    for lane in range(1, LANES):
        if squares[lane] < least:
            first, least = lane, squares[lane]
    return first


@borrowing
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


@inlined
def keep_in_box(halves, lane_at, low_x, low_y, low_z, lanes, block, far, keep):
    """Unmark, of the marked points of an avatar's block, those that the box of a scene's block alone shows to be beyond
    `far`, a square; arguments as of `least_squares`.

    Nothing is added for rounding: it is monotonic, so each difference here is no larger than those of the points.
    """
    h, b = U(lane_at), U(block)
    high_x, high_y, high_z = np.int32(0), np.int32(0), np.int32(0)
    for j in range(LANES):
        i = h + U(j)
        high_x = max(high_x, np.int32(halves[i]))
        high_y = max(high_y, np.int32(halves[i + U(LANES)]))
        high_z = max(high_z, np.int32(halves[i + U(2 * LANES)]))
    most_x, most_y, most_z = np.float32(high_x), np.float32(high_y), np.float32(high_z)
    zero = np.float32(0.0)
    for lane in range(LANES):
        u = U(lane)
        x, y, z = lanes[b, 0, u] - low_x, lanes[b, 1, u] - low_y, lanes[b, 2, u] - low_z
        dx, dy, dz = max(x - most_x, -x), max(y - most_y, -y), max(z - most_z, -z)
        dx, dy, dz = max(dx, zero), max(dy, zero), max(dz, zero)
        keep[u] = keep[u] & (dx * dx + dy * dy + dz * dz <= far)


@inlined
def least_squares(halves, lane_at, low_x, low_y, low_z, lanes, block, keep, keep8, squares):
    """The least square of the distances of each marked point of an avatar's block to a scene's block; writes squares.

    lane_at: the scene's block in `halves`; low: its corner from the frame. Returns (least of all, points tested).
    """
    h, b = U(lane_at), U(block)
    best, tested = np.float32(np.inf), 0
    for eight in range(LANES // 8):
        if keep8[U(eight)] == U(0):
            continue
        for lane in range(8 * eight, 8 * eight + 8):
            if not keep[U(lane)]:
                continue
            tested += 1
            x, y, z = lanes[b, 0, U(lane)] - low_x, lanes[b, 1, U(lane)] - low_y, lanes[b, 2, U(lane)] - low_z
            # The bits of numbers that are not negative are in the order of the numbers, and the least of integers is
            # taken in vector steps, where that of floats is not: there may be a NaN, as far as LLVM knows.
            least = np.int32(0x7F800000)
            for j in range(LANES):
                i = h + U(j)
                dx = np.float32(halves[i]) - x
                dy = np.float32(halves[i + U(LANES)]) - y
                dz = np.float32(halves[i + U(2 * LANES)]) - z
                least = min(least, np.float32(dx * dx + dy * dy + dz * dz).view(np.int32))
            bits = np.int32(least)
            square = bits.view(np.float32)
            squares[U(lane)] = square
            best = min(best, square)
    return best, tested


@borrowing
def take_candidates(least, block, block_at, lane_at, off, best, points, m, shift, ints, halves, lanes):
    """Take up what `least_squares` found, `least` of it within the cut: shrinks the cut, without integers.

    Those are for `settle`, at the end: where the cut shrinks as points come, ten or twenty are the nearest for a while.
    """
    cut, units, counters, nearly = best.cut, best.units, best.counters, best.nearly
    candidates, keep, squares = best.candidates, best.keep, best.squares
    # No farther than that: as `make_limits` has it, and a unit for rounding up.
    steps = math.sqrt(np.float64(least)) * (1.0 + 8.0 * U32) + np.float64(cut[2])
    nearer = np.int64(steps * best.frame[2]) + 2
    if nearer < units[1]:
        units[1] = nearer
        set_cut(cut, best.frame, nearer, -1)
        left = 0
        for i in range(counters[2]):
            if nearly[i] <= cut[1]:
                nearly[left] = nearly[i]
                for r in range(4):
                    candidates[left, r] = candidates[i, r]
                left += 1
        counters[2] = left
    for lane in range(LANES):
        if not keep[lane] or not squares[lane] <= cut[1]:
            continue
        if counters[2] == MOST_CANDIDATES:
            settle(best, points, m, shift, ints, halves, lanes, off)
        at = counters[2]
        candidates[at, 0], candidates[at, 1], candidates[at, 2], candidates[at, 3] = (
            block,
            lane,
            block_at,
            lane_at,
        )
        nearly[at] = squares[lane]
        counters[2] = at + 1


@borrowing
def settle(best, points, m, shift, ints, halves, lanes, off):
    """Square the candidates of one voxel in integers and keep the nearest pair; leaves no candidates.

    points: (b, 3, LANES) of Avatar.  lanes: of Placed.  off: (3,) float32, from the frame to the voxel's low corner.
    """
    cut, frame, found, squares, units = best.cut, best.frame, best.found, best.listed, best.units
    for i in range(best.counters[2]):
        if best.nearly[i] > cut[1]:
            continue
        block, lane = best.candidates[i, 0], best.candidates[i, 1]
        block_at, lane_at = best.candidates[i, 2], best.candidates[i, 3]
        x = lanes[block, 0, lane] - (off[0] + np.float32(ints[block_at]))
        y = lanes[block, 1, lane] - (off[1] + np.float32(ints[block_at + 1]))
        z = lanes[block, 2, lane] - (off[2] + np.float32(ints[block_at + 2]))
        list_squares(halves, lane_at, x, y, z, squares)
        for j in range(LANES):
            if squares[j] <= cut[1]:
                _consider(
                    points, m, shift, block, lane, ints, halves, best.corner, block_at, lane_at, j, frame[2],
                    units[0], found,
                )  # fmt: skip
    best.counters[2] = 0
    if found[0] >= 0:
        nearest = np.int64(math.sqrt(np.float64(found[0]))) + 2
        if nearest < units[1]:
            units[1] = nearest
            set_cut(cut, frame, nearest, -1)
