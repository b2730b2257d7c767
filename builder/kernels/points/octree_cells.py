"""Cells of one voxel: an octree split by number of points, over points in Morton order."""

import numpy as np

from ....schemas.kernels.morton import morton_code
from ....schemas.runtime import compiling as nb


@nb.njit(nogil=True, cache=True)
def first_at_least(values, lo, hi, value):
    """Return the first index in [lo, hi) of values (n,) that is not below value; hi when there is none.

    values must be sorted in [lo, hi). value must have the type of values: numba compares an
    unsigned with a signed integer as float64.
    """
    while lo < hi:
        mid = (lo + hi) // 2
        if values[mid] < value:
            lo = mid + 1
        else:
            hi = mid
    return lo


@nb.njit(nogil=True, cache=True)
def voxel_codes(points):
    """Return the Morton codes (n,) uint64 of points (n, 3) integers [voxel steps], each in [0, 2^21)."""
    n = points.shape[0]
    codes = np.empty(n, np.uint64)
    for i in range(n):
        codes[i] = morton_code(np.uint64(points[i, 0]), np.uint64(points[i, 1]), np.uint64(points[i, 2]))
    return codes


@nb.njit(nogil=True, cache=True)
def split_octree(codes, root_log2, largest_log2, capacity):
    """Split sorted points into the leaf cells of an octree ([Fig12] section 4), in Morton order.

    codes: (n,) uint64 sorted, n >= 1, of points in [0, 2^root_log2).
    largest_log2: cells above this size are split whatever they hold.
    capacity: cells with more points are split, down to one lattice step; duplicates can fill a cell
    of one step over capacity (NUMERICS.md case 7, 12).
    Returns (start (c,) int64, the first point of each cell; log2_size (c,) uint8). The split is
    depth first: at most 7 siblings a level are on the stack.
    """
    n = codes.shape[0]
    starts = np.empty(n, np.int64)
    sizes = np.empty(n, np.uint8)
    stack = np.empty((8 * (root_log2 + 1) + 1, 3), np.int64)
    stack[0, 0], stack[0, 1], stack[0, 2] = 0, n, root_log2
    depth, cells = 1, 0
    while depth > 0:
        depth -= 1
        lo, hi, log2 = stack[depth, 0], stack[depth, 1], stack[depth, 2]
        if log2 == 0 or (hi - lo <= capacity and log2 <= largest_log2):
            starts[cells] = lo
            sizes[cells] = log2
            cells += 1
            continue
        shift = np.uint64(3 * (log2 - 1))
        base = (codes[lo] >> (shift + np.uint64(3))) << np.uint64(3)
        end = hi
        for child in range(7, -1, -1):  # pushed in reverse, popped in Morton order
            begin = first_at_least(codes, lo, end, (base | np.uint64(child)) << shift)
            if begin < end:
                stack[depth, 0], stack[depth, 1], stack[depth, 2] = begin, end, log2 - 1
                depth += 1
            end = begin
    return starts[:cells].copy(), sizes[:cells].copy()


@nb.njit(nogil=True, cache=True)
def count_capacities(codes, root_log2, largest_log2):
    """Count the cubes below the root that `split_octree` makes leaf cells, for every capacity at once.

    codes, root_log2, largest_log2: as for `split_octree`.
    Returns changes (n + 1,) int64: for capacities k of 1 to n, changes[1] + ... + changes[k] is the
    number of leaf cells below the root while the root itself is split. A cube of c points in a cube
    of p points is a leaf cell for c <= k < p. A cube of one step is one for every k < p, and a cube
    of the largest permitted edge for every k >= c.
    """
    n = codes.shape[0]
    changes = np.zeros(n + 1, np.int64)
    stack = np.empty((8 * (root_log2 + 1) + 1, 3), np.int64)
    stack[0, 0], stack[0, 1], stack[0, 2] = 0, n, root_log2
    depth = 1
    while depth > 0:
        depth -= 1
        lo, hi, log2 = stack[depth, 0], stack[depth, 1], stack[depth, 2]
        if log2 == 0 or (hi - lo == 1 and log2 <= largest_log2):
            continue  # never split
        shift = np.uint64(3 * (log2 - 1))
        base = (codes[lo] >> (shift + np.uint64(3))) << np.uint64(3)
        end = hi
        for child in range(7, -1, -1):
            begin = first_at_least(codes, lo, end, (base | np.uint64(child)) << shift)
            if begin < end:
                if log2 - 1 <= largest_log2:
                    changes[1 if log2 == 1 else end - begin] += 1
                    if log2 <= largest_log2:
                        changes[hi - lo] -= 1
                stack[depth, 0], stack[depth, 1], stack[depth, 2] = begin, end, log2 - 1
                depth += 1
            end = begin
    return changes


@nb.njit(nogil=True, cache=True)
def is_ascending(codes):
    """Return whether codes (n,) uint64 ascend; equal codes are allowed."""
    falls = np.uint64(0)
    for i in range(np.uint64(1), np.uint64(codes.shape[0])):
        falls += np.uint64(codes[i] < codes[i - np.uint64(1)])
    return falls == 0


@nb.njit(nogil=True, cache=True)
def merge_order(codes, starts):
    """Return the order (n,) int32 that sorts codes (n,) uint64, n < 2^31, made of ascending runs.

    starts: (k + 1,) int64, k >= 1, first index of each run, and n.
    The sort is stable: of equal codes those of earlier runs come first. Runs are merged in pairs.
    The choice of the next element from two runs is branch-free, because a branch would be
    mispredicted half the time.
    """
    n, runs = codes.shape[0], starts.shape[0] - 1
    ends = starts.copy()
    values, spare_values = codes.copy(), np.empty(n, np.uint64)
    order, spare = np.arange(n).astype(np.int32), np.empty(n, np.int32)
    while runs > 1:
        merged = 0
        for run in range(0, runs, 2):
            i, middle = ends[run], ends[run + 1]
            j, end = middle, ends[min(run + 2, runs)]
            to = i
            while i < middle and j < end:
                second = values[j] < values[i]
                chosen = j if second else i
                spare_values[to], spare[to] = values[chosen], order[chosen]
                i += not second
                j += second
                to += 1
            rest = i if i < middle else j
            for left in range(end - to):
                spare_values[to + left], spare[to + left] = values[rest + left], order[rest + left]
            ends[merged + 1] = end
            merged += 1
        runs = merged
        values, spare_values = spare_values, values
        order, spare = spare, order
    return order


@nb.njit(nogil=True, cache=True)
def by_cell(xyz, starts):
    """Return points (3, n) uint16 in cell order as (3 n,): x[], y[], z[] of each cell.

    starts: (c + 1,), where the cells begin.
    """
    flat = np.empty(3 * xyz.shape[1], np.uint16)
    for cell in range(starts.shape[0] - 1):
        lo, held = np.uint64(starts[cell]), np.uint64(starts[cell + 1] - starts[cell])
        for k in range(np.uint64(3)):
            to = np.uint64(3) * lo + k * held
            for i in range(held):
                flat[to + i] = xyz[k, lo + i]
    return flat


@nb.njit(nogil=True, cache=True)
def by_axis(flat, starts):
    """Undo `by_cell`."""
    xyz = np.empty((3, flat.shape[0] // 3), np.uint16)
    for cell in range(starts.shape[0] - 1):
        lo, held = np.uint64(starts[cell]), np.uint64(starts[cell + 1] - starts[cell])
        for k in range(np.uint64(3)):
            at = np.uint64(3) * lo + k * held
            for i in range(held):
                xyz[k, lo + i] = flat[at + i]
    return xyz
