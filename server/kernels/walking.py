"""The descent of a walker: the entries whose reason is used up are looked at again, pose by pose; see memory.py.

A pose costs two vector loops over the entries, and about a tenth of a microsecond for each that is looked at again:
some eight a pose at 30 frames a second and 4 cm a step, four at 90.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...schemas.kernels import compiling as nb
from .compiled import borrowing, inlined
from .front import U
from .layout import COUNT, COUNTED, FIRST, LANES, ROW_WORDS, node_class
from .memory import (
    AFRESH,
    AROUND,
    BLUR,
    CENTER,
    ENTRIES,
    GAP,
    KNOWN,
    LARGEST,
    LEAST_GAP,
    NEAR,
    NORMAL,
    ROOM,
    SCALE,
    TURNED,
    WAY,
    add_voxels,
    bits_of,
    find_closed,
    find_used,
    from_box,
    least_gap,
    number_of,
    open_gap,
    sift_body,
    start_afresh,
    travelled,
    turn_points,
)
from .overlap import (
    CONTACT,
    UNKNOWN,
    lanes_meet,
    leaves_touch,
    make_spot,
    make_work,
    overlap_poses,
    rows_or_undone,
)
from .placed import make_by_class, make_placed, place_lanes, place_root, set_by_class
from .placing import GOOD, place
from .reach import Reach, find_reach
from .stopping import MOST_QUICK_VISITS, is_over, stopped

# An inner node stays where it is good for so many steps like the last, and for this way [m].
STEPS_AHEAD, LEAST_WAY = 1.0, 0.01

FULL, NOTHING, TOUCHES, LEFT = range(4)


class Hands(NamedTuple):
    """Scratch of one call. used, closed: (ENTRIES,) bool, entries and gaps.  apart, above, below, meets: (f,), see
    `sift_body`.

    used8, meets8: the same as uint64, eight at a time.  turn: (9,) float32.  points: (3, LANES) float32.
    """

    used: NDArray[np.bool_]
    used8: NDArray[np.uint64]
    closed: NDArray[np.bool_]
    apart: NDArray[np.int32]
    above: NDArray[np.float32]
    below: NDArray[np.float32]
    meets: NDArray[np.bool_]
    meets8: NDArray[np.uint64]
    turn: NDArray[np.float32]
    points: NDArray[np.float32]


@borrowing
def _held(voxels, begin, end, voxel):
    """Whether a voxel is among those in reach."""
    found = False
    for at in range(begin, end):
        found |= voxels[at] == voxel
    return found


@borrowing
def _still_touching(avatar, m, pose, placed, scene, by_class, memory, work):
    """Whether the pair of leaf nodes that touched last touches still."""
    block, voxel = memory.touched[0], memory.touched[1]
    spot = make_spot(scene, voxel, placed)
    row = spot.rows + memory.touched[2]
    if placed.stamp[U(block)] != pose:
        place_lanes(avatar.points, m, block, placed.lanes, placed.shift, placed.frame, scene.step)
        placed.stamp[U(block)] = pose
    work.counters[0] += 1
    room = by_class.room[node_class(scene.ints, row, by_class.mask)]
    if not lanes_meet(scene.words, row, placed.lanes, block, spot.x, spot.y, spot.z, room, work.keep):
        return False
    return leaves_touch(avatar, m, block, placed, scene, voxel, spot, row, by_class, work)


@inlined
def _look_again(
    avatar, m, scale, pose, placed, scene, rows, begin, end, by_class, memory, work, hands, step_way, x0, y0, z0
):  # fmt: skip
    """Look at the entries that are marked in `used`, and at what they give way to, at pose m.

    rows[begin:end]: the voxels in reach.  step_way: travelled since the last pose.  x0, y0, z0: the root's center from
    the frame. Returns NOTHING, TOUCHES, FULL: no room for more entries, or LEFT: scene.stop is set, or the visits are
    spent. Whenever it returns, all entries together hold all that could be touched, and what is known of each is true.

    Long, for what `_overlap_voxel` is: every call of a function that takes tuples of arrays costs as much as the work.
    Inlined where it is called, once: a walker then takes 0.6 times as long a pose.
    """
    words, ints, coordinates, where, halves = (
        scene.words,
        scene.ints,
        scene.coordinates,
        scene.where,
        scene.halves,
    )
    until, gaps, entry_of, nodes = memory.until, memory.gaps, memory.entry_of, memory.nodes
    counts, body, frame = memory.counts, memory.body, memory.frame
    used, used8, apart, above, below = hands.used, hands.used8, hands.apart, hands.above, hands.below
    meets, meets8, turn, points = hands.meets, hands.meets8, hands.turn, hands.points
    firsts, front_first, stamp, counters = avatar.first, avatar.front_first, placed.stamp, work.counters
    per_step, inverse, front = 1.0 / scene.step, 1.0 / scale, avatar.front.shape[1]
    way, most_room, extent = memory.state[WAY], memory.state[ROOM], avatar.radius[0] * scale * per_step
    # Less than the drop, by more than anything here rounds.
    drop, per_unit = scene.drop, (1.0 - 1e-6) / scene.units_per_step
    rooms, mask = by_class.room, by_class.mask
    some_smaller, room = mask > U(0), most_room
    near = np.float32(NEAR * per_step)
    near_bits = bits_of(near)
    enough = max(step_way * STEPS_AHEAD, LEAST_WAY * per_step)
    m00, m01, m02 = m[0, 0] * inverse, m[0, 1] * inverse, m[0, 2] * inverse
    m10, m11, m12 = m[1, 0] * inverse, m[1, 1] * inverse, m[1, 2] * inverse
    m20, m21, m22 = m[2, 0] * inverse, m[2, 1] * inverse, m[2, 2] * inverse
    i = 0
    while i < counts[0]:
        k = U(i)
        if i % 8 == 0 and used8[U(i // 8)] == U(0):
            i += 8
            continue
        if not used[k] or not _held(rows, begin, end, nodes[k, 0]):
            i += 1
            continue
        if is_over(scene.stop, counters[0], counters[2]):
            return LEFT
        voxel, g = nodes[k, 0], nodes[k, 2]
        row = where[U(voxel), 0] + nodes[k, 1]
        w = U(row)
        # The node's center from the root's, axes of the world.
        x = np.float64(words[w]) + np.float64(coordinates[voxel, 0] * scene.voxel_steps - frame[0]) - x0
        y = (
            np.float64(words[w + U(1)])
            + np.float64(coordinates[voxel, 1] * scene.voxel_steps - frame[1])
            - y0
        )
        z = (
            np.float64(words[w + U(2)])
            + np.float64(coordinates[voxel, 2] * scene.voxel_steps - frame[2])
            - z0
        )
        radius, length = np.float64(words[w + U(3)]), np.float64(words[w + U(7)])
        if some_smaller:
            room = most_room - np.float64(drop[node_class(ints, row, mask)]) * per_unit
        size = math.sqrt(x * x + y * y + z * z)
        blur = BLUR * (size + radius + extent + room)
        span = radius + room + blur
        first = np.int64(ints[w + U(FIRST)])
        counters[0] += 1
        until[k] = np.float32(-1.0)
        good = size - extent - span
        if good > np.float64(near):
            until[k] = np.float32((way + good) * (1.0 - 1e-6))
            if g >= 0:
                open_gap(gaps, g)
            i += 1
            continue
        if first < 0 or radius < extent:
            counters[0] += front
            nx, ny, nz = np.float64(words[w + U(4)]), np.float64(words[w + U(5)]), np.float64(words[w + U(6)])
            vx, vy, vz = m00 * x + m10 * y + m20 * z, m01 * x + m11 * y + m21 * z, m02 * x + m12 * y + m22 * z
            tx, ty = m00 * nx + m10 * ny + m20 * nz, m01 * nx + m11 * ny + m21 * nz
            tz = m02 * nx + m12 * ny + m22 * nz
            more = length * (room + 2.0 * blur)
            nearest, up, down, rest = sift_body(
                body, np.float32(vx), np.float32(vy), np.float32(vz), np.float32(span), np.float32(tx),
                np.float32(ty), np.float32(tz), np.float32(np.float64(words[w + U(8)]) - more),
                np.float32(np.float64(words[w + U(9)]) + more), np.float32(length * LEAST_GAP * per_step), apart, above,
                below, meets,
            )  # fmt: skip
            within = np.int32(max(nearest, min(near_bits, max(up, down))))
            good = np.float64(number_of(within))
            if good >= enough or (first < 0 and good > 0.0):
                until[k] = np.float32((way + good) * (1.0 - 1e-6))
                if within == nearest:  # no front node is nearer: the way alone is reason enough
                    if g >= 0:
                        open_gap(gaps, g)
                    i += 1
                    continue
                if g < 0:
                    g = counts[2]
                    counts[2] += 1
                    nodes[k, 2], entry_of[g] = g, i
                side = 1.0 if up >= down else -1.0
                gap = np.float64(
                    number_of(least_gap(apart, above if up >= down else below, body.shape[1], within))
                )
                nx, ny, nz, tx, ty, tz = side * nx, side * ny, side * nz, side * tx, side * ty, side * tz
                gaps[NORMAL, g], gaps[NORMAL + 1, g], gaps[NORMAL + 2, g] = nx, ny, nz
                gaps[CENTER, g], gaps[CENTER + 1, g], gaps[CENTER + 2, g] = vx, vy, vz
                gaps[TURNED, g], gaps[TURNED + 1, g], gaps[TURNED + 2, g] = tx, ty, tz
                around = (good + span + 2.0 * memory.state[LARGEST]) * (1.0 + 1e-6)
                gaps[AROUND, g] = around
                plane = tx * vx + ty * vy + tz * vz + nx * x0 + ny * y0 + nz * z0
                gaps[GAP, g] = (
                    gap - plane - BLUR * length * (size + AFRESH * per_step + 2.0 * extent + around)
                )
                i += 1
                continue
        if first >= 0:
            children = np.int64(ints[w + U(COUNT)] & COUNTED)
            if counts[0] + children > ENTRIES:
                return FULL
            child = first * ROW_WORDS
            nodes[k, 1] = child
            for _ in range(1, children):
                child += ROW_WORDS
                u = U(counts[0])
                nodes[u, 0], nodes[u, 1], nodes[u, 2] = voxel, child, -1
                until[u] = np.float32(-1.0)
                used[u] = True
                counts[0] += 1
            continue
        # A leaf node: its points, and the front nodes that meet it. A node across an edge, of wall and floor say, is
        # as thick as it is wide, and its points tell more than its slab.
        if g >= 0:
            open_gap(gaps, g)
        block_at = where[U(voxel), 1] + ~first * scene.block_words
        x += np.float64(ints[U(block_at)]) - np.float64(words[w])
        y += np.float64(ints[U(block_at + 1)]) - np.float64(words[w + U(1)])
        z += np.float64(ints[U(block_at + 2)]) - np.float64(words[w + U(2)])
        lane_at = where[U(voxel), 2] + ~first * 3 * LANES
        turn_points(halves, lane_at, np.float32(x), np.float32(y), np.float32(z), turn, points)
        least = np.float64(number_of(np.int32(rest)))
        for node in range(front):
            if node % 8 == 0 and meets8[U(node // 8)] == U(0):
                continue
            if not meets[U(node)]:
                continue
            counters[0] += 1
            far = math.sqrt(np.float64(number_of(from_box(points, body, node)))) - room - blur
            least = min(least, far)
            if far > 0.0:
                continue
            block = ~np.int64(firsts[U(front_first + node)])
            if stamp[U(block)] != pose:
                place_lanes(avatar.points, m, block, placed.lanes, placed.shift, placed.frame, scene.step)
                stamp[U(block)] = pose
            spot = make_spot(scene, voxel, placed)
            counters[0] += 1
            nearby = rooms[node_class(ints, row, mask)]
            if not lanes_meet(words, row, placed.lanes, block, spot.x, spot.y, spot.z, nearby, work.keep):
                continue
            if leaves_touch(avatar, m, block, placed, scene, voxel, spot, row, by_class, work):
                memory.touched[0], memory.touched[1], memory.touched[2] = block, voxel, nodes[k, 1]
                return TOUCHES
        if least > 0.0:
            until[k] = np.float32((way + least) * (1.0 - 1e-6))
        i += 1
    return NOTHING


@borrowing
def _center(avatar, m, placed, scene, frame, r):
    """Coordinate r of the placed root's center from a frame [steps], float64."""
    c = avatar.center
    root = place(m, placed.shift, r, c[0, 0], c[0, 1], c[0, 2])
    return (root - np.float64(frame[r]) * scene.step) / scene.step


