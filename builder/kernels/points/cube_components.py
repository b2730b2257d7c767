"""Points counted in cubes of one edge, components of cubes that touch, and those that hang above others.

A table of cubes consists of `cubes` (2^b, 3) int32, coordinates relative to an origin, and `counts`
(2^b,) int64, the number of points in each; a slot with a count of 0 is free.
"""

import numpy as np

from ....schemas.runtime import compiling as nb

# Maximum coordinate of a cube relative to the origin, either way: 10^5 km with cubes of 0.1 m.
# Points beyond it are counted as if at the limit.
MAX_CUBE = 1 << 30


@nb.njit(nogil=True, cache=True)
def find_slot(x, y, z, cubes, counts):
    """Return the slot of a cube in a table, or the free one where it belongs."""
    mask = np.uint64(cubes.shape[0] - 1)
    code = np.uint64(x) * np.uint64(0x9E3779B97F4A7C15)
    code = ((code >> np.uint64(29)) ^ code ^ np.uint64(y)) * np.uint64(0xBF58476D1CE4E5B9)
    code = ((code >> np.uint64(32)) ^ code ^ np.uint64(z)) * np.uint64(0x94D049BB133111EB)
    slot = (code >> np.uint64(30)) & mask
    while counts[slot] != 0 and not (cubes[slot, 0] == x and cubes[slot, 1] == y and cubes[slot, 2] == z):
        slot = (slot + np.uint64(1)) & mask
    return np.int64(slot)


@nb.njit(nogil=True, cache=True)
def count_points(xyz, edge, origin, cubes, counts, known):
    """Count points (n, 3) float64, finite, in their cubes: floor(coordinate / edge), less the origin.

    origin: (3,) int64, in cubes.  cubes, counts: a table, filled to at most three quarters.
    known: (1,) the number of cubes in it.
    Returns the number of points done, which is less than n where the table is full.
    """
    last = np.int64(-1)
    at = np.zeros(3, np.int64)
    before = np.zeros(3, np.int64)
    for i in range(xyz.shape[0]):
        for axis in range(3):
            cube = np.int64(np.floor(xyz[i, axis] / edge)) - origin[axis]
            at[axis] = min(max(cube, -MAX_CUBE), MAX_CUBE)
        # Points that follow one another are mostly in one cube.
        if last < 0 or at[0] != before[0] or at[1] != before[1] or at[2] != before[2]:
            if 4 * known[0] >= 3 * counts.shape[0]:
                return i
            last = find_slot(at[0], at[1], at[2], cubes, counts)
            before[0], before[1], before[2] = at[0], at[1], at[2]
            if counts[last] == 0:
                cubes[last, 0], cubes[last, 1], cubes[last, 2] = at[0], at[1], at[2]
                known[0] += 1
        counts[last] += 1
    return xyz.shape[0]


@nb.njit(nogil=True, cache=True)
def add_cubes(more, numbers, cubes, counts):
    """Add cubes (n, 3) with numbers (n,) of points, not 0, to a table with room for them.

    Returns how many of them were new.
    """
    new = 0
    for i in range(more.shape[0]):
        x, y, z = np.int64(more[i, 0]), np.int64(more[i, 1]), np.int64(more[i, 2])
        slot = find_slot(x, y, z, cubes, counts)
        if counts[slot] == 0:
            cubes[slot, 0], cubes[slot, 1], cubes[slot, 2] = x, y, z
            new += 1
        counts[slot] += numbers[i]
    return new


@nb.njit(nogil=True, cache=True)
def _root(parents, slot):
    """Return the representative of a slot; halve the path to it."""
    while parents[slot] != slot:
        parents[slot] = parents[parents[slot]]
        slot = parents[slot]
    return slot


@nb.njit(nogil=True, cache=True)
def join_cubes(cubes, counts, parents, points):
    """Join cubes that touch, with a face, an edge or a corner, into components.

    Writes parents (2^b,) int64: the slot that represents the component, -1 for a free slot; and
    points (2^b,) int64: at these slots the component's number of points, elsewhere 0.
    """
    for slot in range(counts.shape[0]):
        parents[slot] = slot if counts[slot] != 0 else -1
        points[slot] = 0
    for slot in range(counts.shape[0]):
        if counts[slot] == 0:
            continue
        x, y, z = np.int64(cubes[slot, 0]), np.int64(cubes[slot, 1]), np.int64(cubes[slot, 2])
        # Half of the 26 neighbours: each pair is met once.
        for number in range(14, 27):
            dx, dy, dz = number // 9 - 1, number // 3 % 3 - 1, number % 3 - 1
            other = find_slot(x + dx, y + dy, z + dz, cubes, counts)
            if counts[other] != 0:
                a, b = _root(parents, slot), _root(parents, other)
                if a != b:
                    parents[max(a, b)] = min(a, b)
    for slot in range(counts.shape[0]):
        if counts[slot] != 0:
            parents[slot] = _root(parents, slot)
            points[parents[slot]] += counts[slot]


@nb.njit(nogil=True, cache=True)
def find_hanging(cubes, counts, parents, points, few, deep, lowest, hangs):
    """Find the components with fewer than `few` points that hang above a cube of a larger one.

    A component hangs if below one of its lowest cubes, in the same column or one of the eight around
    it, and at most `deep` cubes lower, there is a cube of a component with at least `few` points.
    cubes, counts, parents, points: as `join_cubes` leaves them.
    Writes lowest (2^b,) int64, the least z of a component, and hangs (2^b,) bool, both at the slots
    that represent components.
    """
    for slot in range(counts.shape[0]):
        lowest[slot], hangs[slot] = MAX_CUBE + 1, False
    for slot in range(counts.shape[0]):
        if counts[slot] != 0:
            root = parents[slot]
            lowest[root] = min(lowest[root], np.int64(cubes[slot, 2]))
    for slot in range(counts.shape[0]):
        if counts[slot] == 0:
            continue
        root = parents[slot]
        if points[root] >= few or hangs[root] or cubes[slot, 2] != lowest[root]:
            continue
        x, y, z = np.int64(cubes[slot, 0]), np.int64(cubes[slot, 1]), np.int64(cubes[slot, 2])
        # Cubes at the level above would touch.
        for down in range(2, deep + 1):
            for number in range(9):
                below = find_slot(x + number // 3 - 1, y + number % 3 - 1, z - down, cubes, counts)
                if counts[below] != 0 and points[parents[below]] >= few:
                    hangs[root] = True
                    break
            if hangs[root]:
                break


@nb.njit(nogil=True, cache=True)
def count_around(cubes, counts, around):
    """Write around (2^b,) int64: the points of each cube and of the 26 that touch it; 0 if free."""
    for slot in range(counts.shape[0]):
        around[slot] = 0
        if counts[slot] == 0:
            continue
        x, y, z = np.int64(cubes[slot, 0]), np.int64(cubes[slot, 1]), np.int64(cubes[slot, 2])
        for number in range(27):
            other = find_slot(x + number // 9 - 1, y + number // 3 % 3 - 1, z + number % 3 - 1, cubes, counts)
            around[slot] += counts[other]


@nb.njit(nogil=True, cache=True)
def find_slots(wanted, cubes, counts, slots):
    """Write slots (n,) int64: where a table has the cubes `wanted` (n, 3), all of which are in it."""
    for i in range(wanted.shape[0]):
        x, y, z = np.int64(wanted[i, 0]), np.int64(wanted[i, 1]), np.int64(wanted[i, 2])
        slots[i] = find_slot(x, y, z, cubes, counts)
