"""Contact of two bounding sphere hierarchies under a pose: [Fig12] section 6, corrected.

As printed, figures 5 and 6 descend into "all children A[i] and B[j]" when A is a leaf and B is not:
a leaf has no children, the loop runs zero times, and the contact is lost. Here inner nodes are
descended, whichever side they are on, and leaves never are.

The descent is that of front_descent.py.

An inequality of integers decides (NUMERICS.md N5). A float32 pass settles nearly all pairs. Its
distances are in lattice steps from a lattice point near the avatar; relative to it, scene
coordinates are integers below 2^24 and therefore exact. The placed avatar carries an error `error`,
which is added to every bound. Pairs of points below `near` touch; pairs above `far` do not; only
pairs between them need the integers.

Of the children to descend into, the one of least power distance to the avatar's root comes first,
and so does the voxel. In stored order, poses of the walk in contact ended after 863 node visits; now
they end after 491, in 0.8 of the time. Other poses must visit all nodes in any order. Sorting all
children saved a tenth of these visits and no time.

Early contact is a pair of points within reach plus tolerance, found before the descent needs it. A
request with a tolerance runs the same descent, in the same order and with the same bounds, and may
end it earlier: as soon as some pair of points is known to be within reach plus tolerance. Such a
pair is looked for at two places. At two leaf nodes, the points are compared with the larger
distance. At a flat node, such as a piece of floor below a foot, the exact descent only has to prove
that nothing is in reach, and ends. There, one leaf node is looked up, and its points are compared
with those of the avatar that are near the plane.

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
from ..core.array_references import with_flag
from ..core.front_descent import GO_ON, SKIP, Descent, descend_voxel, make_descent
from ..core.kernel_decorators import njit_inlined, njit_no_refcount
from ..core.node_bounds import (
    ONE_SLACK,
    STACK,
    U32,
    ClassThresholds,
    lanes_meet,
    locate_block,
    locate_voxel,
    make_class_thresholds,
    next_near,
    nodes_meet,
    set_class_thresholds,
)
from ..core.placed_avatar import (
    make_front,
    node_reach,
    pair_in_reach,
    place_block_once,
    place_front,
    place_node,
    place_root,
)
from ..core.reach import MISSING, NOT_HELD, VALID, find_reach, resident_front, state_of
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


class _CollideScratch(NamedTuple):
    """Scratch of one call.

    by_class: thresholds of the pose in hand.
    below: (STACK,) int64: avatar nodes below its front; one element where the front is leaf nodes.
    early: (2,) float32, see `set_early`.
    """

    descent: Descent
    by_class: ClassThresholds
    below: NDArray[np.int64]
    early: NDArray[np.float32]


@nb.njit(nogil=True, cache=True)
def _make_collide_scratch(avatar, deficit):
    """Allocate scratch for one avatar (not empty), and the radius classes of `deficit`."""
    below = STACK if avatar.first[avatar.front_first] >= 0 else 1
    return _CollideScratch(
        make_descent(avatar),
        make_class_thresholds(deficit),
        np.empty(below, np.int64),
        np.empty(2, np.float32),
    )


@njit_no_refcount
def _leaves_touch(avatar, m, a, scene, voxel, location, row, scratch):
    """Return CONTACT if a marked point of leaf node `a` of the avatar touches a point of leaf node `row`.

    Return EARLY if a pair within the tolerance is met first, and CLEAR if there is neither.
    """
    placed, keep, keep8 = scratch.descent.placed, scratch.descent.keep, scratch.descent.keep8
    by_class, early, block = scratch.by_class, scratch.early[1], ~np.int64(avatar.first[U(a)])
    halves, lanes, ints, mask = scene.halves, placed.lanes, scene.ints, by_class.mask
    block_at, lane_at, low_x, low_y, low_z = locate_block(ints, location, row, scene.block_words)
    far = max(by_class.far[leaf_class(ints, row, mask)], early)  # for the largest sphere in the block
    begin = 0
    while begin < LANES:
        lane, tested = next_near(halves, lane_at, low_x, low_y, low_z, lanes, block, far, keep, keep8, begin)
        scratch.descent.counters[1] += LANES * tested
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
def _below_touches(avatar, m, extent, pose, scene, voxel, location, a, row, scratch):
    """Return what `_leaves_touch` finds for a scene leaf node and a node of the avatar's front.

    The avatar's node is descended depth first. This is for avatars whose front is not their leaf
    nodes.
    """
    words, below, by_class, descent = scene.words, scratch.below, scratch.by_class, scratch.descent
    placed = descent.placed
    threshold = by_class.threshold[node_class(scene.ints, row, by_class.mask)]
    per_step = 1.0 / scene.step
    below[0] = a
    depth = 1
    while depth > 0 and not stopped(scene.stop):
        depth -= 1
        a = below[depth]
        a_first = avatar.first[a]
        descent.counters[0] += 1
        if a_first < 0:
            block = np.int64(~a_first)
            if avatar.inner_points > 0 and not _may_touch(
                avatar, m, extent, scene, location, a, row, threshold, scratch
            ):
                continue
            place_block_once(avatar, m, pose, block, placed, scene)
            if lanes_meet(
                words, row, placed.lanes, block, location.x, location.y, location.z, threshold, descent.keep
            ):
                found = _leaves_touch(avatar, m, a, scene, voxel, location, row, scratch)
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
def _may_touch(avatar, m, extent, scene, location, a, row, threshold, scratch):
    """Return whether a point of a scene leaf node is near a leaf node of the avatar.

    A scene leaf node of scattered points may hold much of the inside of a filled mesh without a
    touch. To test its points against the sphere of a leaf node takes less than to place and test
    the points in that node: 1.4 instead of 3.9 us a pose for a ball near the façade (bench_engine,
    `filled`).
    """
    _, lane_at, low_x, low_y, low_z = locate_block(scene.ints, location, row, scene.block_words)
    scratch.descent.counters[1] += LANES
    x, y, z = place_node(avatar, m, a, scratch.descent.placed, scene)
    x, y, z = x - low_x, y - low_y, z - low_z
    reach = node_reach(avatar.radius[a], 1.0 / scene.step, extent) + threshold
    halves, near, square = scene.halves, False, reach * reach * ONE_SLACK
    for j in range(LANES):
        i = U(lane_at) + U(j)
        dx = np.float32(halves[i]) - x
        dy = np.float32(halves[i + U(LANES)]) - y
        dz = np.float32(halves[i + U(2 * LANES)]) - z
        near |= dx * dx + dy * dy + dz * dz <= square
    return near


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
def _surely_near(words, ints, halves, block_words, location, row, x, y, z, lanes, block, early, keep, keep8):
    """Return whether a point of an avatar's block is within reach plus tolerance of a point found.

    location: VoxelLocation.  row: an inner node.  x, y, z: float32, the centre of the avatar's
    node, from the frame.  lanes: of PlacedAvatar.  early: see `set_early`.  keep, keep8: scratch.
    Returns (whether, point tests).
    """
    off_x, off_y, off_z = location.x, location.y, location.z
    leaf = _leaf_towards(words, ints, location.rows, row, x - off_x, y - off_y, z - off_z)
    if not lanes_meet(words, leaf, lanes, block, off_x, off_y, off_z, early[0], keep):
        return False, 0
    _, lane_at, low_x, low_y, low_z = locate_block(ints, location, leaf, block_words)
    lane, tested = next_near(halves, lane_at, low_x, low_y, low_z, lanes, block, early[1], keep, keep8, 0)
    return lane >= 0, LANES * tested


@njit_inlined
def _flat_touches(scene, location, row, x, y, z, block, threshold, scratch):
    """Return EARLY if a point of a block is surely within the tolerance of one below a flat node.

    Return SKIP if no point is near the node, within the reach or within the tolerance.
    """
    words, descent, early = scene.words, scratch.descent, scratch.early
    # Points beyond the wider reach are also beyond the exact one: most blocks need this test alone.
    # The largest sphere may reach farther than the smallest one with the tolerance.
    wide, lanes, keep = max(threshold, early[0]), descent.placed.lanes, descent.keep
    if not lanes_meet(words, row, lanes, block, location.x, location.y, location.z, wide, keep):
        return SKIP
    near, tests = _surely_near(
        words, scene.ints, scene.halves, scene.block_words, location, row, x, y, z, lanes, block, early, keep,
        descent.keep8,
    )  # fmt: skip
    descent.counters[1] += tests
    return EARLY if near else GO_ON


@njit_no_refcount
def _collide_voxel(avatar, m, extent, pose, scene, voxel, location, front, count, scratch):
    """Return CONTACT, EARLY or CLEAR for one resident voxel, whose root the placed avatar meets."""
    by_class = scratch.by_class
    found, _ = descend_voxel(
        avatar, m, extent, pose, scene, voxel, location, front, count, scratch, by_class.threshold, by_class.mask,
        True, scratch.early[1] > np.float32(0.0), _flat_touches, _leaves_touch, _below_touches,
    )  # fmt: skip
    return found


@nb.njit(nogil=True, cache=True)
def collide_poses(poses, avatar, scene, reach, which, cursor, state, tolerance, verdict, counts):
    """Answer `collide` for the poses numbered in `which`, each from its cursor on.

    poses: (k, 4, 4), checked.  avatar: not empty.  reach: VoxelsInReach of all k poses.
    cursor: (k,) int64, entries of `reach.lists` that are examined; a pose is finished at the end of
    its list.  state: (v,) uint8, what may be examined now, see queries/load_and_search.py.
    tolerance: exact units by which a pair may exceed the reach and still end the search, as EARLY.
    Accumulates into verdict (k,) uint8 and counts (3, k) uint32 (voxels missing, node visits, point
    tests), whose initial values are CLEAR and 0. A contact, early or not, overrides a missing voxel,
    and a missing voxel overrides CLEAR. Once the scene's stop flag is set, poses are not
    finished.
    """
    front, scratch = make_front(avatar), _make_collide_scratch(avatar, scene.radius_deficit)
    _collide_poses(
        poses, avatar, scene, reach, which, cursor, state, tolerance, verdict, counts, front, scratch
    )


@njit_no_refcount
def _collide_poses(
    poses, avatar, scene, reach, which, cursor, state, tolerance, verdict, counts, front, scratch
):
    """Implement `collide_poses` with its scratch passed in."""
    placed, counters, by_class = scratch.descent.placed, scratch.descent.counters, scratch.by_class
    nodes, ints, rows = placed.nodes, scene.ints, reach.lists.rows
    scratch.early[:] = np.float32(-1.0)
    largest_deficit = np.int64(0)
    for c in range(scene.radius_deficit.shape[0]):
        largest_deficit = max(largest_deficit, scene.radius_deficit[c])
    for number in range(which.shape[0]):
        i = which[number]
        at, end = cursor[i], reach.lists.starts[i + 1]
        if at == end:
            continue
        if stopped(scene.stop):
            return
        m = poses[i]
        counters[0], counters[1] = 0, 0
        extent, farthest = place_root(avatar, m, placed, scene)
        error = set_class_thresholds(by_class, scene, reach.units[i], extent, farthest)
        if tolerance > 0:
            set_early(scratch.early, tolerance, reach.units[i] - largest_deficit, scene.units_per_step, error)
        count = 0  # length of the front; not placed yet, as most far poses never need it
        while at < end:
            voxel = rows[at]
            may = state_of(state, voxel)
            if may == NOT_HELD:
                break
            if may == MISSING:
                counts[0, i] += np.uint32(1)
                verdict[i] = UNKNOWN
                at += 1
                continue
            location = locate_voxel(scene, voxel, placed)
            x, y, z = nodes[0, 0] - location.x, nodes[1, 0] - location.y, nodes[2, 0] - location.z
            counters[0] += 1
            threshold = by_class.threshold[node_class(ints, location.rows, by_class.mask)]
            if nodes_meet(scene.words, location.rows, x, y, z, nodes[3, 0], threshold):
                if count == 0:
                    count = place_front(avatar, m, placed, scene, extent, front.bounds)
                found = _collide_voxel(avatar, m, extent, i, scene, voxel, location, front, count, scratch)
                if found != CLEAR:
                    verdict[i], at = found, end
                    break
                if stopped(scene.stop):
                    break
            at += 1
        cursor[i] = at
        counts[1, i] += np.uint32(counters[0])
        counts[2, i] += np.uint32(counters[1])


@nb.njit(nogil=True, cache=True)
def collide_resident(pose, body, radius, other_units, tolerance, held, stop, verdict, counts):
    """Answer `collide` for one pose in one call, where the resident voxels suffice.

    They do if all voxels in reach are resident, or if those before the first absent one hold a contact.

    pose: (1, 4, 4).  body, held: references to the arrays of the avatar and the scene
    (array_references.py).  stop: (1,) int64, the request's stop flag.
    This is `find_reach`, then `collide_poses`. Writes held.one, the voxels in reach, and verdict (1,)
    and counts (3, 1) as `collide_poses` does.
    Returns (fault, value found), as `check_poses` does, and the number of voxels examined. -1: not
    answered, because a voxel has to be loaded, the rows do not fit, or the request was stopped.
    """
    avatar, scene, one, reach = body.avatar, with_flag(held.scene, stop), held.one, held.one.reach
    verdict[0], counts[0, 0], counts[1, 0], counts[2, 0] = CLEAR, np.uint32(0), np.uint32(0), np.uint32(0)
    fault, _, found, needed = find_reach(pose, avatar, radius, other_units, scene, held.tree, reach)
    front = resident_front(scene.where, reach.lists.rows, needed)
    if fault != VALID or front < 0:
        return fault, found, -1
    if needed > 0:
        one.cursor[0], reach.lists.starts[1] = 0, front
        collide_poses(
            pose, avatar, scene, reach, one.which, one.cursor, held.one.all_held, tolerance, verdict, counts,
        )  # fmt: skip
        if one.cursor[0] < front or (front < needed and verdict[0] == CLEAR):
            return fault, found, -1
    return fault, found, front
