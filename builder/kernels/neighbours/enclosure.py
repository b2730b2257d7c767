"""Check that every bound of a record encloses the points below it, for `solidcloud validate --deep`."""

import numpy as np

from ....schemas.kernels import compiling as nb
from ....schemas.kernels.rows import LANES
from ..points.voxel_records import U, link_parents, read_leaf


@nb.njit(nogil=True, cache=True)
def last_loose_node(leaves, spheres, normal, slab):
    """Return the last node of a record whose sphere or slab misses a point below it, or -1.

    leaves, spheres: see voxel_records.py, nearest_points.py.
    normal: (3, n) int8.
    slab: (2, n) int32.
    Each leaf node is decoded once, and its points are checked in integers against all nodes above
    it.
    """
    center, radius, unit = spheres
    parents = link_parents(leaves.first, leaves.count, leaves.is_leaf)
    lanes = np.empty((3, LANES), np.int32)
    loose = np.int64(-1)
    for i in range(leaves.first.shape[0]):
        if not leaves.is_leaf[i]:
            continue
        held, cell = read_leaf(leaves, U(i), lanes), leaves.cell[i]
        node = np.int64(i)
        while node >= 0:
            at, scale = U(node), np.int64(1)
            # Offset from the node's centre to the points' block.
            x = np.int64(leaves.block_low[U(0), U(i)]) - np.int64(center[U(0), at])
            y = np.int64(leaves.block_low[U(1), U(i)]) - np.int64(center[U(1), at])
            z = np.int64(leaves.block_low[U(2), U(i)]) - np.int64(center[U(2), at])
            if leaves.cell[at] < 0:
                scale = unit
                x += np.int64(center[U(0), at]) * (1 - unit) + np.int64(leaves.cell_low[U(0), U(cell)])
                y += np.int64(center[U(1), at]) * (1 - unit) + np.int64(leaves.cell_low[U(1), U(cell)])
                z += np.int64(center[U(2), at]) * (1 - unit) + np.int64(leaves.cell_low[U(2), U(cell)])
            square = (np.int64(radius[at]) * scale) ** 2
            nx, ny, nz = np.int64(normal[U(0), at]), np.int64(normal[U(1), at]), np.int64(normal[U(2), at])
            flat = nx == 0 and ny == 0 and nz == 0
            least, most = np.int64(slab[U(0), at]), np.int64(slab[U(1), at])
            for j in range(held):
                dx, dy, dz = x + lanes[U(0), j], y + lanes[U(1), j], z + lanes[U(2), j]
                along = nx * dx + ny * dy + nz * dz
                if dx * dx + dy * dy + dz * dz > square or (not flat and (along < least or along > most)):
                    if node > loose:
                        loose = node
                    break
            node = np.int64(parents[at])
    return loose
