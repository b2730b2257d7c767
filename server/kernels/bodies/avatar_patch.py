"""Patch of an avatar's surface around a touched point: how far it extends along directions.

Distances are float64 sums of products in a fixed order, so that every machine finds the same
heights. The sums for the normal are integers.
"""

import numpy as np

from ....schemas.archive.voxel import MAX_LEVELS
from ....schemas.runtime import compiling as nb
from ..core.kernel_decorators import njit_no_refcount
from ..core.normal_codes import add_sums

# Steps per metre of the differences that are summed for a normal: with a reach of a metre, the sums
# over eight million points fit 63 bits.
PATCH_STEPS = 1 << 20
# Nodes still to examine: an avatar's tree has at most eight children a node.
_STACK = 8 * MAX_LEVELS
# A node farther than the reach by this share has no point in reach, whatever was rounded.
_ROUNDED = 1.0 + 1e-9


@njit_no_refcount
def add_difference(x, y, z, sums):
    """Add a point's difference to another one [m] to the sums for `normal_code`."""
    add_sums(
        sums,
        np.int64(np.rint(x * PATCH_STEPS)),
        np.int64(np.rint(y * PATCH_STEPS)),
        np.int64(np.rint(z * PATCH_STEPS)),
    )


@nb.njit(nogil=True, cache=True)
def lowest_heights(body, point, reach, directions, heights, sums):
    """Find how low the points of an avatar's surface near one of them lie along directions.

    body: reference to the avatar's arrays.
    point: (3,) a place on the surface, avatar frame [m].  reach: inclusive [m].
    directions: (k, 3) unit, avatar frame.  heights: (k,), set to the least height over the points
    within reach, relative to `point` [m]; 0 if there are none.
    sums: (SUMS,) int64, set to the sums for `normal_code` (kernels/core/normal_codes.py), in
    1 / PATCH_STEPS of a metre.
    """
    avatar = body.avatar
    x, y, z = point[0], point[1], point[2]
    square = reach * reach
    rows = np.empty(_STACK, np.int64)
    heights[:] = 0.0
    sums[:] = 0
    rows[0], depth = 0, 1
    while depth > 0:
        depth -= 1
        row = rows[depth]
        dx, dy, dz = avatar.center[row, 0] - x, avatar.center[row, 1] - y, avatar.center[row, 2] - z
        both = (reach + avatar.radius[row]) * _ROUNDED
        if dx * dx + dy * dy + dz * dz > both * both:
            continue
        first, count = np.int64(avatar.first[row]), np.int64(avatar.count[row])
        if first >= 0:
            for child in range(first, first + count):
                rows[depth] = child
                depth += 1
            continue
        for j in range(count):
            px = avatar.points[~first, 0, j] - x
            py = avatar.points[~first, 1, j] - y
            pz = avatar.points[~first, 2, j] - z
            if px * px + py * py + pz * pz > square or body.rows[~first, j] >= body.surface:
                continue
            for k in range(directions.shape[0]):
                height = (px * directions[k, 0] + py * directions[k, 1]) + pz * directions[k, 2]
                heights[k] = min(heights[k], height)
            add_difference(px, py, pz, sums)
