"""Front of the avatar: one level of its tree as a flat list, tested against a scene node.

A descent of two trees tests one pair of nodes at a time and branches after each test. Here only the
scene's tree is descended. Each of its nodes is tested against the list of those front nodes that
met its parent: 32 in a vector step, in the time of one or two single tests. For the figure of
3,617 points the front is its 114 leaf nodes.

Indices are np.uint64 wherever vectorisation matters. LLVM assumes that a signed index may be
negative; it then computes an address for each lane and loads each lane separately (six times
slower, scripts/bench_engine's `collide`).
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ....schemas.archive.voxel import MAX_LEVELS
from ....schemas.kernels import compiling as nb
from .kernel_decorators import njit_inlined, njit_no_refcount
from .placed_avatar import ONE_SLACK, SLACK, node_reach
from .voxel_layout import LANES

U = np.uint64
# The front of a larger avatar consists of inner nodes. 256 are eight vector steps.
MAX_FRONT = 256
# One list is written for each level of the descent; none is longer than the list above it.
LIST_CAPACITY = MAX_FRONT * (MAX_LEVELS + 2)
# Coordinate that pads a list to whole vector steps: so far away that, with radius 0, no test keeps
# it.
FAR_AWAY = np.float32(1e30)


class AvatarFront(NamedTuple):
    """Lists of placed front nodes, one after another; scratch of one call.

    bounds: (4, LIST_CAPACITY) float32: x[], y[], z[] from the frame, radius[] [steps], rounded
    outward.
    which: (LIST_CAPACITY,) int32, numbers in the front.
    keep: (MAX_FRONT,) bool, marks; keep8: the same memory as uint64, eight marks each.
    """

    bounds: NDArray[np.float32]
    which: NDArray[np.int32]
    keep: NDArray[np.bool_]
    keep8: NDArray[np.uint64]


@nb.njit(nogil=True, cache=True)
def make_front(avatar):
    """Allocate scratch for one avatar (not empty); nothing is placed yet."""
    which = np.empty(LIST_CAPACITY, np.int32)
    for i in range(avatar.front.shape[1]):
        which[i] = i
    keep = np.zeros(MAX_FRONT, np.bool_)
    return AvatarFront(np.empty((4, LIST_CAPACITY), np.float32), which, keep, keep.view(np.uint64))


@njit_no_refcount
def pad_list(bounds, begin, end):
    """Fill entries [begin, end) of the lists with nodes that no test keeps."""
    for i in range(begin, end):
        bounds[0, U(i)] = FAR_AWAY
        bounds[1, U(i)] = np.float32(0.0)
        bounds[2, U(i)] = np.float32(0.0)
        bounds[3, U(i)] = np.float32(0.0)


@njit_no_refcount
def place_front(avatar, m, scale, placed, scene, extent, bounds):
    """Place the front, after `place_root`, as the first list of `bounds`. Returns its length."""
    step = scene.step
    per_step = 1.0 / step
    front = avatar.front
    n = front.shape[1]
    for r in range(3):
        base = np.float64(placed.frame[r]) * step
        m0, m1, m2, shift = m[r, 0], m[r, 1], m[r, 2], placed.shift[r]
        for i in range(n):
            # The formula of placing.place.
            world = ((m0 * front[0, i] + m1 * front[1, i]) + m2 * front[2, i]) + shift
            bounds[r, i] = np.float32((world - base) * per_step)
    for i in range(n):
        bounds[3, i] = node_reach(front[3, i], scale * per_step, extent)
    pad_list(bounds, n, (n + LANES - 1) // LANES * LANES)
    return n


@njit_inlined
def mark_meeting(words, row, bounds, at, steps, off_x, off_y, off_z, threshold, keep):
    """Mark in `keep` the nodes of a list that meet the scene node `row`.

    The test is that of `nodes_meet`: the sphere, then the slab.
    at: the start of the list.  steps: its length in units of LANES nodes.  off: from the frame to
    the voxel's low corner.  threshold: reach plus error. Returns whether any node meets.
    """
    w = U(row)
    cx, cy, cz = words[w] + off_x, words[w + U(1)] + off_y, words[w + U(2)] + off_z
    radius = words[w + U(3)]
    nx, ny, nz, length = words[w + U(4)], words[w + U(5)], words[w + U(6)], words[w + U(7)]
    low, high = words[w + U(8)], words[w + U(9)]
    any_meets = False
    begin, to = U(at), U(0)
    for _ in range(steps):
        for j in range(LANES):
            i = begin + U(j)
            dx, dy, dz = bounds[0, i] - cx, bounds[1, i] - cy, bounds[2, i] - cz
            span = bounds[3, i] + threshold
            both = radius + span
            along = nx * dx + ny * dy + nz * dz
            wide = length * (span + (SLACK * both + SLACK * both))
            meets = (
                (dx * dx + dy * dy + dz * dz <= both * both * ONE_SLACK)
                & (along <= high + wide)
                & (along >= low - wide)
            )
            keep[to + U(j)] = meets
            any_meets |= meets
        begin += U(LANES)
        to += U(LANES)
    return any_meets


@njit_inlined
def compact_marked(bounds, which, keep, keep8, at, steps, to):
    """Write the marked nodes of the list at `at` as a new list at `to`. Returns its length."""
    n = U(to)
    for eight in range(4 * steps):
        if keep8[U(eight)] == U(0):
            continue
        for j in range(8 * eight, 8 * eight + 8):
            if keep[U(j)]:
                copy_node(bounds, which, U(at) + U(j), n)
                n += U(1)
    count = np.int64(n) - to
    pad_list(bounds, to + count, to + (count + LANES - 1) // LANES * LANES)
    return count


@njit_no_refcount
def copy_node(bounds, which, at, to):
    """Copy one node of the lists; at, to: uint64."""
    bounds[0, to] = bounds[0, at]
    bounds[1, to] = bounds[1, at]
    bounds[2, to] = bounds[2, at]
    bounds[3, to] = bounds[3, at]
    which[to] = which[at]
