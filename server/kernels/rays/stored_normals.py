"""Normal at a scan point of a resident voxel, and heights of its neighbours, from the voxel's tree.

schemas/kernels/normal_codes.py has the definition. Spheres prune with integers that float64 holds
exactly; integers decide each point.
"""

import numpy as np

from ....schemas.archive.voxel_grid import KEY_BIAS
from ....schemas.kernels import compiling as nb
from ....schemas.kernels.morton import morton_code
from ....schemas.kernels.normal_codes import NO_NORMAL, normal_code
from ..core.kernel_decorators import njit_no_refcount
from ..core.node_boxes import box_square, has_box
from ..core.scene_arrays import COUNT, COUNTED, FIRST, LANES, ROW_WORDS, normal_run
from ..core.voxels_in_reach import find_key
from .rays import STACK

U = np.uint64  # see placed_avatar.py

# A code that no normal has: both bytes of a normal's code are at least 1.
NOT_ESTIMATED = np.uint16(1)
SUMS = 10


@nb.njit(nogil=True, cache=True)
def find_voxel(keys, voxel_steps, x, y, z):
    """Return the index row of the voxel that contains a lattice point; -1 where it holds no points.

    keys: (v,) uint64, sorted.
    """
    ix, iy, iz = x // voxel_steps + KEY_BIAS, y // voxel_steps + KEY_BIAS, z // voxel_steps + KEY_BIAS
    if min(ix, iy, iz) < 0 or max(ix, iy, iz) >= 2 * KEY_BIAS:
        return -1
    return find_key(keys, morton_code(np.uint64(ix), np.uint64(iy), np.uint64(iz)))


@njit_no_refcount
def _find_point(scene, voxel, x, y, z, rows):
    """Return the lane of a point in a resident voxel, or -1, and the nodes visited.

    Lanes are numbered LANES a block.  x, y, z: int64, relative to the voxel's low corner.  rows:
    (STACK,) int64, scratch. Where points coincide, any of them is returned.
    """
    words, ints, halves = scene.words, scene.ints, scene.halves
    base, visits = scene.where[voxel, 0], 0
    rows[0], depth = base, 1
    while depth > 0:
        depth -= 1
        row = rows[depth]
        visits += 1
        dx, dy, dz = x - words[U(row)], y - words[U(row) + U(1)], z - words[U(row) + U(2)]
        radius = np.float64(words[U(row) + U(3)])
        if dx * dx + dy * dy + dz * dz > radius * radius:
            continue
        if has_box(words, row) and box_square(words, row, dx, dy, dz) > 0.0:
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
        lane_at = scene.where[voxel, 2] + block * 3 * LANES
        at_x = U(lane_at)
        at_y, at_z = at_x + U(LANES), at_x + U(2 * LANES)
        ox, oy, oz = x - ints[block_at], y - ints[block_at + 1], z - ints[block_at + 2]
        for j in range(count):
            if (
                ox == np.int64(halves[at_x + U(j)])
                and oy == np.int64(halves[at_y + U(j)])
                and oz == np.int64(halves[at_z + U(j)])
            ):
                return block * LANES + j, visits
    return np.int64(-1), visits


@njit_no_refcount
def _add_near(scene, voxel, x, y, z, square, rows, sums):
    """Accumulate the sums for `normal_code` over a resident voxel's points near a point.

    square: squared distance [steps^2] up to which points count.  Other arguments as for
    `_find_point`.  sums: (SUMS,) int64, zeros. Returns the nodes visited.
    """
    words, ints, halves = scene.words, scene.ints, scene.halves
    # Rounded up: 2^-50 exceeds what a root and a sum of integers below 2^31 lose.
    reach = np.sqrt(np.float64(square)) * (1.0 + 2.0**-50)
    base, visits = scene.where[voxel, 0], 0
    rows[0], depth = base, 1
    while depth > 0:
        depth -= 1
        row = rows[depth]
        visits += 1
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
        lane_at = scene.where[voxel, 2] + block * 3 * LANES
        at_x = U(lane_at)
        at_y, at_z = at_x + U(LANES), at_x + U(2 * LANES)
        ox, oy, oz = ints[block_at] - x, ints[block_at + 1] - y, ints[block_at + 2] - z
        for j in range(count):
            px = ox + np.int64(halves[at_x + U(j)])
            py = oy + np.int64(halves[at_y + U(j)])
            pz = oz + np.int64(halves[at_z + U(j)])
            if px * px + py * py + pz * pz > square:
                continue
            sums[0] += 1
            sums[1] += px
            sums[2] += py
            sums[3] += pz
            sums[4] += px * px
            sums[5] += py * py
            sums[6] += pz * pz
            sums[7] += py * pz
            sums[8] += pz * px
            sums[9] += px * py
    return visits


