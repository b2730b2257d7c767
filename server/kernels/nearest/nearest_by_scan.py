"""Nearest pair of each scan: a joint descent, bounded by the nearest pair of each scan so far.

The descent is that of contact_pairs.py. What counts as nearer, and what a pair rules out, follows
nearest_pair.py, for every scan with points here. An inner node does not record the scans of its
points; it is therefore searched up to the margin. A leaf node does, and is skipped where it is
farther than the nearest pair of each scan it has points of. A wall that one scan saw therefore
costs only its nodes and the scan numbers of its points.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ....schemas.archive.units import UNITS_PER_METRE
from ....schemas.kernels import compiling as nb
from ..core.kernel_decorators import njit_no_refcount
from ..core.node_overlap import (
    STACK,
    ClassThresholds,
    lanes_meet,
    make_class_thresholds,
    nodes_meet,
    set_class_thresholds,
)
from ..core.placed_avatar import make_placed, pair_square, place_block, place_nodes
from ..core.scene_arrays import (
    COUNT,
    COUNTED,
    FIRST,
    LANES,
    ROW_WORDS,
    node_class,
    point_class,
    scan_run,
    stopped,
)
from .nearest_pair import lower_bound, set_cut

U = np.uint64  # see placed_avatar.py


class NearestPerScan(NamedTuple):
    """Results for each of n scans; the last entry stands for numbers that no scan has.

    gaps: (n,) float64, least signed separation [m]; inf if no pair is within the margin.
    units: (n,) int64, upper bound of |a - b| + deficit of its nearest pair, exact units
    (nearest_pair.py).
    """

    gaps: NDArray[np.float64]
    units: NDArray[np.int64]


class ScanScratch(NamedTuple):
    """Scratch of one call.

    cut, far: (n, classes) float32, see `BestPair`, by scan.  frame: (5,), of `BestPair`.
    by_class: thresholds of the margin.  stack: (STACK, 2) int64.  off: (3,) float32.  squares:
    (LANES,) float32.
    keep: (LANES,) bool.  counts: (3,) int64, voxels missing, node visits, point tests.
    """

    cut: NDArray[np.float32]
    far: NDArray[np.float32]
    frame: NDArray[np.float64]
    by_class: ClassThresholds
    stack: NDArray[np.int64]
    off: NDArray[np.float32]
    squares: NDArray[np.float32]
    keep: NDArray[np.bool_]
    counts: NDArray[np.int64]


@njit_no_refcount
def _update_scan(
    avatar, m, block, lane, placed, scene, voxel, lane_at, block_at, j, s, own, radii, most, nearer, scratch
):
    """Replace the nearest pair of a scan by this pair if it is nearer.

    radii: r_a + r_b of the pair.  most: the same plus the margin, exact units.
    """
    square = pair_square(avatar, m, block, lane, placed, scene, voxel, lane_at, block_at, j)
    if square < 0 or square > most * most:
        return
    root = math.sqrt(np.float64(square))
    both = root + np.float64(radii)
    # The formula of signed_distance.py.
    gap = np.float64(square - radii * radii) / both / UNITS_PER_METRE if both > 0.0 else 0.0
    if gap < nearer.gaps[s]:
        nearer.gaps[s] = gap
        units = np.int64(root) + 2 + scene.radius_deficit[own]
        if units < nearer.units[s]:
            nearer.units[s] = units
            set_cut(scratch.cut[s], scratch.far[s], scratch.frame, scene.radius_deficit, units)


@njit_no_refcount
def _search_leaves(
    avatar, m, a, block, placed, scene, voxel, row, reach_units, margin_units, nearer, scratch
):
    """Update the nearest pair of each scan from a leaf node of the avatar and one of the scene.

    The voxel is at scratch.off.
    """
    words, ints, halves, off = scene.words, scene.ints, scene.halves, scratch.off
    keep, squares, cut, far, mask = (
        scratch.keep,
        scratch.squares,
        scratch.cut,
        scratch.far,
        scratch.by_class.mask,
    )
    nodes, lanes, last = placed.nodes, placed.lanes, nearer.gaps.shape[0] - 1
    number = ~ints[row + FIRST]
    block_at = scene.where[voxel, 1] + number * scene.block_words
    lane_at = scene.where[voxel, 2] + number * 3 * LANES
    at_x = U(lane_at)
    at_y, at_z = at_x + U(LANES), at_x + U(2 * LANES)
    scan_at = scan_run(scene.where, voxel, scene.block_words) + number * LANES
    c, held = node_class(ints, row, mask), ints[row + COUNT] & COUNTED
    bound = lower_bound(
        words, row, nodes[0, a] - off[0], nodes[1, a] - off[1], nodes[2, a] - off[2], nodes[3, a]
    )
    widest = np.float32(-1.0)
    for j in range(held):
        widest = max(widest, cut[min(np.int64(halves[U(scan_at) + U(j)]), last), c])
    if not bound <= widest:
        return
    if placed.stamp[block] != 0:
        place_block(avatar, m, block, placed, scene)
        placed.stamp[block] = 0
    # For flat walls along flat avatars, the avatar's sphere excludes little and its points exclude
    # nearly everything.
    if not lanes_meet(words, row, lanes, block, off[0], off[1], off[2], widest, keep):
        return
    low_x = off[0] + np.float32(ints[block_at])
    low_y = off[1] + np.float32(ints[block_at + 1])
    low_z = off[2] + np.float32(ints[block_at + 2])
    for j in range(held):
        s = min(np.int64(halves[U(scan_at) + U(j)]), last)
        if not bound <= cut[s, c]:
            continue
        own = point_class(ints, block_at, j, mask)
        x = np.float32(halves[at_x + U(j)])
        y = np.float32(halves[at_y + U(j)])
        z = np.float32(halves[at_z + U(j)])
        scratch.counts[2] += LANES
        within = far[s, own]
        touched = False
        for lane in range(LANES):
            dx = x - (lanes[block, 0, lane] - low_x)
            dy = y - (lanes[block, 1, lane] - low_y)
            dz = z - (lanes[block, 2, lane] - low_z)
            squares[lane] = dx * dx + dy * dy + dz * dz
            touched |= squares[lane] <= within
        if not touched:
            continue
        most = reach_units - scene.radius_deficit[own]
        for lane in range(avatar.count[a]):
            if squares[lane] <= far[s, own]:
                _update_scan(
                    avatar, m, block, lane, placed, scene, voxel, lane_at, block_at, j, s, own, most - margin_units,
                    most, nearer, scratch,
                )  # fmt: skip


@njit_no_refcount
def _search_voxel(avatar, m, placed, scene, voxel, reach_units, margin_units, nearer, scratch):
    """Search one resident voxel for each scan's nearest pair; return whether to the end."""
    words, ints = scene.words, scene.ints
    base = scene.where[voxel, 0]
    nodes, off, stack, counts = placed.nodes, scratch.off, scratch.stack, scratch.counts
    first, held = avatar.first, avatar.count
    thresholds, mask = scratch.by_class.threshold, scratch.by_class.mask
    for r in range(3):
        off[r] = np.float32(scene.coordinates[voxel, r] * scene.voxel_steps - placed.frame[r])
    counts[1] += 1
    stack[0, 0], stack[0, 1] = 0, base
    depth = 1 if nodes_meet(
        words, base, nodes[0, 0] - off[0], nodes[1, 0] - off[1], nodes[2, 0] - off[2], nodes[3, 0],
        thresholds[node_class(ints, base, mask)],
    ) else 0  # fmt: skip
    while depth > 0:
        if stopped(scene.stop):
            return False
        depth -= 1
        a, row = stack[depth, 0], stack[depth, 1]
        a_first, b_first = first[a], ints[row + FIRST]
        if a_first < 0 and b_first < 0:
            _search_leaves(
                avatar, m, a, ~a_first, placed, scene, voxel, row, reach_units, margin_units, nearer, scratch
            )
            continue
        if b_first < 0 or (a_first >= 0 and nodes[3, a] > words[row + 3]):
            counts[1] += held[a]
            threshold = thresholds[node_class(ints, row, mask)]
            for child in range(a_first, a_first + held[a]):
                if nodes_meet(
                    words, row, nodes[0, child] - off[0], nodes[1, child] - off[1], nodes[2, child] - off[2],
                    nodes[3, child], threshold,
                ):  # fmt: skip
                    stack[depth, 0], stack[depth, 1] = child, row
                    depth += 1
        else:
            x, y, z = nodes[0, a] - off[0], nodes[1, a] - off[1], nodes[2, a] - off[2]
            children = ints[row + COUNT] & COUNTED
            counts[1] += children
            for child in range(children):
                child_row = base + (b_first + child) * ROW_WORDS
                if nodes_meet(
                    words, child_row, x, y, z, nodes[3, a], thresholds[node_class(ints, child_row, mask)]
                ):
                    stack[depth, 0], stack[depth, 1] = a, child_row
                    depth += 1
    return True