@borrowing
def _walk_on(poses, begin_at, avatar, scene, reach, verdict, counts, memory, placed, by_class, work, hands):
    """`walk_poses` from pose `begin_at` on, with its scratch. Returns the pose for which there was no room, or k."""
    state, frame, turn, used, closed = memory.state, memory.frame, hands.turn, hands.used, hands.closed
    per_step = 1.0 / scene.step
    for i in range(begin_at, poses.shape[0]):
        m, scale = poses[i], reach.scales[i]
        begin, end = reach.starts[i], reach.starts[i + 1]
        if begin == end:
            continue
        work.counters[0], work.counters[1] = 0, 0
        extent, farthest = place_root(avatar, m, scale, placed, scene)
        set_by_class(
            by_class, scene.drop, reach.units[i], scene.units_per_step, extent, farthest, scene.voxel_steps
        )
        step_way = 0.0
        if state[KNOWN] == 1.0:
            step_way = travelled(avatar, m, memory.last, scale) * per_step * (1.0 + 1e-9)
            state[WAY] += step_way
        for r in range(4):
            for c in range(4):
                memory.last[r, c] = m[r, c]
        found = NOTHING
        held = memory.touched[0] >= 0 and _held(reach.rows, begin, end, memory.touched[1])
        if held and _still_touching(avatar, m, i, placed, scene, by_class, memory, work):
            found = TOUCHES
        if found == NOTHING:
            memory.touched[0] = -1
            if state[KNOWN] != 1.0 or state[SCALE] != scale or state[WAY] > AFRESH * per_step:
                start_afresh(avatar, scale, scene, memory, by_class.room, placed, extent)
            if not add_voxels(reach.rows, begin, end, memory):
                state[KNOWN] = 0.0
                return i
            x = _center(avatar, m, placed, scene, frame, 0)
            y = _center(avatar, m, placed, scene, frame, 1)
            z = _center(avatar, m, placed, scene, frame, 2)
            for r in range(3):
                for c in range(3):
                    turn[3 * r + c] = np.float32(m[r, c] / scale)
            work.counters[0] += memory.counts[0]
            some = find_used(memory.until, memory.counts[0], np.float32(state[WAY] * (1.0 + 1e-6)), used)
            if find_closed(
                memory.gaps, memory.counts[2], turn, np.float32(x), np.float32(y), np.float32(z), closed
            ):
                for g in range(memory.counts[2]):
                    if closed[U(g)]:
                        used[memory.entry_of[U(g)]] = True
                some = True
            if some:
                found = _look_again(
                    avatar, m, scale, i, placed, scene, reach.rows, begin, end, by_class, memory, work, hands, step_way,
                    x, y, z,
                )  # fmt: skip
            if found == FULL:
                state[KNOWN] = 0.0
                return i
        if found == TOUCHES:
            verdict[i] = CONTACT
        elif found == LEFT or stopped(scene.stop):
            state[KNOWN] = 0.0
            verdict[i] = UNKNOWN
        counts[1, i], counts[2, i] = np.uint32(work.counters[0]), np.uint32(work.counters[1])
    return poses.shape[0]


