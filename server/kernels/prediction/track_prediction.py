"""Prediction of a user's motion, and the voxels it brings within reach, from the index alone.

A path is the path of the user's ball: m + 1 centres, beginning with the last pose [lattice steps],
m straight pieces.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ....schemas.archive.voxel_grid import KEY_BIAS
from ....schemas.kernels import compiling as nb
from ....schemas.kernels.morton import morton_code
from ..core.kernel_decorators import njit_no_refcount

# Typical values of poses that look like a walk: scatter of clock and position together [m], and
# speeds [m/s] and accelerations [m/s²] of people. The fit relies on them where poses are few or
# close in time, and needs no special cases.
SCATTER, USUAL_SPEED, USUAL_ACCELERATION = 0.02, 3.0, 2.0
# Bisections of a piece: first for its nearest point, then for the moment of touching; 2^-12 of a
# piece is less than a millisecond.
NEAREST_HALVINGS, TOUCH_HALVINGS = 40, 12
# Largest number of grid cells one call looks up: a few milliseconds, reached only with voxels far
# smaller than the reach. The last cells are then omitted.
MAX_CELLS = 1 << 14


class PredictionLimits(NamedTuple):
    """Limits of a prediction.

    history: poses older than this before the last are ignored [s].  speed: at most [m/s].
    acceleration: at most [m/s²].
    fade: the acceleration falls to 1/e in this time [s], which makes the far part of the path
    straight.
    """

    history: float
    speed: float
    acceleration: float
    fade: float


class SceneIndex(NamedTuple):
    """Arrays of a scene's v voxels that the broad phase reads.

    keys: (v,) uint64, sorted.
    low, high: (v, 3) int64, least and greatest lattice coordinates of a box around a voxel's
    points. It is the box of the voxel's cell until the voxel's record proves what the index states.
    scene_low, scene_high: (3,) int64, those of all points, as the index states them. They decide
    only what lies outside and which cells exist.
    """

    keys: NDArray[np.uint64]
    low: NDArray[np.int64]
    high: NDArray[np.int64]
    scene_low: NDArray[np.int64]
    scene_high: NDArray[np.int64]


@njit_no_refcount
def find_key(keys, key):
    """Return the row of `key` in sorted keys (v,) uint64, or -1."""
    lo, hi = 0, keys.shape[0]
    while lo < hi:
        mid = (lo + hi) // 2
        if keys[mid] < key:
            lo = mid + 1
        else:
            hi = mid
    return lo if lo < keys.shape[0] and keys[lo] == key else -1


@njit_no_refcount
def grid_low(scene_low, voxel_steps):
    """Return the lowest lattice coordinate along an axis of the grid cells that hold points.

    float64, exact.
    """
    return np.float64(scene_low // voxel_steps * voxel_steps)


@njit_no_refcount
def grid_high(scene_high, voxel_steps):
    """Return the highest lattice coordinate along an axis of the grid cells that hold points.

    float64, exact.
    """
    return np.float64((scene_high // voxel_steps + 1) * voxel_steps - 1)


@njit_no_refcount
def _limit(vector, most):
    """Shorten a vector (3,) to a length of at most `most`."""
    length = math.sqrt(vector[0] ** 2 + vector[1] ** 2 + vector[2] ** 2)
    if length > most:
        for k in range(3):
            vector[k] *= most / length


@nb.njit(nogil=True, cache=True)
def fit_motion(poses, limits):
    """Fit velocity [m/s] and acceleration [m/s²], (3,) each, at the last of poses (h, 4).

    A pose: time [s], position [m]; h >= 1. Least squares of p + v t + a t²/2 over the last
    `limits.history` seconds, with v and a drawn towards 0 by SCATTER over USUAL_*. For one pose, or
    poses at one time, both are 0.
    """
    last = poses.shape[0] - 1
    s0, s1, s2, s3, s4 = 0.0, 0.0, 0.0, 0.0, 0.0
    right = np.zeros((3, 3))
    for i in range(last + 1):
        t = poses[i, 0] - poses[last, 0]
        if t < -limits.history or t > 0.0:
            continue
        h = t * t / 2
        s0, s1, s2, s3, s4 = s0 + 1.0, s1 + t, s2 + t * t, s3 + t * h, s4 + h * h
        for k in range(3):
            # Relative to the last position: no precision is lost far from the origin.
            away = poses[i, 1 + k] - poses[last, 1 + k]
            right[0, k] += away
            right[1, k] += away * t
            right[2, k] += away * h
    # Normal equations [[s0, s1, s2/2], [s1, s2, s3], [s2/2, s3, s4]], the position eliminated.
    m11 = s2 - s1 * s1 / s0 + (SCATTER / USUAL_SPEED) ** 2
    m12 = s3 - s1 * s2 / 2 / s0
    m22 = s4 - s2 * s2 / 4 / s0 + (SCATTER / USUAL_ACCELERATION) ** 2
    velocity, acceleration = np.empty(3), np.empty(3)
    determinant = m11 * m22 - m12 * m12
    for k in range(3):
        r1 = right[1, k] - s1 / s0 * right[0, k]
        r2 = right[2, k] - s2 / 2 / s0 * right[0, k]
        velocity[k] = (m22 * r1 - m12 * r2) / determinant
        acceleration[k] = (m11 * r2 - m12 * r1) / determinant
    _limit(velocity, limits.speed)
    _limit(acceleration, limits.acceleration)
    return velocity, acceleration


@nb.njit(nogil=True, cache=True)
def predict_path(poses, limits, seconds, path):
    """Write predicted positions from the last pose to `seconds` after it into path (m + 1, 3) [m].

    The times are evenly spaced; m >= 1. The acceleration fades (`PredictionLimits`) and never makes
    the user faster than `limits.speed`; the path is therefore at most speed * seconds long. With
    seconds of 0 or less, the user stands still.
    """
    last, pieces = poses.shape[0] - 1, path.shape[0] - 1
    velocity, acceleration = fit_motion(poses, limits)
    now = np.empty(3)
    for k in range(3):
        path[0, k] = poses[last, 1 + k]
    step = max(seconds, 0.0) / pieces
    for i in range(pieces):
        # The speed at the middle of a piece represents the whole piece.
        gained = limits.fade * (1.0 - math.exp(-(i + 0.5) * step / limits.fade))
        for k in range(3):
            now[k] = velocity[k] + acceleration[k] * gained
        _limit(now, limits.speed)
        for k in range(3):
            path[i + 1, k] = path[i, k] + now[k] * step


@njit_no_refcount
def _square_gap(path, i, along, low, high):
    """Return the squared distance of a point of piece i from the box [low, high], and its slope.

    along: position on the piece, in [0, 1].  low, high: (3,).
    """
    square, slope = 0.0, 0.0
    for k in range(3):
        step = path[i + 1, k] - path[i, k]
        x = path[i, k] + along * step
        gap = min(x - low[k], 0.0) + max(x - high[k], 0.0)
        square += gap * gap
        slope += gap * step
    return square, slope


@njit_no_refcount
def first_touch(path, i, low, high, reach):
    """Return when a ball first touches a box as it moves along piece i: in [0, 1], or -1 if never.

    reach: of the ball. The moment is never late. The distance is convex along a piece; its minimum
    is where the slope changes sign.
    """
    most = reach * reach
    square, slope = _square_gap(path, i, 0.0, low, high)
    if square <= most:
        return 0.0
    if slope >= 0.0:
        return -1.0
    least, slope = _square_gap(path, i, 1.0, low, high)
    near = 1.0
    if slope > 0.0:
        before = 0.0
        for _ in range(NEAREST_HALVINGS):
            middle = (before + near) / 2
            square, slope = _square_gap(path, i, middle, low, high)
            least = min(least, square)
            if slope > 0.0:
                near = middle
            else:
                before = middle
    if least > most:
        return -1.0
    before, touching = 0.0, near
    for _ in range(TOUCH_HALVINGS):
        middle = (before + touching) / 2
        square, slope = _square_gap(path, i, middle, low, high)
        if square > most:
            before = middle
        else:
            touching = middle
    return before


@njit_no_refcount
def _cells(low, high, index, voxel_steps, first, counts):
    """Find the grid cells of the scene that meet the box [low, high] (3,) [steps].

    Fills first and counts (3,) int64. Returns their number as a float, because it may exceed an
    integer.
    """
    cells = 1.0
    for k in range(3):
        least = max(low[k], grid_low(index.scene_low[k], voxel_steps))
        most = min(high[k], grid_high(index.scene_high[k], voxel_steps))
        if not least <= most:
            return 0.0
        first[k] = np.int64(math.floor(least / voxel_steps))
        counts[k] = np.int64(math.floor(most / voxel_steps)) - first[k] + 1
        cells *= np.float64(counts[k])
    return cells


@njit_no_refcount
def _cell_row(keys, number, first, counts):
    """Return the row of cell `number` of those that `_cells` found, x slowest; -1: no voxel."""
    iz = first[2] + number % counts[2]
    number //= counts[2]
    iy = first[1] + number % counts[1]
    ix = first[0] + number // counts[1]
    return find_key(
        keys, morton_code(np.uint64(ix + KEY_BIAS), np.uint64(iy + KEY_BIAS), np.uint64(iz + KEY_BIAS))
    )


@njit_no_refcount
def _known(rows, count, row):
    """Return whether a row is among the first `count`."""
    at = 0
    while at < count and rows[at] != row:
        at += 1
    return at < count


@njit_no_refcount
def _box_of(index, row, low, high):
    """Fill low and high (3,) float64 with the box of a voxel's points [steps]."""
    for k in range(3):
        low[k], high[k] = np.float64(index.low[row, k]), np.float64(index.high[row, k])