@nb.njit(nogil=True, cache=True)
def nearest_by_scan(poses, avatar, scene, reach, margin_units, nearer, counts):
    """Compute the least signed separation of each scan from an avatar, within a margin.

    poses: (1, 4, 4), one pose, checked.  avatar: not empty.  scene: with scan numbers.  reach:
    VoxelsInReach of the pose; a voxel in it that is not resident is counted as missing.
    margin_units: the part of the reach that is not the radii.  nearer: initially inf and
    reach.units, or as a call for other voxels left it.  counts: (3,) int64, voxels missing, node
    visits, point tests; added to.
    Returns whether all resident voxels were searched completely.
    """
    m, units = poses[0], reach.units[0]
    placed, n, classes = make_placed(avatar), nearer.gaps.shape[0], scene.radius_deficit.shape[0]
    scratch = ScanScratch(
        np.empty((n, classes), np.float32), np.empty((n, classes), np.float32), np.empty(5),
        make_class_thresholds(scene.radius_deficit), np.empty((STACK, 2), np.int64), np.empty(3, np.float32),
        np.empty(LANES, np.float32), np.empty(LANES, np.bool_), counts,
    )  # fmt: skip
    extent, farthest = place_nodes(avatar, m, reach.scales[0], placed, scene)
    scratch.frame[0], scratch.frame[1] = extent, farthest
    scratch.frame[2], scratch.frame[3] = scene.units_per_step, np.float64(scene.voxel_steps)
    set_class_thresholds(
        scratch.by_class,
        scene.radius_deficit,
        units,
        scene.units_per_step,
        extent,
        farthest,
        scene.voxel_steps,
    )
    for s in range(n):
        set_cut(scratch.cut[s], scratch.far[s], scratch.frame, scene.radius_deficit, nearer.units[s])
    done = True
    for at in range(reach.starts[0], reach.starts[1]):
        voxel = reach.rows[at]
        if scene.where[voxel, 0] < 0:
            counts[0] += 1
        else:
            done &= _search_voxel(avatar, m, placed, scene, voxel, units, margin_units, nearer, scratch)
    return done
