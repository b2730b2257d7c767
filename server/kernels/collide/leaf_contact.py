"""Contact of the points of two leaf nodes, one of an avatar and one of the scene's tree.

collide_poses.py, which descends to them, says how float32 and integers share the work.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ....schemas.kernels import compiling as nb
from ..core.kernel_decorators import njit_no_refcount
from ..core.node_overlap import STACK, lanes_meet, next_near, nodes_meet, sphere_is_near
from ..core.placed_avatar import node_reach, pair_in_reach, place_block_once, place_node
from ..core.scene_arrays import FIRST, LANES, leaf_class, node_class, point_class, stopped
from .early_contact import CLEAR, CONTACT, EARLY

U = np.uint64  # see placed_avatar.py


class CollideScratch(NamedTuple):
    """Scratch of one call.

    stack: (STACK, 3) int64: scene row, start of its list, length.
    below: (STACK,) int64: avatar nodes below its front; one element where the front is leaf nodes.
    keep: (LANES,) bool, marks; keep8: the same memory as uint64, eight marks each.
    counters: (2,) int64, node visits, point tests.
    early: (2,) float32, see `set_early`.
    """

    stack: NDArray[np.int64]
    below: NDArray[np.int64]
    keep: NDArray[np.bool_]
    keep8: NDArray[np.uint64]
    counters: NDArray[np.int64]
    early: NDArray[np.float32]


@nb.njit(nogil=True, cache=True)
def make_collide_scratch(avatar):
    """Allocate scratch for one avatar (not empty)."""
    below = STACK if avatar.first[avatar.front_first] >= 0 else 1
    keep = np.zeros(LANES, np.bool_)
    stack, counters = np.empty((STACK, 3), np.int64), np.zeros(2, np.int64)
    return CollideScratch(
        stack, np.empty(below, np.int64), keep, keep.view(np.uint64), counters, np.empty(2, np.float32)
    )


@njit_no_refcount
def leaves_touch(avatar, m, block, placed, scene, voxel, location, row, by_class, scratch):
    """Return CONTACT if a marked point of a block touches a point of leaf node `row`.

    Return EARLY if a pair within the tolerance is met first, and CLEAR if there is neither.
    """
    halves, lanes, ints, mask = scene.halves, placed.lanes, scene.ints, by_class.mask
    number = ~np.int64(ints[U(row + FIRST)])
    block_at = location.blocks + number * scene.block_words
    lane_at = location.lanes + number * 3 * LANES
    low_x = location.x + np.float32(ints[U(block_at)])
    low_y = location.y + np.float32(ints[U(block_at + 1)])
    low_z = location.z + np.float32(ints[U(block_at + 2)])
    early = scratch.early[1]
    far = max(by_class.far[leaf_class(ints, row, mask)], early)  # for the largest sphere in the block
    begin = 0
    while begin < LANES:
        lane, tested = next_near(
            halves, lane_at, low_x, low_y, low_z, lanes, block, far, scratch.keep, scratch.keep8, begin
        )
        scratch.counters[1] += LANES * tested
        if lane < 0:
            return CLEAR
        x, y, z = lanes[block, 0, lane] - low_x, lanes[block, 1, lane] - low_y, lanes[block, 2, lane] - low_z
        for j in range(LANES):
            i = U(lane_at + j)
            dx = np.float32(halves[i]) - x
            dy = np.float32(halves[i + U(LANES)]) - y
            dz = np.float32(halves[i + U(2 * LANES)]) - z
            square = dx * dx + dy * dy + dz * dz
            if square > far:
                continue
            c = point_class(ints, block_at, j, mask)
            if square <= by_class.near[c]:
                return CONTACT
            if square <= by_class.far[c] and pair_in_reach(
                avatar, m, block, lane, placed, scene, voxel, lane_at, block_at, j, by_class.units[c]
            ):
                return CONTACT
            if square <= early:
                return EARLY
        begin = lane + 1
    return CLEAR


@njit_no_refcount
def below_touches(avatar, m, extent, pose, placed, scene, voxel, location, a, row, by_class, scratch):
    """Return what `leaves_touch` finds for a scene leaf node and a node of the avatar's front.

    The avatar's node is descended depth first. This is for avatars whose front is not their leaf
    nodes.
    """
    words, below = scene.words, scratch.below
    threshold = by_class.threshold[node_class(scene.ints, row, by_class.mask)]
    per_step = 1.0 / scene.step
    below[0] = a
    depth = 1
    while depth > 0 and not stopped(scene.stop):
        depth -= 1
        a = below[depth]
        a_first = avatar.first[a]
        scratch.counters[0] += 1
        if a_first < 0:
            block = np.int64(~a_first)
            if avatar.inner_points > 0 and not _may_touch(
                avatar, m, per_step, extent, placed, scene, location, a, row, threshold, scratch
            ):
                continue
            place_block_once(avatar, m, pose, block, placed, scene)
            if lanes_meet(
                words, row, placed.lanes, block, location.x, location.y, location.z, threshold, scratch.keep
            ):
                found = leaves_touch(avatar, m, block, placed, scene, voxel, location, row, by_class, scratch)
                if found != CLEAR:
                    return found
            continue
        x, y, z = place_node(avatar, m, a, placed, scene)
        radius = node_reach(avatar.radius[a], per_step, extent)
        if nodes_meet(words, row, x - location.x, y - location.y, z - location.z, radius, threshold):
            for i in range(avatar.count[a]):
                below[depth] = a_first + i
                depth += 1
    return CLEAR


@njit_no_refcount
def _may_touch(avatar, m, per_step, extent, placed, scene, location, a, row, threshold, scratch):
    """Return whether a point of a scene leaf node is near a leaf node of the avatar.

    A scene leaf node of scattered points may hold much of the inside of a filled mesh without a
    touch. To test its points against the sphere of a leaf node takes less than to place and test
    the points in that node: 1.4 instead of 3.9 us a pose for a ball near the façade (bench_engine,
    `filled`).
    """
    ints = scene.ints
    number = ~np.int64(ints[U(row + FIRST)])
    block_at = location.blocks + number * scene.block_words
    lane_at = location.lanes + number * 3 * LANES
    scratch.counters[1] += LANES
    x, y, z = place_node(avatar, m, a, placed, scene)
    return sphere_is_near(
        scene.halves,
        lane_at,
        location.x + np.float32(ints[U(block_at)]),
        location.y + np.float32(ints[U(block_at + 1)]),
        location.z + np.float32(ints[U(block_at + 2)]),
        x,
        y,
        z,
        node_reach(avatar.radius[a], per_step, extent) + threshold,
    )