@njit_no_refcount
def _sort_by_need(rows, need, count):
    """Sort the first `count` entries, soonest first, ties by row; they arrive nearly in order."""
    for i in range(1, count):
        row, when = rows[i], need[i]
        j = i - 1
        while j >= 0 and (need[j] > when or (need[j] == when and rows[j] > row)):
            rows[j + 1], need[j + 1] = rows[j], need[j]
            j -= 1
        rows[j + 1], need[j + 1] = row, when


@nb.njit(nogil=True, cache=True)
def rows_ahead(path, reach, ring, index, voxel_steps, rows, need):
    """Find the voxels a ball touches on its path, then those around its start.

    path: (m + 1, 3) float64.  reach: of the ball, inclusive.  ring: how far beyond the reach voxels
    count as around; all [steps].
    Fills rows (n,) int64, each once, and need (n,) float64, soonest first. need is the number of
    pieces of the path until the ball touches, 0 to m. For voxels around the start that it does not
    touch, need is m + 1 + (distance between ball and box) / ring.
    Returns how many, at most n; where there are more, the voxels on the last pieces, or around, are
    omitted.
    """
    pieces, capacity, voxels = path.shape[0] - 1, rows.shape[0], index.keys.shape[0]
    low, high, box_low, box_high = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    first, counts = np.empty(3, np.int64), np.empty(3, np.int64)
    found, looked = 0, 0
    for i in range(pieces + 1):
        around = i == pieces
        if around and ring <= 0.0:
            break
        wide = reach + ring if around else reach
        a, b = (0, 0) if around else (i, i + 1)
        for k in range(3):
            low[k] = min(path[a, k], path[b, k]) - wide
            high[k] = max(path[a, k], path[b, k]) + wide
        cells = _cells(low, high, index, voxel_steps, first, counts)
        listed = cells > voxels  # cheaper to test every voxel than every cell of the grid
        for number in range(int(min(cells, np.float64(voxels)))):
            looked += 1
            if looked > MAX_CELLS or found == capacity:
                break
            row = number if listed else _cell_row(index.keys, number, first, counts)
            if row < 0 or _known(rows, found, row):
                continue
            _box_of(index, row, box_low, box_high)
            if around:
                square, _ = _square_gap(path, 0, 0.0, box_low, box_high)
                if square > wide * wide:
                    continue
                need[found] = pieces + 1 + max(0.0, math.sqrt(square) - reach) / ring
            else:
                touch = first_touch(path, i, box_low, box_high, reach)
                if touch < 0.0:
                    continue
                need[found] = i + touch
            rows[found] = row
            found += 1
    _sort_by_need(rows, need, found)
    return found


