"""Sweep of one motion for a request, in one call, where all voxels in its reach are resident."""

import numpy as np

from ....schemas.runtime import compiling as nb
from ..core.scene_arrays import SceneArrays
from .sweep_resident import sweep_resident
from .sweep_segments import find_unknown_regions


@nb.njit(nogil=True, cache=True)
def sweep_one(
    pose_from, pose_to, body, scratch, other_units, held, stop, unknown_everywhere, tolerance, result, outside
):
    """Return as `sweep_resident`, and write outside (1,) bool, whether the reach leaves the scene's bounds."""
    found = sweep_resident(
        pose_from,
        pose_to,
        body,
        scratch,
        other_units,
        held,
        stop,
        unknown_everywhere,
        tolerance,
        -1.0,
        result,
    )
    if found[0] >= 0:
        scene, one = held.scene, scratch.one
        from_zero = SceneArrays(
            scene.words, scene.ints, scene.halves, scene.where, scene.corners, one.origin, scene.step,
            scene.units_per_step, scene.voxel_steps, scene.block_words, scene.radius_deficit, stop,
        )  # fmt: skip
        until = np.full(1, min(result.upper, 1.0))
        find_unknown_regions(
            body.box,
            one.first,
            one.last,
            body.avatar,
            one.units,
            from_zero,
            held.tree,
            until,
            outside,
            np.empty(1),
        )
    return found
