"""Coarse bounds: the top nodes of a voxel's hierarchy, and the pairs they prove clear.

A slot holds nodes that together enclose all points of one voxel. They have the layout of the
arena's rows (scene_arrays.py) and no children. They prove what a descent would have found: the
bounds, the float32 tests, their slack and the thresholds by radius class are those of
collide_poses.py. A pair found clear here is therefore clear by the definition.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ....schemas.kernels import compiling as nb
from ..core.kernel_decorators import njit_no_refcount
from ..core.node_overlap import (
    lanes_meet,
    locate_voxel,
    make_class_thresholds,
    mark_meeting,
    nodes_meet,
    set_class_thresholds,
)
from ..core.placed_avatar import MAX_FRONT, make_placed, place_block, place_front, place_root
from ..core.scene_arrays import COUNT, COUNTED, FIRST, LANES, ROW_WORDS, ROWS_AT_ONCE, node_class, stopped

# Nodes of a slot, 48 bytes each. Share of the clear pairs of pose and voxel that this many nodes
# settle, on the walk through a generated town of 10^7 points (voxels of 8 m, mean 282 KB decoded):
# 32 nodes: 14 %, 64: 35 %, 96: 45 %, 128: 52 %, 192: 59 %; on the walk through the façade in voxels
# of 4 m (63 KB): 32 nodes: 67 %, 64: 77 %, 96: 82 %, 128: 83 %; in voxels of 8 m: 128 nodes: 59 %,
# and 20 % if the avatar's points are not tested against the bounds. Opening the thickest node, or
# that of the largest volume, instead of that of the largest radius changes the share by about a
# tenth.
MAX_SLOT_NODES = 128
SLOT_WORDS = MAX_SLOT_NODES * ROW_WORDS


class CoarseArrays(NamedTuple):
    """Coarse bounds of a scene's v voxels in s slots.

    words, ints: (s * SLOT_WORDS,) float32 and int32, two views of one buffer: MAX_SLOT_NODES rows a
    slot, scene_arrays.py. COUNT holds the radius class only, and FIRST is -1.
    slot: (v,) int32, the slot of a voxel, -1: none.  count: (s,) int32, rows in a slot.
    A thread that finds a slot in `slot` may read it without a lock: the slot was written before and
    is never written again.
    """

    words: NDArray[np.float32]
    ints: NDArray[np.int32]
    slot: NDArray[np.int32]
    count: NDArray[np.int32]  # type: ignore[assignment]  # hides tuple.count, which nobody calls


@nb.njit(nogil=True, cache=True)
def write_coarse_bounds(words, ints, root, assumed, out, number):
    """Write the coarse bounds of a voxel that `lay_out` wrote into slot `number` of `out`.

    words, ints: of the arena.  root: the voxel's first row.  out: the ints of CoarseArrays.
    assumed: radius class, shifted as in COUNT, for rows without a class so far; 0: take their own.
    Beginning with the root, the node of the largest radius (the first of equals) is replaced by its
    children as long as all of them fit. Where there are MAX_SLOT_NODES leaf nodes or fewer, the
    result is therefore the leaf nodes. Returns the number of rows.
    """
    taken, radius = np.empty(MAX_SLOT_NODES, np.int64), np.empty(MAX_SLOT_NODES, np.float32)
    taken[0], radius[0] = root, words[root + 3]
    count = 1
    while True:
        widest = 0
        for i in range(1, count):
            if radius[i] > radius[widest]:
                widest = i
        if radius[widest] < 0:  # no node is left to open
            break
        row = taken[widest]
        first, children = int(ints[row + FIRST]), int(ints[row + COUNT] & COUNTED)
        if first < 0 or count + children - 1 > MAX_SLOT_NODES:
            radius[widest] = np.float32(-1.0)
            continue
        child = root + first * ROW_WORDS
        for i in range(children):
            at = widest if i == 0 else count + i - 1
            taken[at], radius[at] = child, words[child + 3]
            child += ROW_WORDS
        count += children - 1
    at = number * SLOT_WORDS
    for i in range(count):
        for k in range(FIRST):
            out[at + k] = ints[taken[i] + k]
        out[at + FIRST] = np.int32(-1)
        out[at + COUNT] = (ints[taken[i] + COUNT] & ~COUNTED) | assumed
        at += ROW_WORDS
    return count


@nb.njit(nogil=True, cache=True)
def any_with_coarse_bounds(where, slot, rows, count, stop):
    """Return whether one of the first `count` voxel rows is not resident and has a slot.

    Returns False once the stop flag is set.
    """
    for at in range(count):
        if at % ROWS_AT_ONCE == 0 and stopped(stop):
            return False
        if where[rows[at], 0] < 0 and slot[rows[at]] >= 0:
            return True
    return False


@nb.njit(nogil=True, cache=True)
def copy_unproved_pairs(poses, avatar, scene, coarse, reach, starts, rows):
    """Copy starts and rows of `reach` without the pairs that coarse bounds prove clear.

    poses: (k, 4, 4), checked.  avatar: not empty.  reach: VoxelsInReach of these poses
    (voxels_in_reach.py). A pair is a pose and a voxel. Writes starts (k + 1,) and rows, which are
    as long as those in `reach` and in the same order. It omits a voxel that is not resident, has a
    slot, and has no node there whose bound comes within reach. Returns how many were omitted; 0, with the output
    incomplete, once the scene's stop flag is set.
    """
    placed, by_class = make_placed(avatar), make_class_thresholds(scene.radius_deficit)
    bounds = np.empty((4, MAX_FRONT), np.float32)
    met, keep = np.zeros(MAX_FRONT, np.bool_), np.zeros(LANES, np.bool_)
    return _copy_unproved_pairs(
        poses, avatar, scene, coarse, reach, starts, rows, placed, by_class, bounds, met, keep
    )


@njit_no_refcount
def _copy_unproved_pairs(
    poses, avatar, scene, coarse, reach, starts, rows, placed, by_class, bounds, met, keep
):
    """Implement `copy_unproved_pairs` with its scratch passed in."""
    left = 0
    for i in range(poses.shape[0]):
        m = poses[i]
        starts[i] = left
        front = 0  # its length; not placed yet, as most poses never need it
        for at in range(reach.starts[i], reach.starts[i + 1]):
            if at % ROWS_AT_ONCE == 0 and stopped(scene.stop):
                return 0
            voxel = reach.rows[at]
            number = np.int64(coarse.slot[voxel])
            if number >= 0 and scene.where[voxel, 0] < 0 and not stopped(scene.stop):
                if front == 0:
                    extent, farthest = place_root(avatar, m, placed, scene)
                    set_class_thresholds(
                        by_class,
                        scene.radius_deficit,
                        reach.units[i],
                        scene.units_per_step,
                        extent,
                        farthest,
                        scene.voxel_steps,
                    )
                    front = place_front(avatar, m, placed, scene, extent, bounds)
                if _is_clear(
                    avatar, m, i, scene, coarse, voxel, number, placed, by_class, bounds, front, met, keep
                ):
                    continue
            rows[left] = voxel
            left += 1
    starts[poses.shape[0]] = left
    return reach.starts[poses.shape[0]] - left


@njit_no_refcount
def _is_clear(avatar, m, pose, scene, coarse, voxel, number, placed, by_class, bounds, front, met, keep):
    """Return whether no point of the avatar comes within reach of any node of slot `number`.

    placed, by_class, bounds: of this pose.  front: the number of nodes in `bounds`.  pose: its
    number, for the blocks' stamps.  met: (MAX_FRONT,) and keep: (LANES,) bool, scratch.
    """
    words, nodes = coarse.words, placed.nodes
    location = locate_voxel(scene, voxel, placed)
    x, y, z, radius = (
        nodes[0, 0] - location.x,
        nodes[1, 0] - location.y,
        nodes[2, 0] - location.z,
        nodes[3, 0],
    )
    steps = (front + LANES - 1) // LANES
    row = number * SLOT_WORDS
    for _ in range(coarse.count[number]):
        threshold = by_class.threshold[node_class(coarse.ints, row, by_class.mask)]
        if nodes_meet(words, row, x, y, z, radius, threshold) and mark_meeting(
            words, row, bounds, 0, steps, location.x, location.y, location.z, threshold, met
        ):
            for i in range(front):
                if not met[i]:
                    continue
                first = np.int64(avatar.first[avatar.front_first + i])
                if first >= 0:  # an avatar whose front is not its leaf nodes
                    return False
                block = ~first
                if placed.stamp[block] != pose:
                    place_block(avatar, m, block, placed, scene)
                    placed.stamp[block] = pose
                if lanes_meet(
                    words, row, placed.lanes, block, location.x, location.y, location.z, threshold, keep
                ):
                    return False
        row += ROW_WORDS
    return True
