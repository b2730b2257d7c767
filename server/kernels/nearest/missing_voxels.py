"""Lower bounds of the distance from voxels that are not in memory, by their boxes in the index."""

import math

import numpy as np

from ....schemas.kernels import compiling as nb
from ..core.kernel_decorators import njit_no_refcount
from ..core.placed_avatar import make_placed, place_root
from ..core.scene_arrays import ROWS_AT_ONCE, stopped


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


@nb.njit(nogil=True, cache=True)
def split_missing(poses, avatar, scene, index, reach, which, starts, rows, missing_bound, counts):
    """Separate the voxels in reach that are not resident, and bound their distance.

    poses: (k, 4, 4), checked.  avatar: not empty.  reach: VoxelsInReach of these poses.
    which: ascending numbers of poses.
    Writes starts (k + 1,) and rows, as long as those of `reach`: the resident voxels of the poses
    in `which`, in the same order, and none for other poses. For each pose in `which`, adds the
    number of the other voxels to counts[0] (3, k) uint32, and lowers missing_bound (k,) float64
    [steps] to their distance from the avatar's centres. Once the scene's stop flag is set, all
    voxels of the remaining poses count as missing, at distance 0.
    """
    placed = make_placed(avatar)
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
        m, scale = poses[i], reach.scales[i]
        farthest, is_placed = 0.0, False
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
            if not is_placed:
                _, farthest = place_root(avatar, m, scale, placed, scene)
                is_placed = True
            gap = box_distance(avatar.radius[0] * scale, placed, farthest, scene, index, voxel)
            counts[0, i] += np.uint32(1)
            missing_bound[i] = min(missing_bound[i], gap)
    starts[poses.shape[0]] = left
