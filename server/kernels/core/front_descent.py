"""Descent of the scene's tree with the front of an avatar's tree, for `collide` and `distance`.

The scene's tree of one voxel is descended depth first, with the whole front (placed_avatar.py): each
node with a list of those front nodes that met its parent. Where a scene node is a leaf, or flat
compared with the avatar's leaf nodes, the avatar's points themselves are tested against its bound,
LANES in a vector step. The slab of a floor then clears a foot that stands a centimetre above it,
while the foot's sphere would not.

A search differs by what it does with a leaf node of the scene and one of the avatar, and by its cut:
`collide` ends at the first contact within a reach, `distance` lowers its cut with each pair found.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ....schemas.runtime import compiling as nb
from .node_bounds import (
    BROAD,
    FLAT,
    STACK,
    compact_marked,
    copy_node,
    lanes_meet,
    mark_meeting,
    nodes_meet,
    power_distance,
)
from .placed_avatar import PlacedAvatar, make_placed, pad_list, place_lanes
from .scene_arrays import COUNT, COUNTED, FIRST, LANES, ROW_WORDS, node_class, stopped

U = np.uint64  # see placed_avatar.py
# What a search's functions return, besides a verdict that ends the descent: go on, or go on with the
# next node of the front.
GO_ON, SKIP = 0, -1


class Descent(NamedTuple):
    """Scratch of one call.

    placed: the avatar under the pose in hand.
    stack: (STACK, 3) int64, scene nodes still to examine: row, start of the list, length.
    keep: (LANES,) bool, marks; keep8: the same memory as uint64, eight marks each.
    counters: (3,) int64, node visits, point tests, one of the search.
    """

    placed: PlacedAvatar
    stack: NDArray[np.int64]
    keep: NDArray[np.bool_]
    keep8: NDArray[np.uint64]
    counters: NDArray[np.int64]


@nb.njit(nogil=True, cache=True)
def make_descent(avatar):
    """Allocate scratch for one avatar (not empty)."""
    keep = np.zeros(LANES, np.bool_)
    return Descent(
        make_placed(avatar), np.empty((STACK, 3), np.int64), keep, keep.view(np.uint64), np.zeros(3, np.int64)
    )


@nb.njit(nogil=True, inline="always")
def descend_voxel(
    avatar, m, extent, pose, scene, voxel, location, front, count, scratch, cut, mask, first_hit, tolerant,
    on_flat, on_leaves, on_below,
):  # fmt: skip
    """Search one resident voxel with the placed avatar's front, the first `count` entries of `front`.

    m: pose, number `pose` of the request.  extent: of `place_root`.  location: of the voxel.
    scratch: the search's own, with a `descent`.  cut: (n,) float32, by radius class: nodes farther
    apart are pruned.  mask: the number of classes minus one, uint64.
    first_hit: whether the first pair found ends the search, a constant. Then the cut never changes, and
    of the children to descend into, the one of least power distance to the avatar's root comes first.
    tolerant: whether `on_flat` is called.
    on_flat(scene, location, row, x, y, z, block, threshold, scratch): called for a flat inner node and
    an avatar's leaf node, whose centre is x, y, z from the frame.
    on_leaves(avatar, m, a, scene, voxel, location, row, scratch): for leaf nodes of both, the latter's
    points marked.
    on_below(avatar, m, extent, pose, scene, voxel, location, a, row, scratch): for a leaf node of the
    scene, and a front node that is none.
    They return GO_ON, SKIP, or a verdict above 0, which ends the search.
    Returns (verdict or GO_ON, entries of the stack that are not, or only in part, searched because of
    the stop flag).

    The function is long, and a part of its callers, because each of its inner steps takes some ten
    nanoseconds: a call that passes tuples of arrays, or takes arrays out of them, costs the same again
    (11 us a pose instead of 4 with each step in a function).
    """
    words, ints, descent = scene.words, scene.ints, scratch.descent
    placed, stack, counters = descent.placed, descent.stack, descent.counters
    bounds, which, nodes, lanes, stamp = front.bounds, front.which, placed.nodes, placed.lanes, placed.stamp
    listed, listed8, keep = front.keep, front.keep8, descent.keep
    firsts, front_first, points = avatar.first, avatar.front_first, avatar.points
    shift, frame, step, stop = placed.shift, placed.frame, scene.step, scene.stop
    off_x, off_y, off_z = location.x, location.y, location.z
    x, y, z, radius = nodes[0, 0] - off_x, nodes[1, 0] - off_y, nodes[2, 0] - off_z, nodes[3, 0]
    by_size, c, threshold = mask > U(0), U(0), cut[0]
    stack[0, 0], stack[0, 1], stack[0, 2] = location.rows, 0, count
    depth = 1
    while depth > 0 and not stopped(stop):
        depth -= 1
        row, at, count = stack[U(depth), 0], stack[U(depth), 1], stack[U(depth), 2]
        first = np.int64(ints[U(row + FIRST)])
        if by_size:
            c = node_class(ints, row, mask)
        if by_size or not first_hit:
            threshold = cut[c]
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
                    if not first_hit:
                        threshold = cut[c]  # pairs found have lowered it
                    if a_first < 0:
                        block = ~a_first
                        if stamp[U(block)] != pose:
                            place_lanes(points, m, block, lanes, shift, frame, step)
                            stamp[U(block)] = pose
                        counters[0] += 1
                        if tolerant and first >= 0:
                            u = U(i)
                            x_a, y_a, z_a = bounds[0, u], bounds[1, u], bounds[2, u]
                            found = on_flat(scene, location, row, x_a, y_a, z_a, block, threshold, scratch)
                            if found == SKIP:
                                continue
                            if found != GO_ON:
                                return found, 0
                        if not lanes_meet(words, row, lanes, block, off_x, off_y, off_z, threshold, keep):
                            continue
                        if first < 0:
                            found = on_leaves(avatar, m, a, scene, voxel, location, row, scratch)
                            if found != GO_ON:
                                return found, 0
                            if stopped(stop):  # the blocks of a whole front may take milliseconds
                                return GO_ON, depth + 1
                            continue
                    elif first < 0:
                        found = on_below(avatar, m, extent, pose, scene, voxel, location, a, row, scratch)
                        if found != GO_ON:
                            return found, 0
                        if stopped(stop):
                            return GO_ON, depth + 1
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
                threshold = cut[node_class(ints, child, mask)]
            if nodes_meet(words, child, x, y, z, radius, threshold):
                if first_hit:
                    power = power_distance(words, child, x, y, z)
                    if power < least:
                        nearest, least = depth, power
                depth += 1
            child += ROW_WORDS
        if first_hit and least < np.float32(np.inf):
            top, best = U(depth - 1), U(nearest)
            stack[top, 0], stack[best, 0] = stack[best, 0], stack[top, 0]
    return GO_ON, depth
