"""Normals of the scan at touched points, and heights of the points around; see walk_state.py."""

import numpy as np

from ....schemas.kernels import compiling as nb
from ..core.normal_codes import NO_NORMAL, SUMS, decode_normal, normal_code
from ..core.reach import all_resident
from ..rays.surface import add_near, voxels_near
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
def _add_near(walk, place, level, sums, directions, heights):
    """Add the scan points within reach of a place (3,) [m], as `add_near` does; return whether that is known.

    It is unknown unless all voxels within reach are in memory. level: as for `scan_normal`.
    """
    scene, square, rows = walk.held.scene, walk.squares[level], walk.held.one.reach.lists.rows
    if not walk.native or square == 0:
        return False
    # Rounds half to even, as `Lattice.to_lattice`.
    x = np.int64(np.rint((place[0] - scene.origin[0]) / scene.step))
    y = np.int64(np.rint((place[1] - scene.origin[1]) / scene.step))
    z = np.int64(np.rint((place[2] - scene.origin[2]) / scene.step))
    count = voxels_near(walk.held, x, y, z, square, rows)
    if not all_resident(scene.where, rows, count):
        return False
    voxels = rows[:count]
    use_voxels(walk, count)
    add_near(walk.held, voxels, x, y, z, square, sums, directions, heights)
    return True


@nb.njit(nogil=True, cache=True)
def _code(walk, place, level):
    """Return whether the normal at a place is known, and its code. level: as for `scan_normal`."""
    sums = np.zeros(SUMS, np.int64)
    known = _add_near(walk, place, level, sums, np.empty((0, 3)), np.empty(0))
    return known, normal_code(sums)


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
        known, code = _code(walk, cloud, level)
        if known and code == NO_NORMAL:
            known, code = _code(walk, cloud, level + 1)
        if not known:
            for r in range(3):
                memory.asked[3 + r] = toward[r]
            memory.asked[6], memory.asked[7] = np.float64(archive), np.float64(level)
            ask_at(walk, NORMAL_AT, cloud)
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
        count, heights, sums = (
            directions.shape[0],
            memory.tape[row, HEIGHTS : HEIGHTS + 3],
            np.zeros(SUMS, np.int64),
        )
        for n in range(3):
            heights[n] = 0.0
        if not _add_near(walk, cloud, level, sums, directions, heights[:count]):
            memory.asked[3], memory.asked[4], memory.asked[5] = archive, np.float64(level), np.float64(count)
            for n in range(count):
                for r in range(3):
                    memory.asked[6 + 3 * n + r] = directions[n, r]
            ask_at(walk, HIGHEST, cloud)
        for n in range(count):
            heights[n] *= walk.held.scene.step
        memory.log[KNOWN] = row + 1
    return vector(memory.tape[row, HEIGHTS : HEIGHTS + 3])
