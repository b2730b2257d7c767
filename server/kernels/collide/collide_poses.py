"""Contact of two bounding sphere hierarchies under a pose: [Fig12] section 6, corrected.

As printed, figures 5 and 6 descend into "all children A[i] and B[j]" when A is a leaf and B is not:
a leaf has no children, the loop runs zero times, and the contact is lost. Here inner nodes are
descended, whichever side they are on, and leaves never are.

The scene's tree is descended with the whole front of the avatar's tree (placed_avatar.py). Where a
scene node is a leaf, or flat compared with the avatar's leaf nodes, the avatar's points themselves
are tested against its bound, LANES in a vector step. The slab of a floor then clears a foot that
stands a centimetre above it, while the foot's sphere would not.

An inequality of integers decides (NUMERICS.md N5). A float32 pass settles nearly all pairs. Its
distances are in lattice steps from a lattice point near the avatar; relative to it, scene
coordinates are integers below 2^24 and therefore exact. The placed avatar carries an error `error`,
which is added to every bound. Pairs of points below `near` touch; pairs above `far` do not; only
pairs between them need the integers.

Of the children to descend into, the one of least power distance to the avatar's root comes first,
and so does the voxel. In stored order, poses of the walk in contact ended after 863 node visits; now
they end after 491, in 0.8 of the time. Other poses must visit all nodes in any order. Sorting all
children saved a tenth of these visits and no time.
"""

import numpy as np

from ....schemas.runtime import compiling as nb
from ..core.array_references import with_flag
from ..core.kernel_decorators import njit_no_refcount
from ..core.node_overlap import (
    BROAD,
    FLAT,
    compact_marked,
    copy_node,
    lanes_meet,
    locate_voxel,
    make_class_thresholds,
    mark_meeting,
    nodes_meet,
    power_distance,
    set_class_thresholds,
)
from ..core.placed_avatar import (
    make_front,
    make_placed,
    pad_list,
    place_front,
    place_lanes,
    place_root,
)
from ..core.reach import MISSING, NOT_HELD, resident_front, state_of
from ..core.scene_arrays import (
    COUNT,
    COUNTED,
    FIRST,
    LANES,
    ROW_WORDS,
    node_class,
    stopped,
)
from ..core.voxels_in_reach import VALID, find_reach
from .leaf_contact import (
    CLEAR,
    EARLY,
    UNKNOWN,
    below_touches,
    leaves_touch,
    make_collide_scratch,
    set_early,
    surely_near,
)

U = np.uint64  # see placed_avatar.py


