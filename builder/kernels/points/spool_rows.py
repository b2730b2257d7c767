"""Conversion of world points to voxel and Morton code and back, used by the survey and spool passes.

Each step is a separate loop over a few thousand points, which stay in the L1 and L2 caches between
the steps. The compiler can then vectorise every loop without branches.
"""

import numpy as np

from ....schemas.kernels.morton import morton_code, morton_position
from ....schemas.runtime import compiling as nb
from .content_hash import mix_column, mixed_sum

# Points per round of all steps.
CHUNK = 4096
# Free slot of the voxel table: no Morton key has its highest bit set.
FREE = np.uint64(0xFFFFFFFFFFFFFFFF)


@nb.njit(nogil=True, cache=True)
def usable_bounds(xyz, farthest, low, high):
    """Count the points of (n, 3) float64 that are finite and within `farthest` on every axis.

    Widens low, high (3,) to these points.
    """
    x0, y0, z0 = low[0], low[1], low[2]
    x1, y1, z1 = high[0], high[1], high[2]
    count = 0
    for i in range(xyz.shape[0]):
        x, y, z = xyz[i, 0], xyz[i, 1], xyz[i, 2]
        if abs(x) <= farthest and abs(y) <= farthest and abs(z) <= farthest:  # false for NaN
            count += 1
            x0, y0, z0 = min(x0, x), min(y0, y), min(z0, z)
            x1, y1, z1 = max(x1, x), max(y1, y), max(z1, z)
    low[0], low[1], low[2] = x0, y0, z0
    high[0], high[1], high[2] = x1, y1, z1
    return count


@nb.njit(nogil=True, cache=True)
def closest_to(xyz, probes, least, best):
    """Lower best (p,) to the squared distances [m^2] of probes (3, p) to the closest of points (n, 3).

    All are float64. Distances below `least` [m] are not counted: the probe is a point itself, and
    may have twins. A point or probe that is not finite changes nothing.
    """
    for i in range(xyz.shape[0]):
        x, y, z = xyz[i, 0], xyz[i, 1], xyz[i, 2]
        for k in range(best.shape[0]):
            dx, dy, dz = x - probes[0, k], y - probes[1, k], z - probes[2, k]
            square = dx * dx + dy * dy + dz * dz
            # No branch: the loop is vectorised, 8 ns a point for 32 probes.
            best[k] = square if (square >= least * least) & (square < best[k]) else best[k]


@nb.njit(nogil=True, cache=True)
def _to_lattice(xyz, axis, origin, step, steps):
    """Quantise one axis of points (n, 3), half to even, into steps (n,) int64.

    The operations are those of Lattice.to_lattice and to_world, one by one: the results are
    bit-identical. Returns the greatest quantisation error [m].
    """
    moved = 0.0
    for i in range(xyz.shape[0]):
        x = xyz[i, axis]
        rounded = np.rint((x - origin) / step)
        steps[i] = np.int64(rounded)
        moved = max(moved, abs((rounded * step + origin) - x))
    return moved


@nb.njit(nogil=True, cache=True)
def _to_voxel(steps, voxel_steps, voxel, local):
    """Divide lattice steps (n,) int64 by voxel_steps, rounding down.

    Writes voxel (n,), the quotients, and local (n,), the remainders. Steps are below 2^52 in size.
    """
    inverse = 1.0 / voxel_steps
    for i in range(steps.shape[0]):
        # The multiplication may be off by one; the remainder is then outside [0, voxel_steps). An
        # integer division takes 20 times as long.
        quotient = np.int64(np.floor(np.float64(steps[i]) * inverse))
        left = steps[i] - quotient * voxel_steps
        correction = np.int64(left >= voxel_steps) - np.int64(left < 0)
        voxel[i] = quotient + correction
        local[i] = left - correction * voxel_steps


@nb.njit(nogil=True, cache=True)
def _to_codes(x, y, z, bias, codes):
    """Write the Morton codes (n,) of coordinates (n,) int64 per axis, plus bias."""
    for i in range(codes.shape[0]):
        codes[i] = morton_code(np.uint64(x[i] + bias), np.uint64(y[i] + bias), np.uint64(z[i] + bias))


@nb.njit(nogil=True, cache=True)
def _place_of(key, table):
    """Return the slot of a key in the table (2^b,), or a free slot for it.

    Linear probing from a multiplicative hash.
    """
    mask = np.uint64(table.shape[0] - 1)
    place = ((key * np.uint64(0x9E3779B97F4A7C15)) >> np.uint64(20)) & mask
    while table[place] != key and table[place] != FREE:
        place = (place + np.uint64(1)) & mask
    return place


@nb.njit(nogil=True, cache=True)
def _number_voxels(keys, table, number_of, known, count, numbers):
    """Write the number of each voxel key (n,) to numbers (n,) int32; return the number of voxels.

    Voxels are numbered in order of first occurrence.
    table (2^b,) uint64, number_of (2^b,) int32: hash table, with n free slots.
    known: (m,) uint64, the key of each number, `count` of them so far.
    """
    last, number = FREE, np.int32(0)
    for i in range(keys.shape[0]):
        if keys[i] != last:
            last = keys[i]
            place = _place_of(last, table)
            if table[place] == FREE:
                table[place] = last
                number_of[place] = count
                known[count] = last
                count += 1
            number = number_of[place]
        numbers[i] = number
    return count


