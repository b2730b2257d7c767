"""Nearest pair of points so far, and the bounds by which it prunes the search.

The nearest pair is the one with the least separation of its spheres, |a - b| - (r_a + r_b). r_a is
the same for all pairs, and the scan point's radius is the largest radius minus the `deficit` of its
class. The search therefore compares |a - b| + deficit. A bound on it, minus the deficit of a class,
is a bound on |a - b| of the pairs of that class.

The points of two leaf nodes are compared in float32, all LANES of a block in one vector step. Avatar
points are placed: their coordinates are relative to the frame or to the block's low corner. Scene
points are whole steps from the low corner of their block.

Float32 separates nearly all pairs of points from the best one. The pairs it cannot separate are
squared in integers (NUMERICS.md N5) and compared by `compare_separations`. The least separation, and
the pair that has it, are therefore those of the definition, for every tree and order.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ....schemas.runtime import compiling as nb
from ..core.kernel_decorators import njit_inlined, njit_no_refcount
from ..core.node_bounds import (
    ONE_SLACK,
    SLACK,
    STACK,
    U32,
    box_square,
    has_box,
    make_thresholds,
    write_squares,
)
from ..core.placed_avatar import compare_separations, lattice_point, place_units, square_apart
from ..core.scene_arrays import LANES, point_class

U = np.uint64  # see placed_avatar.py
# Pairs that float32 cannot separate from the best. Coarse lattices have many ties; a full list is
# settled.
MAX_CANDIDATES = 64


class NearestPairs(NamedTuple):
    """Nearest pair of each of k poses, among the voxels searched.

    square: (k,) int64, |a - b|^2, exact units; -1: none within reach.
    pair: (k, 6) int64, the scan point's lattice x, y, z, then the avatar's placed centre [exact
    units].
    deficit: (k,) int64, the largest radius minus the scan point's radius, exact units.
    missing_bound: (k,) float64, a lower bound of the distance of the avatar's centres from what
    missing voxels hold, and of |a - b| + deficit of what was not searched [steps]; inf: nothing is
    missing, and all was searched.
    """

    square: NDArray[np.int64]
    pair: NDArray[np.int64]
    deficit: NDArray[np.int64]
    missing_bound: NDArray[np.float64]


class BestPair(NamedTuple):
    """Nearest pair of one pose so far, and the bounds by which it prunes; scratch of one call.

    found: (8,) int64, square or -1, a row of `NearestPairs.pair`, deficit.
    cut, far: (n,) float32, by radius class: no node pair whose `lower_bound` is above cut[c]
    [steps] and no pair of points whose square is above far[c] can be nearer, or tie.
    deficit: (n,) int64, of SceneArrays.  mask: the number of classes minus one, uint64.
    frame: (8,) float64, extent and farthest of `make_thresholds`, units per step, voxel steps; the
    error of a distance [steps]; tolerance as a share of |a - b|, tolerance [exact units]; the
    largest deficit.
    corner: (3,) int64, low corner of the current voxel [steps].
    keep, keep8, counters: of the descent; the last counter is that of candidates.
    squares: (LANES,) float32, a square for each point of an avatar's block.
    block_squares: (LANES,) float32, a square for each point of a scene block.
    units: (2,) int64, exact units: the reach, and an upper bound of the least |a - b| + deficit.
    candidates: (MAX_CANDIDATES, 5) int64, points of the avatar that may belong to the nearest
    pair, and their place in the scene: block, lane, block_at, lane_at, class of the leaf node.
    candidate_squares: (MAX_CANDIDATES,) float32, their least squares there.
    below: (STACK,) int64, avatar nodes below its front; keys: (STACK,) float32, their lower bounds.
    off: (3,) float32, from the frame to the voxel's low corner.
    """

    found: NDArray[np.int64]
    cut: NDArray[np.float32]
    far: NDArray[np.float32]
    deficit: NDArray[np.int64]
    mask: np.uint64
    frame: NDArray[np.float64]
    corner: NDArray[np.int64]
    keep: NDArray[np.bool_]
    keep8: NDArray[np.uint64]
    squares: NDArray[np.float32]
    block_squares: NDArray[np.float32]
    units: NDArray[np.int64]
    counters: NDArray[np.int64]
    candidates: NDArray[np.int64]
    candidate_squares: NDArray[np.float32]
    below: NDArray[np.int64]
    keys: NDArray[np.float32]
    off: NDArray[np.float32]


@nb.njit(nogil=True, cache=True)
def make_best_pair(deficit, descent):
    """Allocate scratch for as many classes as `deficit` has; no pair is found yet."""
    n, frame = deficit.shape[0], np.zeros(8)
    for c in range(n):
        frame[7] = max(frame[7], np.float64(deficit[c]))
    return BestPair(
        np.empty(8, np.int64), np.empty(n, np.float32), np.empty(n, np.float32), deficit, np.uint64(n - 1), frame,
        np.empty(3, np.int64), descent.keep, descent.keep8, np.empty(LANES, np.float32), np.empty(LANES, np.float32),
        np.empty(2, np.int64), descent.counters, np.empty((MAX_CANDIDATES, 5), np.int64),
        np.empty(MAX_CANDIDATES, np.float32), np.empty(STACK, np.int64), np.empty(STACK, np.float32),
        np.empty(3, np.float32),
    )  # fmt: skip


@njit_no_refcount
def lower_bound(words, row, x, y, z, radius):
    """Return a lower bound of the distance of a sphere's points from a node's points [steps].

    x, y, z: float32, relative to the voxel's low corner. The bound is the larger of the sphere's and
    the slab's or box's, minus the rounding of this function, and may be negative. It does not include
    the errors of placed coordinates: `BestPair.cut` does.
    """
    at = U(row)  # not negative: saves a comparison for every index
    dx, dy, dz = x - words[at], y - words[at + U(1)], z - words[at + U(2)]
    apart = np.sqrt(dx * dx + dy * dy + dz * dz)
    both = words[at + U(3)] + radius
    slack = SLACK * (apart + both)
    if has_box(words, row):
        return max(apart - both, np.sqrt(box_square(words, row, dx, dy, dz)) - radius) - slack
    along = words[at + U(4)] * dx + words[at + U(5)] * dy + words[at + U(6)] * dz
    gap = max(along - words[at + U(9)], words[at + U(8)] - along)
    # Without a slab, gap is 0. The slab's length is never 0, and is rounded up.
    return max(apart - both, gap / words[at + U(7)] - radius) - slack


@njit_inlined
def unmark_beyond_box(halves, lane_at, low_x, low_y, low_z, lanes, block, far, keep):
    """Unmark the points of an avatar's block that are beyond `far` from a scene block's box.

    far: a squared distance. Other arguments as for `nearest_squares`.
    No slack is added for rounding: rounding is monotonic, therefore each difference computed here
    is no larger than those of the points.
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