@njit_no_refcount
def _collide_voxel(avatar, m, extent, pose, placed, scene, voxel, location, by_class, front, count, scratch):
    """Return CONTACT, EARLY or CLEAR for one resident voxel, whose root the placed avatar meets.

    The scene's tree is descended depth first, each node with a list of
    those front nodes that met its parent. The function is long because each of its inner steps
    takes some ten nanoseconds: a call that passes tuples of arrays, or takes arrays out of them,
    costs the same again (11 us a pose instead of 4 with each step in a function).
    """
    words, ints, stack, counters = scene.words, scene.ints, scratch.stack, scratch.counters
    bounds, which, nodes, lanes, stamp = front.bounds, front.which, placed.nodes, placed.lanes, placed.stamp
    listed, listed8, keep = front.keep, front.keep8, scratch.keep
    firsts, front_first, points = avatar.first, avatar.front_first, avatar.points
    shift, frame, step = placed.shift, placed.frame, scene.step
    off_x, off_y, off_z = location.x, location.y, location.z
    thresholds, mask = by_class.threshold, by_class.mask
    by_size, threshold, stop = mask > U(0), thresholds[0], scene.stop
    early = scratch.early
    tolerant = early[1] > np.float32(0.0)
    x, y, z, radius = nodes[0, 0] - off_x, nodes[1, 0] - off_y, nodes[2, 0] - off_z, nodes[3, 0]
    stack[0, 0], stack[0, 1], stack[0, 2] = location.rows, 0, count
    depth = 1
    while depth > 0 and not stopped(stop):
        depth -= 1
        row, at, count = stack[U(depth), 0], stack[U(depth), 1], stack[U(depth), 2]
        first = np.int64(ints[U(row + FIRST)])
        if by_size:
            threshold = thresholds[node_class(ints, row, mask)]
        if first < 0 or words[U(row + 3)] < BROAD * radius:
            counters[0] += count
            steps = (count + LANES - 1) // LANES
            if not mark_meeting(words, row, bounds, at, steps, off_x, off_y, off_z, threshold, listed):
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
                        if tolerant and first >= 0:
                            # Points beyond the wider reach are also beyond the exact one: most
                            # blocks need this test alone. The largest sphere may reach farther than
                            # the smallest one with the tolerance.
                            wide = max(threshold, early[0])
                            if not lanes_meet(words, row, lanes, block, off_x, off_y, off_z, wide, keep):
                                continue
                            u = U(i)
                            x_a, y_a, z_a = bounds[0, u], bounds[1, u], bounds[2, u]
                            near, tests = surely_near(
                                words, ints, scene.halves, scene.block_words, location, row, x_a, y_a, z_a,
                                lanes, block, early, keep, scratch.keep8,
                            )  # fmt: skip
                            counters[1] += tests
                            if near:
                                return EARLY
                        if not lanes_meet(words, row, lanes, block, off_x, off_y, off_z, threshold, keep):
                            continue
                        if first < 0:
                            found = leaves_touch(
                                avatar, m, block, placed, scene, voxel, location, row, by_class, scratch
                            )
                            if found != CLEAR:
                                return found
                            if stopped(stop):  # the blocks of a whole front may take milliseconds
                                return CLEAR
                            continue
                    elif first < 0:
                        found = below_touches(
                            avatar, m, extent, pose, placed, scene, voxel, location, a, row, by_class, scratch
                        )  # fmt: skip
                        if found != CLEAR:
                            return found
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
        nearest, least = depth, np.float32(np.inf)
        for _ in range(children):
            u = U(depth)
            stack[u, 0], stack[u, 1], stack[u, 2] = child, at, count
            if by_size:
                threshold = thresholds[node_class(ints, child, mask)]
            if nodes_meet(words, child, x, y, z, radius, threshold):
                power = power_distance(words, child, x, y, z)
                if power < least:
                    nearest, least = depth, power
                depth += 1
            child += ROW_WORDS
        if least < np.float32(np.inf):
            top, best = U(depth - 1), U(nearest)
            stack[top, 0], stack[best, 0] = stack[best, 0], stack[top, 0]
    return CLEAR


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
    placed, front, scratch = make_placed(avatar), make_front(avatar), make_collide_scratch(avatar)
    by_class = make_class_thresholds(scene.radius_deficit)
    _collide_poses(
        poses, avatar, scene, reach, which, cursor, state, tolerance, verdict, counts, placed, front, by_class, scratch
    )  # fmt: skip


@njit_no_refcount
def _collide_poses(
    poses, avatar, scene, reach, which, cursor, state, tolerance, verdict, counts, placed, front, by_class, scratch
):  # fmt: skip
    """Implement `collide_poses` with its scratch passed in."""
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
        scratch.counters[0], scratch.counters[1] = 0, 0
        extent, farthest = place_root(avatar, m, placed, scene)
        error = set_class_thresholds(
            by_class,
            scene.radius_deficit,
            reach.units[i],
            scene.units_per_step,
            extent,
            farthest,
            scene.voxel_steps,
        )
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
            scratch.counters[0] += 1
            threshold = by_class.threshold[node_class(ints, location.rows, by_class.mask)]
            if nodes_meet(scene.words, location.rows, x, y, z, nodes[3, 0], threshold):
                if count == 0:
                    count = place_front(avatar, m, placed, scene, extent, front.bounds)
                found = _collide_voxel(
                    avatar, m, extent, i, placed, scene, voxel, location, by_class, front, count, scratch
                )
                if found != CLEAR:
                    verdict[i], at = found, end
                    break
                if stopped(scene.stop):
                    break
            at += 1
        cursor[i] = at
        counts[1, i] += np.uint32(scratch.counters[0])
        counts[2, i] += np.uint32(scratch.counters[1])


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
