"""Normals of the scan at touched points, and heights of the points around; see walk_state.py."""

import numpy as np

from ....schemas.kernels import compiling as nb
from ....schemas.kernels.normal_codes import NO_NORMAL, decode_normal
from ..rays.stored_normals import code_at, find_voxel, highest_near, stored_code_at
from .walk_queries import ask_at, pair_of
from .walk_state import (
    ARCHIVE,
    HAS_NORMAL,
    HAS_PAIR,
    HEIGHTS,
    HIGHEST,
    KNOWN,
    NORMAL,
    NORMAL_AT,
    next_row,
    use_voxels,
)
from .walk_vectors import dot, minus, times, vector


@nb.njit(nogil=True, cache=True)
def _voxel_at(walk, place):
    """Return the lattice point of a place (3,) [m], and the row of its voxel.

    -1: there is no voxel; -2: it is not in memory. Rounds half to even, as `Lattice.to_lattice`.
    """
    scene = walk.held.scene
    x = np.int64(np.rint((place[0] - scene.origin[0]) / scene.step))
    y = np.int64(np.rint((place[1] - scene.origin[1]) / scene.step))
    z = np.int64(np.rint((place[2] - scene.origin[2]) / scene.step))
    row = find_voxel(walk.held.index.keys, scene.voxel_steps, x, y, z)
    if row >= 0:
        if scene.where[row, 0] < 0:
            return x, y, z, -2
        walk.memory.rows[0] = row
        use_voxels(walk.memory, 1)
    return x, y, z, row


@nb.njit(nogil=True, cache=True)
def _code(walk, x, y, z, row, level):
    """Return the code of the normal at a lattice point of a voxel in memory. level: as for `scan_normal`."""
    if row < 0:
        return NO_NORMAL
    square = walk.squares[level]
    if square == walk.squares[3]:
        code, _ = stored_code_at(walk.held, row, x, y, z, walk.squares[4] != 0)
        return code
    code, _, _ = code_at(walk.held, row, x, y, z, square, np.empty(0, np.uint16))
    return code


@nb.njit(nogil=True, cache=True)
def scan_normal(walk, archive, cloud, toward, level):
    """Return whether the normal at a scan point is known, and it: a unit vector on the side of `toward`.

    archive: number of the scan's archive.  cloud: the point, world [m].  level: 0: points within the
    normal reach form the surface; 1: those within three times that. If they form none, the next level
    is taken.
    """
    memory = walk.memory
    row = next_row(memory)
    if row >= memory.log[KNOWN]:
        x, y, z, voxel = np.int64(0), np.int64(0), np.int64(0), np.int64(-2)
        if walk.native and walk.squares[0] > 0:
            x, y, z, voxel = _voxel_at(walk, cloud)
        if voxel == -2:
            for r in range(3):
                memory.asked[3 + r] = toward[r]
            memory.asked[6], memory.asked[7] = np.float64(archive), np.float64(level)
            ask_at(walk, NORMAL_AT, cloud)
        code = _code(walk, x, y, z, voxel, level)
        if code == NO_NORMAL:
            code = _code(walk, x, y, z, voxel, level + 1)
        memory.tape[row, HAS_NORMAL] = 0.0 if code == NO_NORMAL else 1.0
        if code != NO_NORMAL:
            found = decode_normal(code)
            found = times(-1.0 if dot(found, toward) < 0.0 else 1.0, found)
            for r in range(3):
                memory.tape[row, NORMAL + r] = found[r]
        memory.log[KNOWN] = row + 1
    result = memory.tape[row]
    return result[HAS_NORMAL] != 0.0, vector(result[NORMAL : NORMAL + 3])


@nb.njit(nogil=True, cache=True)
def hit_normal(walk, hit, level):
    """Return whether the normal at a hit is known, and it; of a body, as its hit has it."""
    result = walk.memory.tape[hit]
    if result[HAS_PAIR] == 0.0 or result[ARCHIVE] < 0.0:
        return result[HAS_NORMAL] != 0.0, vector(result[NORMAL : NORMAL + 3])
    own, cloud = pair_of(walk, hit)
    return scan_normal(walk, result[ARCHIVE], cloud, minus(own, cloud), level)


@nb.njit(nogil=True, cache=True)
def scan_heights(walk, hit, directions, level):
    """Return how high the scan points around a touched one lie along up to three directions [m].

    directions: (k, 3) unit.  level: as for `scan_normal`. Of further directions, the heights are zero.
    """
    memory = walk.memory
    row = next_row(memory)
    if row >= memory.log[KNOWN]:
        archive, (_, cloud) = memory.tape[hit, ARCHIVE], pair_of(walk, hit)
        count = directions.shape[0]
        x, y, z, voxel = np.int64(0), np.int64(0), np.int64(0), np.int64(-2)
        if walk.native and walk.squares[0] > 0:
            x, y, z, voxel = _voxel_at(walk, cloud)
        if voxel == -2:
            memory.asked[3], memory.asked[4], memory.asked[5] = archive, np.float64(level), np.float64(count)
            for n in range(count):
                for r in range(3):
                    memory.asked[6 + 3 * n + r] = directions[n, r]
            ask_at(walk, HIGHEST, cloud)
        heights = memory.tape[row, HEIGHTS : HEIGHTS + 3]
        for n in range(3):
            heights[n] = 0.0
        if voxel >= 0:
            highest_near(walk.held, voxel, x, y, z, walk.squares[level], directions, heights[:count])
            for n in range(count):
                heights[n] *= walk.held.scene.step
        memory.log[KNOWN] = row + 1
    return vector(memory.tape[row, HEIGHTS : HEIGHTS + 3])
