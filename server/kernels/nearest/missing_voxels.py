"""Lower bounds of the distance from voxels that are not in memory.

The index bounds a voxel by a box. Coarse bounds, where they are stored, bound it by up to 128 nodes
(kernels/collide/coarse_clearance.py), which follow its surfaces.
"""

import math

import numpy as np

from ....schemas.kernels import compiling as nb
from ..core.kernel_decorators import njit_no_refcount
from ..core.node_overlap import make_thresholds
from ..core.placed_avatar import make_front, make_placed, place_front, place_root
from ..core.scene_arrays import ROW_WORDS, ROWS_AT_ONCE, stopped
from .nearest_pair import lower_bound

U = np.uint64  # see placed_avatar.py


@njit_no_refcount
def box_distance(root, placed, farthest, scene, index, voxel):
    """Return a lower bound of the distance of the avatar's centres from a voxel's points.

    In steps, at least 0, from the index alone.  root: radius of the avatar's root sphere, scaled
    [m].  farthest: of `place_nodes`.
    """
    square = 0.0
    for r in range(3):
        center = placed.frame[r]  # the root's centre, to half a step an axis
        gap = np.float64(max(index.low[voxel, r] - center, center - index.high[voxel, r], 0))
        square += gap * gap
    # One step for the frame's rounding; for the other terms see `make_thresholds`.
    error = 1.0 + 2.0 / scene.units_per_step + farthest * 2.0**-46
    return max(math.sqrt(square) * (1.0 - 1e-9) - root / scene.step * (1.0 + 1e-9) - error, 0.0)


@njit_no_refcount
def _coarse_gap(words, row, nodes, bounds, front, off, root):
    """Return a lower bound of the distance of the avatar's points from any of `nodes` rows [steps].

    words, row: of the slot.  bounds: (4, ...) float32, the avatar's front, `front` nodes.  off:
    (3,) float32, from the frame to the voxel's low corner.  root: (4,) float32, the avatar's root.
    The errors of placed coordinates are not included.
    """
    x, y, z = off[0], off[1], off[2]
    gap = np.float32(np.inf)
    for _ in range(nodes):
        if lower_bound(words, row, root[0] - x, root[1] - y, root[2] - z, root[3]) < gap:
            for i in range(front):
                u = U(i)
                near = lower_bound(
                    words, row, bounds[0, u] - x, bounds[1, u] - y, bounds[2, u] - z, bounds[3, u]
                )
                gap = min(gap, near)
        row += ROW_WORDS
    return gap


@nb.njit(nogil=True, cache=True)
def split_missing(poses, avatar, scene, index, coarse, reach, which, starts, rows, missing_bound, counts):
    """Separate the voxels in reach that are not resident, and bound their distance.

    poses: (k, 4, 4), checked.  avatar: not empty.  reach: VoxelsInReach of these poses.  coarse:
    CoarseArrays, perhaps without slots.  which: ascending numbers of poses.
    Writes starts (k + 1,) and rows, as long as those of `reach`: the resident voxels of the poses
    in `which`, in the same order, and none for other poses. For each pose in `which`, adds the
    number of the other voxels to counts[0] (3, k) uint32, and lowers missing_bound (k,) float64
    [steps] to their distance from the avatar's centres. Once the scene's stop flag is set, all
    voxels of the remaining poses count as missing, at distance 0.
    """
    placed, front = make_placed(avatar), make_front(avatar)
    root, off = np.empty(4, np.float32), np.empty(3, np.float32)
    slots = coarse.count.shape[0]
    slot_words = coarse.words.shape[0] // max(slots, 1)
    left, number, ended = 0, 0, False
    for i in range(poses.shape[0]):
        starts[i] = left
        if number == which.shape[0] or which[number] != i:
            continue
        number += 1
        ended = ended or stopped(scene.stop)
        if ended:
            missing_bound[i] = 0.0
            counts[0, i] += np.uint32(reach.starts[i + 1] - reach.starts[i])
            continue
        m = poses[i]
        length, error, farthest = 0, 0.0, 0.0  # the front is not placed yet
        for at in range(reach.starts[i], reach.starts[i + 1]):
            if ended or (at % ROWS_AT_ONCE == 0 and stopped(scene.stop)):
                ended = True
                missing_bound[i] = 0.0
                counts[0, i] += np.uint32(1)
                continue
            voxel = reach.rows[at]
            if scene.where[voxel, 0] >= 0:
                rows[left] = voxel
                left += 1
                continue
            if length == 0:
                extent, farthest = place_root(avatar, m, placed, scene)
                length = place_front(avatar, m, placed, scene, extent, front.bounds)
                thresholds = make_thresholds(
                    reach.units[i], scene.units_per_step, extent, farthest, scene.voxel_steps
                )
                error = np.float64(thresholds.error)
                for r in range(4):
                    root[r] = placed.nodes[r, 0]
            gap = box_distance(avatar.radius[0], placed, farthest, scene, index, voxel)
            ended = stopped(scene.stop)  # the nodes of a voxel take some microseconds
            if slots > 0 and coarse.slot[voxel] >= 0 and not ended:
                slot = np.int64(coarse.slot[voxel])
                for r in range(3):
                    low = scene.coordinates[voxel, r] * scene.voxel_steps
                    off[r] = np.float32(low - placed.frame[r])
                nodes = _coarse_gap(
                    coarse.words, slot * slot_words, coarse.count[slot], front.bounds, length, off, root
                )  # fmt: skip
                gap = max(gap, np.float64(nodes) - error)
            counts[0, i] += np.uint32(1)
            missing_bound[i] = min(missing_bound[i], gap)
    starts[poses.shape[0]] = left