@njit_inlined
def nearest_squares(halves, lane_at, low_x, low_y, low_z, lanes, block, keep, keep8, squares):
    """Compute the least squared distance of each marked point of an avatar to a scene block.

    lane_at: the scene block in `halves`.  low: its corner, relative to the frame. Writes squares.
    Returns (least of all, points tested).
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
            least = np.int32(0x7F800000)  # infinity, see `write_squares`
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


@njit_no_refcount
def set_cut(cut, far, frame, deficit, units):
    """Rule out pairs whose |a - b| + deficit is above `units`; see `BestPair`."""
    thresholds = make_thresholds(units, frame[2], frame[0], frame[1], frame[3])
    error = np.float64(thresholds.error)
    frame[4] = error
    for c in range(deficit.shape[0]):
        if deficit[c] == 0:
            cut[c] = (thresholds.reach + thresholds.error) * ONE_SLACK
            far[c] = thresholds.far
        else:
            # As in `make_thresholds`, with all slack in one factor: 45 ns for 32 classes instead of
            # 370.
            above = (np.float64(max(units - deficit[c], 0)) / frame[2] + error) * (1.0 + 2e-6)
            cut[c] = np.float32(above)
            far[c] = np.float32(above * above)


@njit_no_refcount
def pair_units(square, deficit):
    """Return an upper bound of |a - b| + deficit of a pair, exact units.

    A bound at this value excludes no pair that ties.
    """
    return np.int64(math.sqrt(np.float64(square))) + 2 + deficit


@njit_no_refcount
def found_units(found):
    """Return `pair_units` of the pair found."""
    return pair_units(found[0], found[7])


@njit_no_refcount
def units_to_beat(units, frame):
    """Return |a - b| + deficit below which a pair is worth finding, if one is known at `units`.

    Exact units, 0 or more; `units` itself without a tolerance. Let u = `units`, and D the largest
    deficit. If no pair is below the result u - t, the pair known is within t of the nearest one,
    and t is at most the tolerance, or the share e of the nearest pair's |a - b|: that is at least
    u - t - D, and t = e (u - D) / (1 + e) is e (u - t - D).
    """
    share, tolerance = frame[5], frame[6]
    if share == 0.0 and tolerance == 0.0:
        return units
    near = max(np.float64(units) - frame[7], 0.0)
    allowed = max(tolerance, share / (1.0 + share) * near * (1.0 - 1e-12))
    return max(units - np.int64(min(allowed, np.float64(units))), 0)


@njit_no_refcount
def unsearched_bound(best):
    """Return a lower bound of |a - b| + deficit of pairs that a tolerance left unsearched [steps].

    inf: all nearer pairs were searched.
    """
    if best.found[0] < 0:
        return np.inf
    known = found_units(best.found)
    to_beat = units_to_beat(known, best.frame)
    return np.float64(to_beat) / best.frame[2] if to_beat < known else np.inf


@njit_no_refcount
def _update_best(
    points, m, shift, block, lane, ints, halves, corner, block_at, lane_at, j, units_per_step, units, deficit, found
):  # fmt: skip
    """Replace the best pair by this pair if it is nearer, or as near and first in order.

    Ties go to the lesser scan point, then to the lesser avatar centre.
    points, shift: of Avatar and PlacedAvatar.  corner: (3,) int64, of the voxel [steps].  deficit:
    of the scan point's class.
    """
    units -= deficit
    center = place_units(points, m, shift, block, lane)
    point = lattice_point(corner, ints, halves, block_at, lane_at, j)
    square = square_apart(center, point, units_per_step)
    if square < 0 or square > units * units:
        return
    if found[0] >= 0:
        order = compare_separations(square, -deficit, found[0], -found[7])
        known = (found[1], found[2], found[3], found[4], found[5], found[6])
        if order > 0 or (order == 0 and point + center >= known):
            return
    found[0], found[7] = square, deficit
    found[1], found[2], found[3] = point
    found[4], found[5], found[6] = center


@njit_no_refcount
def _distance_bound(square, frame):
    """Return an upper bound of a distance whose square float32 holds [exact units, float64].

    The error is that of `make_thresholds`.
    """
    return (math.sqrt(np.float64(square)) * (1.0 + 8.0 * U32) + frame[4]) * frame[2]


@njit_no_refcount
def _list_by_class(c, block, block_at, lane_at, best, ints, halves, lanes):
    """Unmark the points of an avatar's block that are near no point of a scene block, by class.

    The radius class of each scene point decides.  c: class of the scene's leaf node.  Other
    arguments as for `take_candidates`. Returns an upper bound of the least |a - b| + deficit, exact
    units, float64; inf: no point is near.
    """
    keep, squares, block_squares, off = best.keep, best.squares, best.block_squares, best.off
    far, deficit = best.far, best.deficit
    low_x = off[0] + np.float32(ints[block_at])
    low_y = off[1] + np.float32(ints[block_at + 1])
    low_z = off[2] + np.float32(ints[block_at + 2])
    nearest = np.inf
    for lane in range(LANES):
        if not keep[lane]:
            continue
        keep[lane] = False
        if not squares[lane] <= far[c]:
            continue
        x, y, z = lanes[block, 0, lane] - low_x, lanes[block, 1, lane] - low_y, lanes[block, 2, lane] - low_z
        write_squares(halves, lane_at, x, y, z, block_squares)
        for j in range(LANES):
            own = point_class(ints, block_at, j, best.mask)
            if block_squares[j] <= far[own]:
                keep[lane] = True
                nearest = min(
                    nearest, _distance_bound(block_squares[j], best.frame) + np.float64(deficit[own])
                )
    return nearest


@njit_no_refcount
def take_candidates(least, c, block, block_at, lane_at, best, points, m, shift, ints, halves, lanes):
    """Add the points that `nearest_squares` found to the candidates, and shrink the cut.

    This uses no integers. As points arrive and the cut shrinks, ten or twenty of them are the
    nearest in turn; `settle_candidates` does the integer work once, at the end.
    least: the least square, within the cut.  c: class of the scene's leaf node.
    """
    far, units, counters, candidate_squares = best.far, best.units, best.counters, best.candidate_squares
    candidates, keep, squares = best.candidates, best.keep, best.squares
    if best.mask == U(0):
        within = _distance_bound(least, best.frame)
    else:
        within = _list_by_class(c, block, block_at, lane_at, best, ints, halves, lanes)
        if within == np.inf:
            return
    nearer = np.int64(within) + 2  # one unit for rounding up
    if nearer < units[1]:
        units[1] = nearer
        set_cut(best.cut, far, best.frame, best.deficit, nearer)
        left = 0
        for i in range(counters[2]):
            if candidate_squares[i] <= far[candidates[i, 4]]:
                candidate_squares[left] = candidate_squares[i]
                for r in range(5):
                    candidates[left, r] = candidates[i, r]
                left += 1
        counters[2] = left
    for lane in range(LANES):
        if not keep[lane] or not squares[lane] <= far[c]:
            continue
        if counters[2] == MAX_CANDIDATES:
            settle_candidates(best, points, m, shift, ints, halves, lanes)
        at = counters[2]
        candidates[at, 0], candidates[at, 1], candidates[at, 2] = block, lane, block_at
        candidates[at, 3], candidates[at, 4] = lane_at, np.int64(c)
        candidate_squares[at] = squares[lane]
        counters[2] = at + 1
    if best.frame[5] > 0.0 or best.frame[6] > 0.0:
        settle_candidates(best, points, m, shift, ints, halves, lanes)


@njit_no_refcount
def settle_candidates(best, points, m, shift, ints, halves, lanes):
    """Square the candidates of one voxel in integers and keep the nearest pair; clear the list.

    points: (b, 3, LANES) of Avatar.  lanes: of PlacedAvatar.
    """
    far, frame, found, squares, units = best.far, best.frame, best.found, best.block_squares, best.units
    off = best.off
    for i in range(best.counters[2]):
        if best.candidate_squares[i] > far[best.candidates[i, 4]]:
            continue
        block, lane = best.candidates[i, 0], best.candidates[i, 1]
        block_at, lane_at = best.candidates[i, 2], best.candidates[i, 3]
        x = lanes[block, 0, lane] - (off[0] + np.float32(ints[block_at]))
        y = lanes[block, 1, lane] - (off[1] + np.float32(ints[block_at + 1]))
        z = lanes[block, 2, lane] - (off[2] + np.float32(ints[block_at + 2]))
        write_squares(halves, lane_at, x, y, z, squares)
        for j in range(LANES):
            c = point_class(ints, block_at, j, best.mask)
            if squares[j] <= far[c]:
                _update_best(
                    points, m, shift, block, lane, ints, halves, best.corner, block_at, lane_at, j, frame[2],
                    units[0], best.deficit[c], found,
                )  # fmt: skip
    best.counters[2] = 0
    if found[0] >= 0:
        nearest = found_units(found)
        to_beat = units_to_beat(nearest, frame)
        if nearest < units[1] or to_beat < nearest:
            units[1] = min(units[1], nearest)
            set_cut(best.cut, far, frame, best.deficit, min(to_beat, units[1]))