@nb.njit(nogil=True, cache=True)
def rows_in_reach(centers, reaches, index, voxel_steps, starts, rows):
    """List the voxels whose box of points each of k balls touches.

    centers: (k, 3), reaches: (k,) float64 [steps]. Fills starts (k + 1,) and rows, int64: those of
    ball i are rows[starts[i]:starts[i + 1]]. Returns their number; those beyond the capacity are
    not written.
    """
    low, high, box_low, box_high = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    first, counts = np.empty(3, np.int64), np.empty(3, np.int64)
    voxels, needed = index.keys.shape[0], 0
    for i in range(centers.shape[0]):
        starts[i] = needed
        for k in range(3):
            low[k], high[k] = centers[i, k] - reaches[i], centers[i, k] + reaches[i]
        cells = _cells(low, high, index, voxel_steps, first, counts)
        listed = cells > voxels
        for number in range(int(min(cells, np.float64(voxels)))):
            row = number if listed else _cell_row(index.keys, number, first, counts)
            if row < 0:
                continue
            _box_of(index, row, box_low, box_high)
            square = 0.0
            for k in range(3):
                gap = max(box_low[k] - centers[i, k], centers[i, k] - box_high[k], 0.0)
                square += gap * gap
            if square <= reaches[i] * reaches[i]:
                if needed < rows.shape[0]:
                    rows[needed] = row
                needed += 1
    starts[centers.shape[0]] = needed
    return needed


