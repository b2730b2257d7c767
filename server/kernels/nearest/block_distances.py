"""Distances between the points of two leaf nodes, all LANES of a block in one vector step; float32.

nearest_pair.py uses these functions. Avatar points are placed: their coordinates are relative to
the frame or to the block's low corner. Scene points are whole steps from the low corner of their
block.
"""

import numpy as np

from ..core.kernel_decorators import njit_inlined, njit_no_refcount
from ..core.scene_arrays import LANES

U = np.uint64  # see placed_avatar.py


@njit_no_refcount
def write_squares(halves, lane_at, x, y, z, squares):
    """Write the squared distances (LANES,) of a scene block's points to a point.

    x, y, z, and the block's points: relative to the block's low corner.
    """
    # Unsigned: numba does not vectorise an index that may be negative (70 ns instead of 5 for 32
    # lanes).
    at_x = U(lane_at)
    at_y, at_z = at_x + U(LANES), at_x + U(2 * LANES)
    for lane in range(LANES):
        j = U(lane)
        dx, dy = np.float32(halves[at_x + j]) - x, np.float32(halves[at_y + j]) - y
        dz = np.float32(halves[at_z + j]) - z
        squares[j] = dx * dx + dy * dy + dz * dz


@njit_inlined
def unmark_beyond_box(halves, lane_at, low_x, low_y, low_z, lanes, block, far, keep):
    """Unmark the points of an avatar's block that are beyond `far` from a scene block's box.

    far: a squared distance. Other arguments as for `nearest_squares`.
    No slack is added for rounding: rounding is monotonic, therefore each difference computed here
    is no larger than those of the points.
    """
    h, b = U(lane_at), U(block)
    high_x, high_y, high_z = np.int32(0), np.int32(0), np.int32(0)
    for j in range(LANES):
        i = h + U(j)
        high_x = max(high_x, np.int32(halves[i]))
        high_y = max(high_y, np.int32(halves[i + U(LANES)]))
        high_z = max(high_z, np.int32(halves[i + U(2 * LANES)]))
    most_x, most_y, most_z = np.float32(high_x), np.float32(high_y), np.float32(high_z)
    zero = np.float32(0.0)
    for lane in range(LANES):
        u = U(lane)
        x, y, z = lanes[b, 0, u] - low_x, lanes[b, 1, u] - low_y, lanes[b, 2, u] - low_z
        dx, dy, dz = max(x - most_x, -x), max(y - most_y, -y), max(z - most_z, -z)
        dx, dy, dz = max(dx, zero), max(dy, zero), max(dz, zero)
        keep[u] = keep[u] & (dx * dx + dy * dy + dz * dz <= far)


@njit_inlined
def nearest_squares(halves, lane_at, low_x, low_y, low_z, lanes, block, keep, keep8, squares):
    """Compute the least squared distance of each marked point of an avatar to a scene block.

    lane_at: the scene block in `halves`.  low: its corner, relative to the frame. Writes squares.
    Returns (least of all, points tested).
    """
    h, b = U(lane_at), U(block)
    best, tested = np.float32(np.inf), 0
    for eight in range(LANES // 8):
        if keep8[U(eight)] == U(0):
            continue
        for lane in range(8 * eight, 8 * eight + 8):
            if not keep[U(lane)]:
                continue
            tested += 1
            x, y, z = lanes[b, 0, U(lane)] - low_x, lanes[b, 1, U(lane)] - low_y, lanes[b, 2, U(lane)] - low_z
            # The bits of non-negative floats sort like the numbers. The minimum of integers is
            # vectorised; that of floats is not, because LLVM must allow for a NaN.
            least = np.int32(0x7F800000)
            for j in range(LANES):
                i = h + U(j)
                dx = np.float32(halves[i]) - x
                dy = np.float32(halves[i + U(LANES)]) - y
                dz = np.float32(halves[i + U(2 * LANES)]) - z
                least = min(least, np.float32(dx * dx + dy * dy + dz * dz).view(np.int32))
            bits = np.int32(least)
            square = bits.view(np.float32)
            squares[U(lane)] = square
            best = min(best, square)
    return best, tested