@nb.njit(nogil=True, cache=True)
def walk_poses(poses, avatar, scene, reach, most, verdict, counts, memory):
    """Answer `collide` for the poses of one walk in their order, with what is known of the pose before each.

    poses: (k, 4, 4), checked.  avatar: not empty, its front leaf nodes.  reach: Reach of these poses; all voxels in it
    are resident.  most: node visits of a pose, beyond which it is UNKNOWN and nothing is remembered.
    Writes verdict (k,) uint8 and counts (3, k) uint32, all 0 before, as `overlap_poses` does, and memory.
    """
    f = memory.body.shape[1]
    used, meets = np.zeros(ENTRIES, np.bool_), np.zeros(f, np.bool_)
    hands = Hands(
        used, used.view(np.uint64), np.zeros(ENTRIES, np.bool_), np.empty(f, np.int32), np.empty(f, np.float32),
        np.empty(f, np.float32), meets, meets.view(np.uint64), np.empty(9, np.float32),
        np.empty((3, LANES), np.float32),
    )  # fmt: skip
    placed, by_class, work = make_placed(avatar), make_by_class(scene.drop), make_work(avatar)
    work.counters[2] = most
    at = 0
    while at < poses.shape[0]:
        at = _walk_on(poses, at, avatar, scene, reach, verdict, counts, memory, placed, by_class, work, hands)
        if at < poses.shape[0]:
            overlap_poses(poses, avatar, scene, reach, np.full(1, at), most, verdict, counts)
            at += 1


@nb.njit(nogil=True, cache=True)
def walk_resident(poses, avatar, radius, other_units, scene, index, rows, outside, verdict, counts, memory):
    """A whole request in one call, where all voxels in its reach are resident: as `answer_resident`, with memory.

    Returns what that does; where it answers -1, memory is as it was, or says that nothing is known.
    """
    k = poses.shape[0]
    reach = Reach(
        np.empty(k), np.empty(k, np.int64), np.zeros(k + 1, np.int64), rows, np.empty((k, 2, 3)), outside
    )
    fault, pose, found, needed = find_reach(poses, avatar, radius, other_units, scene, index, reach)
    if fault != GOOD or needed < 0 or needed > rows.shape[0]:
        return fault, pose, found, -1
    for at in range(needed):
        if scene.where[rows[at], 0] < 0:
            return fault, pose, found, -1
    walk_poses(poses, avatar, scene, reach, MOST_QUICK_VISITS, verdict, counts, memory)
    return fault, pose, found, rows_or_undone(needed, verdict, counts)