@njit_no_refcount
def _square_between(low, high, other_low, other_high):
    """Return the squared distance between two boxes of corners (3,)."""
    square = 0.0
    for k in range(3):
        gap = max(low[k] - other_high[k], other_low[k] - high[k], 0.0)
        square += gap * gap
    return square


@nb.njit(nogil=True, cache=True)
def write_path_distances(paths, rows, index, far):
    """Write the least distance of each voxel's box to the centres of u paths [steps] to far (n,).

    rows: (n,), the voxels.  paths: (u, m, 3) float64. far is inf where u is 0.
    """
    low, high = np.empty(3), np.empty(3)
    users = paths.shape[0]
    boxes, apart = (
        np.empty((users, 2, 3)),
        np.empty(users),
    )  # boxes of whole paths, and the squared distance to each: no centre is nearer
    for u in range(users):
        for k in range(3):
            boxes[u, 0, k], boxes[u, 1, k] = paths[u, :, k].min(), paths[u, :, k].max()
    for j in range(rows.shape[0]):
        _box_of(index, rows[j], low, high)
        first = 0
        for u in range(users):
            apart[u] = _square_between(low, high, boxes[u, 0], boxes[u, 1])
            if apart[u] < apart[first]:
                first = u
        nearest = np.inf
        for turn in range(users):
            u = first if turn == 0 else turn - 1 if turn <= first else turn
            if apart[u] < nearest:
                for i in range(paths.shape[1]):
                    nearest = min(nearest, _square_between(low, high, paths[u, i], paths[u, i]))
        far[j] = math.sqrt(nearest)