@nb.njit(nogil=True, cache=True)
def rehash(known, count, table, number_of):
    """Fill an empty table with the first `count` known keys."""
    for number in range(count):
        place = _place_of(known[number], table)
        table[place] = known[number]
        number_of[place] = number


@nb.njit(nogil=True, cache=True)
def place_points(xyz, origin, step, voxel_steps, bias, more, seeds, voxels, numbers, codes, sums):
    """Quantise points and find their voxels, as many as the voxel table has room for.

    xyz: (n, 3) float64 world [m], finite and within range.
    origin (3,) [m], step [m], voxel_steps [steps]: the lattice.
    bias: KEY_BIAS.
    more: (m, n) uint64, further columns that identify the points.
    seeds: (2,) uint64.
    voxels: (table, number_of, known, count), see `_number_voxels`; count (1,) int64 is updated.
    Writes numbers (n,) int32 of voxels and codes (n,) uint64 in them. Adds to sums (3,) uint64: one
    per seed over all columns, and one of the first seed over lattice coordinates alone.
    Returns (points done, greatest quantisation error along an axis [m], lowest and highest voxel
    coordinate). When the returned coordinates are outside [-bias, bias), the written data is
    invalid.
    """
    table, number_of, known, count = voxels
    steps = np.empty((3 + more.shape[0], CHUNK), np.int64)
    voxel, local = np.empty((3, CHUNK), np.int64), np.empty((3, CHUNK), np.int64)
    keys, hashed, columns = np.empty(CHUNK, np.uint64), np.empty(CHUNK, np.uint64), steps.view(np.uint64)
    moved, lowest, highest = 0.0, bias, -bias - 1
    done = 0
    while done < xyz.shape[0] and 2 * (count[0] + CHUNK) <= table.shape[0]:
        end = min(done + CHUNK, xyz.shape[0])
        size = end - done
        for axis in range(3):
            moved = max(moved, _to_lattice(xyz[done:end], axis, origin[axis], step, steps[axis][:size]))
            _to_voxel(steps[axis][:size], voxel_steps, voxel[axis][:size], local[axis][:size])
            lowest = min(lowest, voxel[axis][:size].min())
            highest = max(highest, voxel[axis][:size].max())
        if lowest < -bias or highest >= bias:
            return done, moved, lowest, highest
        for k in range(more.shape[0]):
            for i in range(size):
                columns[3 + k, i] = more[k, done + i]
        for k in range(2):
            hashed[:] = seeds[k]
            for c in range(columns.shape[0]):
                mix_column(hashed[:size], columns[c][:size], seeds[k])
                if k == 0 and c == 2:
                    sums[2] += mixed_sum(hashed[:size])
            sums[k] += mixed_sum(hashed[:size])
        _to_codes(voxel[0], voxel[1], voxel[2], bias, keys[:size])
        _to_codes(local[0], local[1], local[2], 0, codes[done:end])
        count[0] = _number_voxels(keys[:size], table, number_of, known, count[0], numbers[done:end])
        done = end
    return done, moved, lowest, highest


@nb.njit(nogil=True, cache=True)
def scatter(numbers, values, place, out):
    """Scatter values (n,) to out[place[number]], ordered by voxel; advances place (v,) per value."""
    for i in range(numbers.shape[0]):
        number = numbers[i]
        out[place[number]] = values[i]
        place[number] += 1


@nb.njit(nogil=True, cache=True)
def order_ties(codes, order, ranks):
    """Sort each run of equal codes (n,), ascending, by ranks.

    order: (n,) int64, the point of each code; its rank is ranks[order]. Reordered.
    Insertion sort, because runs are short; a long run, duplicates of one point, uses a library
    sort.
    """
    n = codes.shape[0]
    begin = 0
    while begin < n:
        end = begin + 1
        while end < n and codes[end] == codes[begin]:
            end += 1
        if end - begin > 32:
            held, own = order[begin:end].copy(), np.empty(end - begin, ranks.dtype)
            for i in range(end - begin):
                own[i] = ranks[held[i]]
            sorted_by_rank = np.argsort(own, kind="mergesort")
            for i in range(end - begin):
                order[begin + i] = held[sorted_by_rank[i]]
        else:
            for i in range(begin + 1, end):
                item = order[i]
                k = i
                while k > begin and ranks[order[k - 1]] > ranks[item]:
                    order[k] = order[k - 1]
                    k -= 1
                order[k] = item
        begin = end


@nb.njit(nogil=True, cache=True)
def fill_local(codes, local):
    """Write the coordinates of Morton codes (n,) into local (n, 3) int32."""
    for i in range(codes.shape[0]):
        local[i, 0], local[i, 1], local[i, 2] = morton_position(codes[i])
