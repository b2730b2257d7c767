"""Points in chosen cubes, and the number of occupied voxels: one pass over points, for size estimates."""

import numpy as np

from ....schemas.runtime import compiling as nb

# Free slot of a voxel table: no key is negative.
FREE = np.int64(-1)
# Maximum voxel coordinate, either way; voxels beyond it are counted as if at the limit.
_MAX_VOXEL = (1 << 20) - 1


@nb.njit(nogil=True, cache=True)
def _insert(key, table):
    """Insert a key into a table (2^b,) with free slots; return 1 where it is new, else 0."""
    mask = np.uint64(table.shape[0] - 1)
    place = ((np.uint64(key) * np.uint64(0x9E3779B97F4A7C15)) >> np.uint64(20)) & mask
    while table[place] != FREE:
        if table[place] == key:
            return 0
        place = (place + np.uint64(1)) & mask
    table[place] = key
    return 1


@nb.njit(nogil=True, cache=True)
def insert_all(keys, table):
    """Insert keys (n,) into an empty table."""
    for i in range(keys.shape[0]):
        if keys[i] != FREE:
            _insert(keys[i], table)


@nb.njit(nogil=True, cache=True)
def find_cube_points(xyz, origin, step, voxel_steps, chosen, table, known, picked, slots, local):
    """Find the points of chosen cubes among points (n, 3) float64, finite; count all occupied voxels.

    chosen: (c, 5) int64: a voxel's key, the cube's coordinates in it, and s; the cube has 2^s steps
    along an axis.
    table: (2^b,) int64 of voxel keys, filled to at most three quarters.
    known: (1,) the number of keys in it.
    Writes picked, slots (n,) and local (n, 3) int64: for each point in a cube its number, its cube,
    and its coordinates in the voxel [steps].
    Returns (number of points in cubes, points done). Fewer points than n are done where the table
    is full.
    """
    count = 0
    last, any_chosen = FREE, False
    inverse = 1.0 / voxel_steps
    at = np.empty(3, np.int64)
    for i in range(xyz.shape[0]):
        key = np.int64(0)
        for axis in range(3):
            steps = np.int64(np.rint((xyz[i, axis] - origin[axis]) / step))
            voxel = np.int64(np.floor(np.float64(steps) * inverse))
            left = steps - voxel * voxel_steps
            # The multiplication may be off by one.
            voxel += np.int64(left >= voxel_steps) - np.int64(left < 0)
            at[axis] = steps - voxel * voxel_steps
            clipped = min(max(int(voxel), -_MAX_VOXEL), _MAX_VOXEL)
            key = (key << 21) | np.int64(clipped + _MAX_VOXEL)
        if key != last:
            if 4 * known[0] >= 3 * table.shape[0]:
                return count, i
            last, any_chosen = key, False
            known[0] += _insert(key, table)
            for c in range(chosen.shape[0]):
                any_chosen = any_chosen or chosen[c, 0] == key
        if any_chosen:
            for c in range(chosen.shape[0]):
                if (
                    chosen[c, 0] == key
                    and chosen[c, 1] == at[0] >> chosen[c, 4]
                    and chosen[c, 2] == at[1] >> chosen[c, 4]
                    and chosen[c, 3] == at[2] >> chosen[c, 4]
                ):
                    picked[count], slots[count] = i, c
                    local[count, 0], local[count, 1], local[count, 2] = at[0], at[1], at[2]
                    count += 1
                    break
    return count, xyz.shape[0]
