"""Contact of the points of two leaf nodes, one of an avatar and one of the scene's tree.

collide_poses.py, which descends to them, says how float32 and integers share the work.

Early contact is a pair of points within reach plus tolerance, found before the descent needs it.
A request with a tolerance runs the descent of collide_poses.py unchanged, in the same order and
with the same bounds, and may end it earlier: as soon as some pair of points is known to be within
reach plus tolerance. Such a pair is looked for at two places. At two leaf nodes, the points are
compared with the larger distance. At a flat node, such as a piece of floor below a foot, the exact
descent only has to prove that nothing is in reach, and ends. There, one leaf node is looked up, and
its points are compared with those of the avatar that are near the plane.

Pruning uses the reach alone, so a pose never takes more node visits than without a tolerance, and
never more with a larger one. A pair near the tolerance may be overlooked, which costs no
correctness: the verdict is then that of tolerance 0.

The descent to that leaf node counts as point tests, not as node visits: it tests no bounds. Stored
discs of known point spacing, half as wide as a node, were tried instead. On the walk at 3 cm they
found 8 % of the poses within tolerance, because the exact descent ends at nodes of 0.3 to 0.5 m;
this finds 95 % and needs nothing stored.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ....schemas.runtime import compiling as nb
from ..core.kernel_decorators import njit_no_refcount
from ..core.node_overlap import STACK, U32, lanes_meet, next_near, nodes_meet, sphere_is_near
from ..core.placed_avatar import node_reach, pair_in_reach, place_block_once, place_node
from ..core.scene_arrays import (
    COUNT,
    COUNTED,
    FIRST,
    LANES,
    ROW_WORDS,
    leaf_class,
    node_class,
    point_class,
    stopped,
)

U = np.uint64  # see placed_avatar.py
# Verdicts of the kernels. EARLY: some pair is within reach plus tolerance, perhaps beyond reach.
CLEAR, CONTACT, UNKNOWN = 0, 1, 2  # schemas/wire/answers.py Verdict
EARLY = 3


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


@njit_no_refcount
def set_early(early, tolerance, units, units_per_step, error):
    """Write early (2,) float32 for one pose: a distance [steps], and the square of a sure pair.

    tolerance: exact units, above 0.  units: reach of the smallest sphere of a scan point, exact
    units.  error: of `make_thresholds` for the reach. A pair of centres whose float32 square is at
    most `early[1]` is within reach plus tolerance; -1 if none is sure.
    """
    extra = np.float64(tolerance) / units_per_step
    distance = np.float64(units) / units_per_step + extra
    # The error grows by 2 sqrt(3) U32 of what the reach grows by; 8 U32 cover that and all roundings
    # here.
    sure = distance * (1.0 - 8.0 * U32) - np.float64(error)
    early[0], early[1] = np.float32(distance), np.float32(-1.0)
    if sure > 0.0:
        early[1] = np.float32(sure * sure * (1.0 - 16.0 * U32))


@njit_no_refcount
def _leaf_towards(words, ints, rows, row, x, y, z):
    """Return the leaf node below `row` that is reached by the nearest centre at each level.

    rows: the voxel's first row.  x, y, z: float32, relative to the voxel's low corner.
    """
    first = np.int64(ints[U(row + FIRST)])
    while first >= 0:
        child = U(rows + first * ROW_WORDS)
        nearest, least = child, np.float32(np.inf)
        for _ in range(ints[U(row + COUNT)] & COUNTED):
            dx, dy, dz = x - words[child], y - words[child + U(1)], z - words[child + U(2)]
            square = dx * dx + dy * dy + dz * dz
            if square < least:
                nearest, least = child, square
            child += U(ROW_WORDS)
        row = np.int64(nearest)
        first = np.int64(ints[U(row + FIRST)])
    return row


@njit_no_refcount
def surely_near(words, ints, halves, block_words, location, row, x, y, z, lanes, block, early, keep, keep8):
    """Return whether a point of an avatar's block is within reach plus tolerance of a point found.

    location: VoxelLocation.  row: an inner node.  x, y, z: float32, the centre of the avatar's
    node, from the frame.  lanes: of PlacedAvatar.  early: see `set_early`.  keep, keep8: scratch.
    Returns (whether, point tests).
    """
    off_x, off_y, off_z = location.x, location.y, location.z
    leaf = _leaf_towards(words, ints, location.rows, row, x - off_x, y - off_y, z - off_z)
    if not lanes_meet(words, leaf, lanes, block, off_x, off_y, off_z, early[0], keep):
        return False, 0
    number = ~np.int64(ints[U(leaf + FIRST)])
    block_at = location.blocks + number * block_words
    lane_at = location.lanes + number * 3 * LANES
    low_x = off_x + np.float32(ints[U(block_at)])
    low_y = off_y + np.float32(ints[U(block_at + 1)])
    low_z = off_z + np.float32(ints[U(block_at + 2)])
    lane, tested = next_near(halves, lane_at, low_x, low_y, low_z, lanes, block, early[1], keep, keep8, 0)
    return lane >= 0, LANES * tested
