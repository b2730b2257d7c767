"""Scan points near a lattice point, of all resident voxels: sums for its normal, and their heights.

normal_codes.py defines normals. A voxel adds its points to sums of integers about the point, and to
heights relative to it. The result is therefore the same for any division of the points into voxels,
and voxels can be visited one after the other. Spheres prune with integers that float64 holds
exactly; integers decide each point.
"""

import numpy as np

from ....schemas.runtime import compiling as nb
from ..core.kernel_decorators import njit_no_refcount
from ..core.node_bounds import box_square, has_box
from ..core.normal_codes import add_sums
from ..core.reach import REACH_STACK, list_item
from ..core.scene_arrays import COUNT, COUNTED, FIRST, LANES, ROW_WORDS
from .hits import STACK

U = np.uint64  # see placed_avatar.py


@nb.njit(nogil=True, cache=True)
def voxels_near(held, x, y, z, square, rows):
    """List the voxels whose points may lie near a lattice point, nearest first.

    held: reference to the scene's arrays.  x, y, z: int64.  square: squared distance [steps^2].
    rows: (capacity,) int64, set to index rows.
    Returns the number of voxels. Those beyond the capacity are not written.
    """
    center, near = np.empty(3), np.empty(rows.shape[0])
    center[0], center[1], center[2] = x, y, z
    span = np.sqrt(np.float64(square)) * (1.0 + 1e-9) + 1.0
    return list_item(
        held.tree, center, center, span, 0.0, held.one.never, np.empty(REACH_STACK, np.int64), rows, near, 0
    )


@njit_no_refcount
def _add_near(scene, voxel, x, y, z, square, rows, sums, directions, heights):
    """Add a resident voxel's points near a point; see `add_near`.

    x, y, z: relative to the voxel's low corner.  rows: (STACK,) int64, scratch.
    """
    words, ints, halves = scene.words, scene.ints, scene.halves
    # Rounded up: 2^-50 exceeds what a root and a sum of integers below 2^31 lose.
    reach = np.sqrt(np.float64(square)) * (1.0 + 2.0**-50)
    base = scene.where[voxel, 0]
    rows[0], depth = base, 1
    while depth > 0:
        depth -= 1
        row = rows[depth]
        dx, dy, dz = x - words[U(row)], y - words[U(row) + U(1)], z - words[U(row) + U(2)]
        both = (reach + words[U(row) + U(3)]) * (1.0 + 2.0**-50)
        if dx * dx + dy * dy + dz * dz > both * both * (1.0 + 2.0**-50):
            continue
        if has_box(words, row) and box_square(words, row, dx, dy, dz) > reach * reach * (1.0 + 2.0**-50):
            continue
        first = np.int64(ints[row + FIRST])
        count = np.int64(ints[row + COUNT] & COUNTED)
        if first >= 0:
            for child in range(first, first + count):
                rows[depth] = base + child * ROW_WORDS
                depth += 1
            continue
        block = ~first
        block_at = scene.where[voxel, 1] + block * scene.block_words
        at_x = U(scene.where[voxel, 2] + block * 3 * LANES)
        at_y, at_z = at_x + U(LANES), at_x + U(2 * LANES)
        ox, oy, oz = ints[block_at] - x, ints[block_at + 1] - y, ints[block_at + 2] - z
        for j in range(count):
            px = ox + np.int64(halves[at_x + U(j)])
            py = oy + np.int64(halves[at_y + U(j)])
            pz = oz + np.int64(halves[at_z + U(j)])
            if px * px + py * py + pz * pz > square:
                continue
            add_sums(sums, px, py, pz)
            for k in range(directions.shape[0]):
                height = (px * directions[k, 0] + py * directions[k, 1]) + pz * directions[k, 2]
                heights[k] = max(heights[k], height)


@nb.njit(nogil=True, cache=True)
def add_near(held, voxels, x, y, z, square, sums, directions, heights):
    """Add the points near a lattice point to the sums for its normal, and raise heights to theirs.

    held: reference to the scene's arrays.  voxels: (n,) int64, index rows of resident voxels.
    x, y, z: int64.  square: squared distance [steps^2] up to which points count, as `squared_reach`
    returns it.  sums: (SUMS,) int64, as `normal_code` takes them.
    directions: (k, 3) float64, unit.  heights: (k,) float64, the greatest height over the point
    along each direction [steps].  The first call gets zeros for sums and heights.
    """
    scene, rows = held.scene, np.empty(STACK, np.int64)
    for voxel in voxels:
        corner = scene.corners[voxel]
        u, v, w = x - corner[0], y - corner[1], z - corner[2]
        _add_near(scene, voxel, u, v, w, square, rows, sums, directions, heights)
