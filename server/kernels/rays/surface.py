"""Scan points near a lattice point, of all resident voxels: sums for its normal, and their heights.

normal_codes.py defines normals. A voxel adds its points to sums of integers about the point, and to
heights relative to it. The result is therefore the same for any division of the points into voxels,
and voxels can be visited one after the other. Spheres prune with integers that float64 holds
exactly; integers decide each point.
"""

import numpy as np

from ....schemas.archive.voxel_grid import KEY_BIAS
from ....schemas.kernels import compiling as nb
from ....schemas.kernels.morton import morton_code
from ..core.kernel_decorators import njit_no_refcount
from ..core.node_boxes import box_square, has_box
from ..core.normal_codes import add_sums
from ..core.scene_arrays import COUNT, COUNTED, FIRST, LANES, ROW_WORDS
from ..core.voxels_in_reach import find_key
from .rays import STACK

U = np.uint64  # see placed_avatar.py


@nb.njit(nogil=True, cache=True)
def _find_voxel(keys, ix, iy, iz):
    """Return the index row of the voxel with these coordinates; -1 if it holds no points.

    keys: (v,) uint64, sorted.
    """
    ix, iy, iz = ix + KEY_BIAS, iy + KEY_BIAS, iz + KEY_BIAS
    if min(ix, iy, iz) < 0 or max(ix, iy, iz) >= 2 * KEY_BIAS:
        return -1
    return find_key(keys, morton_code(np.uint64(ix), np.uint64(iy), np.uint64(iz)))


@nb.njit(nogil=True, cache=True)
def voxels_in_box(held, low, high, rows):
    """List the voxels whose points may lie in a box.

    held: reference to the scene's arrays.  low, high: (3,) int64, inclusive, lattice coordinates.
    rows: (capacity,) int64, set to index rows, in an order that depends on the positions alone.
    Returns the number of voxels. Those beyond the capacity are not written.
    """
    index, steps = held.index, held.scene.voxel_steps
    first, sizes = np.empty(3, np.int64), np.empty(3, np.int64)
    for r in range(3):
        first[r] = max(low[r], index.scene_low[r]) // steps
        sizes[r] = max(min(high[r], index.scene_high[r]) // steps - first[r] + 1, 0)
    voxels = index.keys.shape[0]
    cells = np.float64(sizes[0]) * np.float64(sizes[1]) * np.float64(sizes[2])
    listed = cells > voxels  # cheaper to test every voxel than every cell of the grid
    needed = 0
    for n in range(voxels if listed else np.int64(cells)):
        row = n
        if not listed:
            line = n // sizes[2]
            x, y, z = line // sizes[1], line % sizes[1], n % sizes[2]
            row = _find_voxel(index.keys, first[0] + x, first[1] + y, first[2] + z)
            if row < 0:
                continue
        meets = True
        for r in range(3):
            meets &= index.low[row, r] <= high[r] and index.high[row, r] >= low[r]
        if meets:
            if needed < rows.shape[0]:
                rows[needed] = row
            needed += 1
    return needed


@nb.njit(nogil=True, cache=True)
def voxels_near(held, x, y, z, square, rows):
    """List the voxels whose points may lie near a lattice point, as `voxels_in_box` does.

    x, y, z: int64.  square: squared distance [steps^2].
    """
    reach = np.int64(np.sqrt(np.float64(square))) + 1
    low, high = np.empty(3, np.int64), np.empty(3, np.int64)
    low[0], low[1], low[2] = x - reach, y - reach, z - reach
    high[0], high[1], high[2] = x + reach, y + reach, z + reach
    return voxels_in_box(held, low, high, rows)


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
    scene, rows, steps = held.scene, np.empty(STACK, np.int64), held.scene.voxel_steps
    for voxel in voxels:
        u, v, w = (
            x - scene.coordinates[voxel, 0] * steps,
            y - scene.coordinates[voxel, 1] * steps,
            z - scene.coordinates[voxel, 2] * steps,
        )
        _add_near(scene, voxel, u, v, w, square, rows, sums, directions, heights)