@nb.njit(nogil=True, cache=True)
def code_at(held, voxel, x, y, z, square, codes):
    """Return the code of the normal at a lattice point, from `codes` or estimated.

    held: reference to the scene's arrays.  x, y, z: int64.  square: of the reach [steps^2], as `squared_reach` returns
    it (schemas/archive/normal_reach.py).  codes: (blocks * LANES,) uint16, NOT_ESTIMATED where not
    estimated yet; an estimate is stored there. With length 0, nothing is stored.
    Returns (code, nodes visited, whether it was estimated). The code is NO_NORMAL where the voxel
    has no point there, or is not resident.
    """
    scene = held.scene
    if scene.where[voxel, 0] < 0:
        return NO_NORMAL, 0, False
    rows, sums = np.empty(STACK, np.int64), np.zeros(SUMS, np.int64)
    x -= scene.coordinates[voxel, 0] * scene.voxel_steps
    y -= scene.coordinates[voxel, 1] * scene.voxel_steps
    z -= scene.coordinates[voxel, 2] * scene.voxel_steps
    lane, visits = _find_point(scene, voxel, x, y, z, rows)
    if lane < 0:
        return NO_NORMAL, visits, False
    if codes.shape[0] > 0 and codes[lane] != NOT_ESTIMATED:
        return codes[lane], visits, False
    visits += _add_near(scene, voxel, x, y, z, square, rows, sums)
    code = normal_code(sums)
    if codes.shape[0] > 0:
        codes[lane] = code
    return code, visits, True


@nb.njit(nogil=True, cache=True)
def stored_code_at(held, voxel, x, y, z, with_scan):
    """Return (code, nodes visited) of an archive whose normals are in memory; see `code_at`.

    with_scan: whether scan numbers are in memory.
    """
    scene = held.scene
    if scene.where[voxel, 0] < 0:
        return NO_NORMAL, 0
    rows = np.empty(STACK, np.int64)
    x -= scene.coordinates[voxel, 0] * scene.voxel_steps
    y -= scene.coordinates[voxel, 1] * scene.voxel_steps
    z -= scene.coordinates[voxel, 2] * scene.voxel_steps
    lane, visits = _find_point(scene, voxel, x, y, z, rows)
    if lane < 0:
        return NO_NORMAL, visits
    return scene.halves[normal_run(scene.where, voxel, scene.block_words, with_scan) + lane], visits


@nb.njit(nogil=True, cache=True)
def highest_near(held, voxel, x, y, z, square, directions, heights):
    """Find how high a resident voxel's points near a lattice point lie along directions.

    held, x, y, z, square: as for `code_at`.  directions: (k, 3) unit, float64.  heights: (k,),
    set to the greatest height over the points within reach, relative to the point [steps]; 0 if
    there are none. Returns the nodes visited.
    """
    scene = held.scene
    heights[:] = 0.0
    if scene.where[voxel, 0] < 0:
        return 0
    words, ints, halves = scene.words, scene.ints, scene.halves
    x -= scene.coordinates[voxel, 0] * scene.voxel_steps
    y -= scene.coordinates[voxel, 1] * scene.voxel_steps
    z -= scene.coordinates[voxel, 2] * scene.voxel_steps
    reach = np.sqrt(np.float64(square)) * (1.0 + 2.0**-50)
    rows = np.empty(STACK, np.int64)
    base, visits = scene.where[voxel, 0], 0
    rows[0], depth = base, 1
    while depth > 0:
        depth -= 1
        row = rows[depth]
        visits += 1
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
        lane_at = scene.where[voxel, 2] + block * 3 * LANES
        at_x = U(lane_at)
        at_y, at_z = at_x + U(LANES), at_x + U(2 * LANES)
        ox, oy, oz = ints[block_at] - x, ints[block_at + 1] - y, ints[block_at + 2] - z
        for j in range(count):
            px = ox + np.int64(halves[at_x + U(j)])
            py = oy + np.int64(halves[at_y + U(j)])
            pz = oz + np.int64(halves[at_z + U(j)])
            if px * px + py * py + pz * pz > square:
                continue
            for k in range(directions.shape[0]):
                height = (px * directions[k, 0] + py * directions[k, 1]) + pz * directions[k, 2]
                heights[k] = max(heights[k], height)
    return visits
