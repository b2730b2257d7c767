"""Placement of two avatars, one moving along a chord and one standing.

Both are placed relative to the dataset's origin, in float64.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..core.kernel_decorators import njit_inlined, njit_no_refcount
from ..core.placed_avatar import Avatar, place
from ..core.scene_arrays import LANES
from ..motion.screw_motion import ScrewMotion
from .body_pairs import STACK, STRETCH


class BodyScratch(NamedTuple):
    """Scratch of one thread, for avatars of limited size; see `make_body_scratch`.

    stack: (s, 2) int64, pairs of nodes still to examine.
    moving: (8, nodes): a node's centre at the beginning, its displacement, 1 / its square, its
    radius.
    paths: (blocks, 7, LANES), the same of points, without a radius.
    standing: (4, nodes), centres and radii.  lanes: (blocks, 3, LANES), points.
    stamps: (2, blocks) int64: the chord and the body that a block was placed for.
    turns: (2,) int64, chords and bodies so far.
    keep: (LANES,).
    ends: (2, 4, 4), shifts: (3, 3): the poses of a chord's ends, their translations and that of the
    standing avatar.
    gap, displacement: (3,).
    first: (2,), when the first contact is possible, and when a contact is certain.
    pair: (4,) int64, block and lane of either point.
    counters: (2,), node visits, point tests.
    """

    stack: NDArray[np.int64]
    moving: NDArray[np.float64]
    paths: NDArray[np.float64]
    standing: NDArray[np.float64]
    lanes: NDArray[np.float64]
    stamps: NDArray[np.int64]
    turns: NDArray[np.int64]
    keep: NDArray[np.bool_]
    ends: NDArray[np.float64]
    shifts: NDArray[np.float64]
    gap: NDArray[np.float64]
    displacement: NDArray[np.float64]
    first: NDArray[np.float64]
    pair: NDArray[np.int64]
    counters: NDArray[np.int64]


def make_body_scratch(nodes: int, blocks: int) -> BodyScratch:
    """Allocate scratch for `sweep_bodies`.

    nodes, blocks: the most that an avatar has.
    """
    return BodyScratch(
        np.empty((STACK, 2), np.int64), np.empty((8, nodes)), np.empty((blocks, 7, LANES)), np.empty((4, nodes)),
        np.empty((blocks, 3, LANES)), np.full((2, blocks), -1, np.int64), np.zeros(2, np.int64),
        np.empty(LANES, np.bool_), np.empty((2, 4, 4)), np.empty((3, 3)), np.empty(3), np.empty(3), np.empty(2),
        np.zeros(4, np.int64), np.zeros(2, np.int64),
    )  # fmt: skip


class BodySweep(NamedTuple):
    """One motion against one body.

    motion: ScrewMotion of avatar a.  pose: (4, 4) of b.  units: both radii plus the margin.
    error: of a distance of two placed centres, and of their rounding to units [m].
    stop: (1,) int64, a stop flag.
    """

    motion: ScrewMotion
    a: Avatar
    b: Avatar
    pose: NDArray[np.float64]
    units: np.int64
    error: float
    scratch: BodyScratch
    stop: NDArray[np.int64]


class BodyChord(NamedTuple):
    """Straight approximation of a motion over one interval from t0 on (body_sweep.py).

    inner, outer: U - band, U + band, exact units, where U is `BodySweep.units`.  threshold: outer
    with the error [m].
    final: whether halving the interval is useless.
    """

    t0: float
    inner: float
    outer: float
    threshold: float
    final: bool


@njit_inlined
def least_square(gx, gy, gz, wx, wy, wz, inverse, latest):
    """Return the least square of a vector that moves from g to g + latest w; inverse: 1 / w^2."""
    t = min(max(-(gx * wx + gy * wy + gz * wz) * inverse, 0.0), latest)
    ex, ey, ez = gx + t * wx, gy + t * wy, gz + t * wz
    return ex * ex + ey * ey + ez * ez


@njit_no_refcount
def inverse_square(x, y, z):
    """Return 1 / (x^2 + y^2 + z^2), or 0 where the sum is too small to divide by."""
    square = x * x + y * y + z * z
    return 1.0 / square if square > 1e-200 else 0.0


@njit_no_refcount
def place_moving(sweep, block):
    """Place the points of a leaf node of the moving avatar at both ends of a chord."""
    paths, ends, shifts = sweep.scratch.paths, sweep.scratch.ends, sweep.scratch.shifts
    points = sweep.a.points
    for r in range(3):
        for k in range(LANES):
            x, y, z = points[block, 0, k], points[block, 1, k], points[block, 2, k]
            begin = place(ends[0], shifts[0], r, x, y, z)
            paths[block, r, k] = begin
            paths[block, 3 + r, k] = place(ends[1], shifts[1], r, x, y, z) - begin
    for k in range(LANES):
        paths[block, 6, k] = inverse_square(paths[block, 3, k], paths[block, 4, k], paths[block, 5, k])


@njit_no_refcount
def place_standing(sweep, block):
    """Place the points of a leaf node of the standing avatar."""
    lanes, points = sweep.scratch.lanes, sweep.b.points
    for r in range(3):
        for k in range(LANES):
            x, y, z = points[block, 0, k], points[block, 1, k], points[block, 2, k]
            lanes[block, r, k] = place(sweep.pose, sweep.scratch.shifts[2], r, x, y, z)


@njit_no_refcount
def place_moving_nodes(sweep, count):
    """Place the first `count` nodes of the moving avatar at both ends of a chord."""
    moving, center, ends, shifts = (
        sweep.scratch.moving,
        sweep.a.center,
        sweep.scratch.ends,
        sweep.scratch.shifts,
    )
    for i in range(count):
        x, y, z = center[i, 0], center[i, 1], center[i, 2]
        for r in range(3):
            begin = place(ends[0], shifts[0], r, x, y, z)
            moving[r, i] = begin
            moving[3 + r, i] = place(ends[1], shifts[1], r, x, y, z) - begin
        moving[6, i] = inverse_square(moving[3, i], moving[4, i], moving[5, i])
        moving[7, i] = sweep.a.radius[i] * STRETCH


@njit_no_refcount
def place_standing_nodes(sweep, count):
    """Place the first `count` nodes of the standing avatar."""
    standing, center = sweep.scratch.standing, sweep.b.center
    for j in range(count):
        x, y, z = center[j, 0], center[j, 1], center[j, 2]
        for r in range(3):
            standing[r, j] = place(sweep.pose, sweep.scratch.shifts[2], r, x, y, z)
        standing[3, j] = sweep.b.radius[j] * STRETCH
