"""Access to the points of an opened record, leaf node by leaf node, directly from its byte planes.

A voxel may hold tens of millions of points: rows of int64 would take 24 bytes a point, the planes
take 6. The points of a leaf node are decoded on each access, which takes 2 ns a point. Indices are
uint64 for the reasons in schemas/kernels/record_rows.py. Kernels take a record as a `Leaves`, or as
a tuple of the same fields.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ....schemas.kernels.record_rows import LANES
from ....schemas.runtime import compiling as nb
from .content_hash import mix

U = np.uint64


class Leaves(NamedTuple):
    """Opened record (schemas/archive/codec.py DecompressedRecord) as kernels take it; its tree has been checked.

    planes: (6 or more, p) uint8, low and high bytes of x, y, z.
    first, is_leaf, cell: (n,), the links.
    count, axis: (n,) uint8.
    block_low: (3, n) uint16.
    cell_low: (3, c) int32.
    log2_size: (c,) uint8.
    """

    planes: NDArray[np.uint8]
    first: NDArray[np.int32]
    is_leaf: NDArray[np.bool_]
    cell: NDArray[np.int32]
    count: NDArray[np.uint8]  # type: ignore[assignment]  # hides tuple.count, which is never called
    axis: NDArray[np.uint8]
    block_low: NDArray[np.uint16]
    cell_low: NDArray[np.int32]
    log2_size: NDArray[np.uint8]


@nb.njit(nogil=True, inline="always")
def read_leaf(leaves, node, lanes):
    """Write the points of a leaf node into lanes (3, LANES) int32; return their number.

    Coordinates are steps from the node's block_low. Delta coding is undone. A sum beyond 2^16 is
    kept as it is and later detected as outside the cell.
    """
    begin, held, along = U(leaves.first[node]), U(leaves.count[node]), U(leaves.axis[node])
    for k in range(U(3)):
        low, high, out = leaves.planes[U(2) * k], leaves.planes[U(2) * k + U(1)], lanes[k]
        for j in range(held):
            out[j] = np.int32(low[begin + j]) | (np.int32(high[begin + j]) << np.int32(8))
    out = lanes[along]
    total = np.int32(0)
    for j in range(held):
        total += out[j]
        out[j] = total
    return held


@nb.njit(nogil=True, cache=True)
def link_parents(first, count, is_leaf):
    """Return the parent of each node, (n,) int32; -1 for the root."""
    parents = np.full(first.shape[0], -1, np.int32)
    for node in range(first.shape[0]):
        if not is_leaf[node]:
            for child in range(first[node], first[node] + np.int64(count[node])):
                parents[child] = node
    return parents


@nb.njit(nogil=True, cache=True)
def measure_points(leaves, voxel_steps, low, high):
    """Find the least and greatest coordinates of all points, low and high (3,) int64 [voxel steps].

    Returns whether every point lies inside its cell and the voxel; stops at the first leaf node
    where one does not.
    """
    lanes = np.empty((3, LANES), np.int32)
    low[:], high[:] = voxel_steps, -1
    for i in range(U(leaves.first.shape[0])):
        if not leaves.is_leaf[i]:
            continue
        held, cell = read_leaf(leaves, i, lanes), U(leaves.cell[i])
        size = np.int64(1) << np.int64(leaves.log2_size[cell])
        for k in range(U(3)):
            out = lanes[k]
            least, most = out[U(0)], out[U(0)]
            for j in range(held):
                least, most = min(least, out[j]), max(most, out[j])
            block, corner = np.int64(leaves.block_low[k, i]), np.int64(leaves.cell_low[k, cell])
            if block + most >= size or block + most + corner >= voxel_steps:
                return False
            low[k] = min(low[k], corner + block + least)
            high[k] = max(high[k], corner + block + most)
    return True


@nb.njit(nogil=True, cache=True)
def position_hash_sum(leaves, base, seed):
    """Return the `content_sum` (content_hash.py) over the lattice coordinates of all points: modulo 2^64.

    base: (3,) int64, lattice coordinates of the voxel's corner.
    seed: uint64.
    """
    lanes, hashed = np.empty((3, LANES), np.int32), np.empty(LANES, np.uint64)
    total = U(0)
    for i in range(U(leaves.first.shape[0])):
        if not leaves.is_leaf[i]:
            continue
        held, cell = read_leaf(leaves, i, lanes), U(leaves.cell[i])
        hashed[:] = seed
        for k in range(U(3)):
            corner = base[k] + np.int64(leaves.cell_low[k, cell]) + np.int64(leaves.block_low[k, i])
            out = lanes[k]
            for j in range(held):
                hashed[j] = mix(hashed[j] ^ U(corner + np.int64(out[j]))) + seed
        for j in range(held):
            total += mix(hashed[j])
    return total


@nb.njit(nogil=True, cache=True)
def copy_points(leaves, start, base, low, high, limit, xyz, rows, nodes):
    """Write points of the leaf nodes from node `start` on, as many leaf nodes as have room.

    base: (3,) int64, lattice coordinates of the voxel's corner.
    low, high: (3,) int64, the wanted box of lattice coordinates, inclusive.
    limit: uint64; only points whose `point_hash` is below it, and only the first of equal points in
    a leaf node; 0: all points.
    Writes xyz (m, 3) int32 [voxel steps], rows (m,) int64, the point's number in the record, and
    nodes (m,) int32, its leaf node. m must be at least LANES. Returns (the node to continue with, n
    when all are done; the number of points written).
    """
    lanes, hashes = np.empty((3, LANES), np.int32), np.zeros(LANES, np.uint64)
    done = 0
    for i in range(start, leaves.first.shape[0]):
        if not leaves.is_leaf[i]:
            continue
        node = U(i)
        if done + np.int64(leaves.count[node]) > xyz.shape[0]:
            return i, done
        held, cell, first = read_leaf(leaves, node, lanes), U(leaves.cell[node]), done
        x0 = np.int64(leaves.cell_low[U(0), cell]) + np.int64(leaves.block_low[U(0), node])
        y0 = np.int64(leaves.cell_low[U(1), cell]) + np.int64(leaves.block_low[U(1), node])
        z0 = np.int64(leaves.cell_low[U(2), cell]) + np.int64(leaves.block_low[U(2), node])
        if limit > U(0):
            # A separate loop without branches takes half the time.
            for j in range(held):
                x, y, z = (
                    base[0] + x0 + lanes[U(0), j],
                    base[1] + y0 + lanes[U(1), j],
                    base[2] + z0 + lanes[U(2), j],
                )
                hashes[j] = point_hash(x, y, z)
        for j in range(held):
            if limit > U(0) and hashes[j] >= limit:
                continue
            x, y, z = x0 + lanes[U(0), j], y0 + lanes[U(1), j], z0 + lanes[U(2), j]
            wx, wy, wz = x + base[0], y + base[1], z + base[2]
            if wx < low[0] or wy < low[1] or wz < low[2] or wx > high[0] or wy > high[1] or wz > high[2]:
                continue
            if limit > U(0) and _is_among(xyz, first, done, x, y, z):
                continue
            xyz[done, 0], xyz[done, 1], xyz[done, 2] = x, y, z
            rows[done], nodes[done] = np.int64(leaves.first[node]) + np.int64(j), i
            done += 1
    return leaves.first.shape[0], done


@nb.njit(nogil=True, inline="always")
def _is_among(xyz, begin, end, x, y, z):
    """Return whether (x, y, z) is one of xyz[begin:end]."""
    for i in range(begin, end):  # noqa: SIM110  numba has no any()
        if xyz[i, 0] == x and xyz[i, 1] == y and xyz[i, 2] == z:
            return True
    return False


@nb.njit(nogil=True, cache=True)
def point_hash(x, y, z):
    """Return a 64-bit hash of lattice coordinates, int64.

    The hash applies the finaliser of MurmurHash3 (Appleby) over all three.
    """
    h = U(0)
    for w in (x, y, z):
        h ^= U(w)
        h ^= h >> U(33)
        h *= U(0xFF51AFD7ED558CCD)
        h ^= h >> U(33)
        h *= U(0xC4CEB9FE1A85EC53)
        h ^= h >> U(33)
    return h


@nb.njit(nogil=True, cache=True)
def point_hashes(lattice):
    """Return the `point_hash` of each of lattice (n, 3) int64, (n,) uint64."""
    hashes = np.empty(lattice.shape[0], np.uint64)
    for i in range(lattice.shape[0]):
        hashes[i] = point_hash(lattice[i, 0], lattice[i, 1], lattice[i, 2])
    return hashes


@nb.njit(nogil=True, cache=True)
def first_of_each(xyz):
    """Return which of xyz (n, 3) int32 is the first at its position: (n,) bool.

    Coordinates are in [0, 2^21).
    """
    n = xyz.shape[0]
    slots = 16
    while slots < 2 * n:
        slots *= 2
    taken = np.full(slots, -1, np.int64)
    first = np.empty(n, np.bool_)
    for i in range(n):
        x, y, z = np.int64(xyz[i, 0]), np.int64(xyz[i, 1]), np.int64(xyz[i, 2])
        packed = x | (y << 21) | (z << 42)
        at = np.int64(point_hash(x, y, z) & U(slots - 1))
        while taken[at] >= 0 and taken[at] != packed:
            at = (at + 1) & (slots - 1)
        first[i] = taken[at] < 0
        taken[at] = packed
    return first


@nb.njit(nogil=True, cache=True)
def last_unenclosing_node(leaves, spheres, normal, slab):
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
    unenclosing = np.int64(-1)
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
                    if node > unenclosing:
                        unenclosing = node
                    break
            node = np.int64(parents[at])
    return unenclosing
