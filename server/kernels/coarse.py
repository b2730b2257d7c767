"""The coarse top of a voxel's hierarchy: which nodes it is, and which pairs of pose and voxel it proves clear.

A slot holds nodes that together enclose all points of one voxel, laid out as the arena's rows are (layout.py), with
nothing below them. What they prove is what a descent would have found: the bounds, the float32 tests, their slack and
the rooms by radius class are those of overlap.py, so a pair that is settled here is clear by the definition.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...schemas.kernels import compiling as nb
from .compiled import borrowing
from .front import MAX_FRONT, place_front, sift
from .layout import COUNT, COUNTED, FIRST, LANES, ROW_WORDS, node_class
from .overlap import lanes_meet, make_spot, nodes_meet
from .placed import make_by_class, make_placed, place_block, place_root, set_by_class
from .stopping import stopped

# Nodes of a slot, 48 bytes each. Of the pairs of pose and voxel that are clear on the walk through a made town of 10^7
# points (voxels of 8 m, 282 KB decoded in the mean) 32 nodes settle 14 %, 64 35 %, 96 45 %, 128 52 %, 192 59 %; on the
# walk through the façade in voxels of 4 m (63 KB) 32 settle 67 %, 64 77, 96 82, 128 83; in voxels of 8 m 128 do 59 %,
# and 20 % where the avatar's points are not held against the bounds. To open the thickest node, or that of the most
# volume, instead of that of the largest radius gives or takes a tenth.
MOST_NODES = 128
SLOT_WORDS = MOST_NODES * ROW_WORDS


class CoarseArrays(NamedTuple):
    """The coarse tops of a scene's v voxels, s slots.

    words, ints: (s * SLOT_WORDS,) float32 and int32, two views of one buffer: MOST_NODES rows a slot, layout.py; only
    the radius class is left of COUNT, and FIRST is -1.  slot: (v,) int32, which slot a voxel has, -1: none.
    count: (s,) int32, rows in a slot.
    Who finds a slot in `slot` may read it without a lock: it was written before, and never is again.
    """

    words: NDArray[np.float32]
    ints: NDArray[np.int32]
    slot: NDArray[np.int32]
    count: NDArray[np.int32]  # type: ignore[assignment]  # hides tuple.count, which nobody calls


@nb.njit(nogil=True, cache=True)
def take_top(words, ints, root, assumed, out, number):
    """Write the coarse top of a voxel that `lay_out` wrote into slot `number` of `out`, the ints of CoarseArrays.

    words, ints: of the arena.  root: the voxel's first row.  assumed: radius class, shifted as in COUNT, of rows that
    have none yet; 0: as they are.
    From the root on, the node of the largest radius is replaced by its children, as long as they all find room; the
    first of equals. So where there are MOST_NODES leaf nodes or fewer, it is these. Returns how many rows.
    """
    taken, radius = np.empty(MOST_NODES, np.int64), np.empty(MOST_NODES, np.float32)
    taken[0], radius[0] = root, words[root + 3]
    count = 1
    while True:
        widest = 0
        for i in range(1, count):
            if radius[i] > radius[widest]:
                widest = i
        if radius[widest] < 0:  # none is left to be opened
            break
        row = taken[widest]
        first, children = int(ints[row + FIRST]), int(ints[row + COUNT] & COUNTED)
        if first < 0 or count + children - 1 > MOST_NODES:
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
def any_to_settle(where, slot, rows, count):
    """Whether one of the first `count` of the voxel rows is not resident and has a slot."""
    for row in rows[:count]:  # noqa: SIM110  `any` of a generator is not compiled
        if where[row, 0] < 0 and slot[row] >= 0:
            return True
    return False


@nb.njit(nogil=True, cache=True)
def settle_pairs(poses, avatar, scene, coarse, reach, starts, rows):
    """Copy starts and rows of `reach` without the pairs of pose and voxel that coarse tops prove clear.

    poses: (k, 4, 4), checked.  avatar: not empty.  reach: Reach of these poses (reach.py). Writes starts (k + 1,)
    and rows, as long as those in `reach`, in the same order. Left out is a voxel that is not resident, has a slot, and
    has no node in it whose bound comes within reach. Returns how many were left out.
    """
    placed, by_class = make_placed(avatar), make_by_class(scene.drop)
    bounds = np.empty((4, MAX_FRONT), np.float32)
    met, keep = np.zeros(MAX_FRONT, np.bool_), np.zeros(LANES, np.bool_)
    return _settle_pairs(
        poses, avatar, scene, coarse, reach, starts, rows, placed, by_class, bounds, met, keep
    )


@borrowing
def _settle_pairs(poses, avatar, scene, coarse, reach, starts, rows, placed, by_class, bounds, met, keep):
    """`settle_pairs`, with its scratch."""
    left = 0
    for i in range(poses.shape[0]):
        m, scale = poses[i], reach.scales[i]
        starts[i] = left
        front = 0  # how long it is; not placed, as most poses never need it
        for at in range(reach.starts[i], reach.starts[i + 1]):
            voxel = reach.rows[at]
            number = np.int64(coarse.slot[voxel])
            if number >= 0 and scene.where[voxel, 0] < 0 and not stopped(scene.stop):
                if front == 0:
                    extent, farthest = place_root(avatar, m, scale, placed, scene)
                    set_by_class(
                        by_class,
                        scene.drop,
                        reach.units[i],
                        scene.units_per_step,
                        extent,
                        farthest,
                        scene.voxel_steps,
                    )
                    front = place_front(avatar, m, scale, placed, scene, extent, bounds)
                if _apart(
                    avatar, m, i, scene, coarse, voxel, number, placed, by_class, bounds, front, met, keep
                ):
                    continue
            rows[left] = voxel
            left += 1
    starts[poses.shape[0]] = left
    return reach.starts[poses.shape[0]] - left


@borrowing
def _apart(avatar, m, pose, scene, coarse, voxel, number, placed, by_class, bounds, front, met, keep):
    """Whether no point of the avatar comes within reach of any node of slot `number`, which is of `voxel`.

    placed, by_class, bounds: of this pose; front: how many nodes there are in `bounds`.  pose: its number, for the
    blocks' stamps.  met: (MAX_FRONT,) and keep: (LANES,) bool, scratch.
    """
    words, nodes = coarse.words, placed.nodes
    spot = make_spot(scene, voxel, placed)
    x, y, z, radius = nodes[0, 0] - spot.x, nodes[1, 0] - spot.y, nodes[2, 0] - spot.z, nodes[3, 0]
    steps = (front + LANES - 1) // LANES
    row = number * SLOT_WORDS
    for _ in range(coarse.count[number]):
        room = by_class.room[node_class(coarse.ints, row, by_class.mask)]
        if nodes_meet(words, row, x, y, z, radius, room) and sift(
            words, row, bounds, 0, steps, spot.x, spot.y, spot.z, room, met
        ):
            for i in range(front):
                if not met[i]:
                    continue
                first = np.int64(avatar.first[avatar.front_first + i])
                if first >= 0:  # of an avatar whose front is not its leaf nodes
                    return False
                block = ~first
                if placed.stamp[block] != pose:
                    place_block(avatar, m, block, placed, scene)
                    placed.stamp[block] = pose
                if lanes_meet(words, row, placed.lanes, block, spot.x, spot.y, spot.z, room, keep):
                    return False
        row += ROW_WORDS
    return True
