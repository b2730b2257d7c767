"""All pairs of points in contact under a pose: a complete joint descent of two hierarchies.

The descent is that of [Fig12] section 6, corrected as in collide_poses.py, and does not end early: it
examines every pair of leaf nodes whose bounds meet. There a float32 pass certifies most pairs as
near or far. Integers (NUMERICS.md N5) decide the pairs between, and measure those pairs that may be
the deepest of their cell or among the deepest listed.

Each scan point has the sphere of its radius class. Its own reach decides what is in contact, and
the deepest pair is the one with the least separation of its spheres, |a - b| - r_a - r_b. Nodes and
blocks are pruned by the largest sphere below.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ....schemas.runtime import compiling as nb
from ..core.kernel_decorators import njit_no_refcount
from ..core.node_bounds import (
    ONE_SLACK,
    lanes_meet,
    locate_block,
    locate_voxel,
    make_class_thresholds,
    nodes_meet,
    set_class_thresholds,
)
from ..core.placed_avatar import lattice_point, make_placed, place_block_once, place_nodes
from ..core.reach import MISSING, NOT_HELD, state_of
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
from .contact_cells import (
    BY_SCAN,
    CELLS,
    CLUSTER,
    CLUSTERS,
    DEPTH,
    KEPT,
    LISTED,
    POINT,
    POSE,
    RECORD,
    SCAN,
    ContactScratch,
    ContactState,
    find_slot,
    gather_point,
    grow_cells,
    list_pose,
    listing_bound,
    square_below,
)

U = np.uint64  # see placed_avatar.py


class ContactResults(NamedTuple):
    """Results for k poses.

    counts: (3, k) int64, voxels missing, node visits, point tests.  pairs: (k,) int64.
    runs: (k, 4) int64, first pair listed, pairs, first cluster, clusters.
    """

    counts: NDArray[np.int64]
    pairs: NDArray[np.int64]
    runs: NDArray[np.int64]


@njit_no_refcount
def _bound_of_scans(halves, at, count, cells):
    """Return the largest bound, as in `ContactCells`, of the scans of some points; inf: one has no pair.

    halves, at: the scan numbers of `count` points.
    """
    widest, last = -1.0, np.int64(-1)
    for j in range(count):
        scan = np.int64(halves[U(at + j)])
        if scan != last:
            row, last = cells.slots[find_slot(cells, scan, 0, 0)], scan
            widest = max(widest, cells.bound[row] if row >= 0 else np.inf)
    return widest


@njit_no_refcount
def _gather_leaves(
    avatar, m, a, block, scene, voxel, location, row, options, edge, state, scratch, i, results
):
    """Gather the pairs in contact of a leaf node of the avatar and one of the scene.

    voxel, location: the scene's voxel. First, vector loops test all avatar points against the
    scene node's bound and all scan points against the avatar node's sphere. Then each remaining
    scan point is tested against all points of the avatar.
    """
    words, ints, halves = scene.words, scene.ints, scene.halves
    lanes, nodes = scratch.placed.lanes, scratch.placed.nodes
    keep, avatar_lanes = scratch.keep, scratch.avatar_lanes
    fars, mask = scratch.by_class.far, scratch.by_class.mask
    threshold = scratch.by_class.threshold[node_class(ints, row, mask)]
    scan_at = np.int64(0)
    if options.with_scan:
        scan_at = scan_run(scene.where, voxel, scene.block_words) + ~np.int64(ints[row + FIRST]) * LANES
    if edge == BY_SCAN:
        # A wall that one scan saw costs only its nodes and the scan numbers of its points.
        widest = _bound_of_scans(halves, scan_at, ints[row + COUNT] & COUNTED, state.cells)
        threshold = np.float32(min(np.float64(threshold), widest * (1.0 + 1e-6)))
    if not lanes_meet(words, row, lanes, block, location.x, location.y, location.z, threshold, keep):
        return
    block_at, lane_at, lx, ly, lz = locate_block(ints, location, row, scene.block_words)
    at_x = U(lane_at)
    at_y, at_z = at_x + U(LANES), at_x + U(2 * LANES)
    cx, cy, cz = nodes[0, a] - lx, nodes[1, a] - ly, nodes[2, a] - lz
    both = nodes[3, a] + threshold
    square = both * both * ONE_SLACK
    for j in range(LANES):
        dx = np.float32(halves[at_x + U(j)]) - cx
        dy = np.float32(halves[at_y + U(j)]) - cy
        dz = np.float32(halves[at_z + U(j)]) - cz
        keep[j] = dx * dx + dy * dy + dz * dz <= square
    for j in range(LANES):
        avatar_lanes[0, j] = lanes[block, 0, j] - lx
        avatar_lanes[1, j] = lanes[block, 1, j] - ly
        avatar_lanes[2, j] = lanes[block, 2, j] - lz
    record, squares = scratch.record, scratch.squares
    corner, counts, pairs = scene.corners[voxel], results.counts, results.pairs
    for j in range(ints[row + COUNT] & COUNTED):
        if not keep[j]:
            continue
        x = np.float32(halves[at_x + U(j)])
        y = np.float32(halves[at_y + U(j)])
        z = np.float32(halves[at_z + U(j)])
        counts[2, i] += LANES
        own = point_class(ints, block_at, j, mask)
        far = fars[own]
        if edge == BY_SCAN:
            bound = _bound_of_scans(halves, scan_at + j, 1, state.cells)
            if bound < np.inf:
                far = min(
                    far, square_below(bound, np.float64(scene.radius_deficit[own]) / scene.units_per_step)
                )
        touched = False
        for lane in range(LANES):
            dx, dy, dz = x - avatar_lanes[0, lane], y - avatar_lanes[1, lane], z - avatar_lanes[2, lane]
            squares[lane] = dx * dx + dy * dy + dz * dz
            touched |= squares[lane] <= far
        if not touched:
            continue
        record[0, POINT], record[0, POINT + 1], record[0, POINT + 2] = lattice_point(
            corner, ints, halves, block_at, lane_at, j
        )
        record[0, SCAN] = -1
        if options.with_scan:
            record[0, SCAN] = halves[scan_at + j]
        pairs[i] += gather_point(avatar, m, a, block, scene, own, options, edge, state, scratch)


@njit_no_refcount
def _gather_voxel(avatar, m, i, scene, voxel, options, state, scratch, results):
    """Gather all pairs in contact of the placed avatar and one resident voxel by a joint descent.

    Continues from the stack that an earlier call left. Suspends, with a depth other than 0, where the
    cells have no space for another LANES, and when the scene's stop flag is set.
    """
    words, ints, placed = scene.words, scene.ints, scratch.placed
    location = locate_voxel(scene, voxel, placed)
    base, off_x, off_y, off_z = location.rows, location.x, location.y, location.z
    nodes, stack, counts = placed.nodes, state.stack, results.counts
    first, held, edges = avatar.first, avatar.count, options.edges
    sizes, most_cells = state.sizes, state.cells.table.shape[0]
    thresholds, mask, flag = scratch.by_class.threshold, scratch.by_class.mask, scene.stop
    depth = sizes[DEPTH]
    if depth == 0:
        counts[1, i] += 1
        if nodes_meet(
            words, base, nodes[0, 0] - off_x, nodes[1, 0] - off_y, nodes[2, 0] - off_z, nodes[3, 0],
            thresholds[node_class(ints, base, mask)],
        ):  # fmt: skip
            stack[0, 0], stack[0, 1] = 0, base
            depth = 1
    while depth > 0:
        a, row = stack[depth - 1, 0], stack[depth - 1, 1]
        a_first, b_first = first[a], ints[row + FIRST]
        leaves = a_first < 0 and b_first < 0
        if stopped(flag) or (leaves and sizes[CELLS] + LANES > most_cells):
            break
        depth -= 1
        if leaves:
            block = ~a_first
            place_block_once(avatar, m, i, block, placed, scene)
            _gather_leaves(
                avatar,
                m,
                a,
                block,
                scene,
                voxel,
                location,
                row,
                options,
                edges[i],
                state,
                scratch,
                i,
                results,
            )
        elif b_first < 0 or (a_first >= 0 and nodes[3, a] > words[row + 3]):
            counts[1, i] += held[a]
            threshold = thresholds[node_class(ints, row, mask)]
            for child in range(a_first, a_first + held[a]):
                if nodes_meet(
                    words, row, nodes[0, child] - off_x, nodes[1, child] - off_y, nodes[2, child] - off_z,
                    nodes[3, child], threshold,
                ):  # fmt: skip
                    stack[depth, 0], stack[depth, 1] = child, row
                    depth += 1
        else:
            x, y, z = nodes[0, a] - off_x, nodes[1, a] - off_y, nodes[2, a] - off_z
            counts[1, i] += ints[row + COUNT] & COUNTED
            for child in range(ints[row + COUNT] & COUNTED):
                child_row = base + (b_first + child) * ROW_WORDS
                threshold = thresholds[node_class(ints, child_row, mask)]
                if nodes_meet(words, child_row, x, y, z, nodes[3, a], threshold):
                    stack[depth, 0], stack[depth, 1] = a, child_row
                    depth += 1
    sizes[DEPTH] = depth


@nb.njit(nogil=True, cache=True)
def gather_contacts(poses, avatar, scene, reach, which, cursor, held, options, state, results):
    """Answer `contacts` for the poses numbered in `which`, one after the other, each from its cursor on.

    poses: (k, 4, 4), checked.  avatar: not empty.  reach: VoxelsInReach of all k poses.  cursor: as in
    `collide_poses`.  held: states of voxels.
    A finished pose is listed; by scan, its cells are left in the state. The call returns before a voxel
    that is not held; when the scene's stop flag is set; if the table of cells has reached
    `options.cells` and has no space for LANES more; and if the lists are longer than `options.listed`.
    Call again with the returned state, from the same pose on. Adds to `results`.
    """
    scratch = ContactScratch(
        make_placed(avatar), make_class_thresholds(scene.radius_deficit), np.empty(LANES, np.bool_),
        np.empty((3, LANES), np.float32), np.empty(LANES, np.float32), np.empty(1), np.empty(1),
        np.empty((1, RECORD), np.int64),
    )  # fmt: skip
    rows = reach.lists.rows
    for number in range(which.shape[0]):
        i = which[number]
        end = reach.lists.starts[i + 1]
        if stopped(scene.stop) or state_of(held, rows[cursor[i]]) == NOT_HELD:
            return state
        state.sizes[POSE] = i
        extent, farthest = place_nodes(avatar, poses[i], scratch.placed, scene)
        scratch.error[0] = set_class_thresholds(scratch.by_class, scene, reach.units[i], extent, farthest)
        scratch.bound[0] = listing_bound(
            state.heap, state.sizes[KEPT], scene.units_per_step, scratch.error[0]
        )
        while cursor[i] < end:
            voxel = rows[cursor[i]]
            may = state_of(held, voxel)
            if may == NOT_HELD or stopped(scene.stop):
                return state
            if may == MISSING:
                results.counts[0, i] += 1
                cursor[i] += 1
                continue
            if state.sizes[CELLS] + LANES > state.cells.table.shape[0]:
                if state.cells.table.shape[0] >= options.cells:
                    return state
                # Here and not in the descent: a loop that changes a tuple of arrays counts
                # their references in every iteration, which took a third of the time.
                state = ContactState(
                    grow_cells(state.cells, state.sizes[CELLS], scene.stop), state.heap, state.sizes,
                    state.stack, state.pairs, state.clusters,
                )  # fmt: skip
                continue
            _gather_voxel(avatar, poses[i], i, scene, voxel, options, state, scratch, results)
            if state.sizes[DEPTH] == 0:
                cursor[i] += 1
        if options.edges[i] != BY_SCAN:
            state = list_pose(state, results.runs[i], scene.stop)
        if 8 * (state.sizes[LISTED] * RECORD + state.sizes[CLUSTERS] * CLUSTER) > options.listed:
            return state
    return state
