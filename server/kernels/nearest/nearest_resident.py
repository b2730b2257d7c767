"""Resident path of `distance`: one pose in one kernel call (`resident_fast_path.py`).

It applies where the resident voxels suffice: all in the pose's reach, or all that can hold a pair
nearer than the one found. The kernel also converts the nearest
pair to metres, with the formulas of `queries/distance.py` in the same order of operations; the bits
are therefore the same. As numpy operations on columns of one element, this took four times as long
as the search.
"""

import math

import numpy as np

from ....schemas.archive.units import UNITS_PER_METRE
from ....schemas.kernels import compiling as nb
from ..core.array_references import with_flag
from ..core.kernel_decorators import njit_no_refcount
from ..core.placed_avatar import lattice_to_units
from ..core.reach import resident_front
from ..core.scene_arrays import stopped
from ..core.voxels_in_reach import VALID, find_reach
from .nearest_pair import NearestPairs
from .nearest_search import nearest_poses, nothing_nearer

# Columns of the output.
SIGNED, LOWER, NORMAL, AVATAR, CLOUD, COLUMNS = 0, 1, 2, 5, 8, 11


@njit_no_refcount
def _write_result(square, pair, deficit, radii, reach, scene, result):
    """Write the results for one pair, or for no pair (square -1); see `nearest_resident`."""
    if square < 0:
        result[SIGNED], result[LOWER] = np.inf, reach
        for at in range(NORMAL, COLUMNS):
            result[at] = np.nan
        return
    own = radii - deficit
    above = np.float64(square - own * own)
    root = math.sqrt(np.float64(square))
    both = root + np.float64(own)
    signed = above / both / UNITS_PER_METRE if both > 0.0 else 0.0
    result[SIGNED], result[LOWER] = signed, min(signed, reach)
    for r in range(3):
        apart = np.float64(pair[3 + r] - lattice_to_units(pair[r], scene.units_per_step))
        result[NORMAL + r] = apart / root if root > 0.0 else 0.0
        result[AVATAR + r] = np.float64(pair[3 + r]) / UNITS_PER_METRE + scene.origin[r]
        result[CLOUD + r] = np.float64(pair[r]) * scene.step + scene.origin[r]


@nb.njit(nogil=True, cache=True)
def nearest_resident(pose, body, radius, radius_units, reach_units, reach, held, stop, result):
    """Answer `distance` for one pose: `find_reach`, `nearest_poses`, then the values of the pair.

    pose: (1, 4, 4) float64, unchecked.  body, held: references to the arrays of the avatar and the
    scene (array_references.py).  stop: (1,) int64, the request's stop flag.  radius: of the avatar's
    points [m].  radius_units: radius of the scan's largest sphere, exact units.  reach_units: the
    reach, exact units.  reach: the same [m].
    Writes held.one, the voxels in reach, and result (COLUMNS,) float64: signed distance and its lower
    bound [m], normal, witness of the avatar, witness of the cloud, world [m]; inf and NaN where no
    pair is within reach.
    Returns (fault, value found), as `check_poses` does, then the number of voxels examined, node visits,
    point tests. -1 voxels: not answered, because a voxel has to be loaded, the rows do not fit, or the
    request was stopped.
    """
    avatar, scene, around = body.avatar, with_flag(held.scene, stop), held.one.reach
    fault, _, found, needed = find_reach(
        pose, avatar, radius, radius_units + reach_units, scene, held.tree, around
    )
    lists = around.lists
    front = resident_front(scene.where, lists.rows, needed)
    if fault != VALID or front < 0:
        return fault, found, -1, 0, 0
    nearest = NearestPairs(
        np.full(1, -1, np.int64), np.zeros((1, 6), np.int64), np.zeros(1, np.int64), np.full(1, np.inf)
    )
    counts, cursor = np.zeros((3, 1), np.uint32), held.one.cursor
    cursor[0], lists.starts[1] = 0, front
    if needed > 0:
        nearest_poses(
            pose, avatar, scene, around, held.one.which, cursor, held.one.all_held, reach_units, 0.0, 0.0,
            nearest, counts,
        )  # fmt: skip
        if stopped(stop) or (front < needed and not nothing_nearer(nearest, 0, lists.near[front], scene)):
            return fault, found, -1, 0, 0
    _write_result(
        nearest.square[0],
        nearest.pair[0],
        nearest.deficit[0],
        around.units[0] - reach_units,
        reach,
        scene,
        result,
    )
    return fault, found, front, np.int64(counts[1, 0]), np.int64(counts[2, 0])
