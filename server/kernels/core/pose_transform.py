"""Poses: which ones are valid, and where a pose places a point. The one formula of NUMERICS.md N5.

A placed coordinate is ((r0 p0 + r1 p1) + r2 p2) + (t - O), float64, in this order, without
contraction. Multiplied by 2^26 (exact) and rounded half to even, it is the integer that decides.
Compiled and interpreted code agree bit for bit.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ....schemas.archive.units import UNITS_PER_METRE
from ....schemas.archive.voxel_grid import MAX_COORDINATE
from .kernel_decorators import njit_no_refcount
from .stop_flag_checks import stopped

# Poses checked between two checks of the stop flag.
POSES_AT_ONCE = 64

SIMILARITY_TOLERANCE = 1e-9  # NUMERICS.md N6
SMALLEST_SCALE, LARGEST_SCALE = 1e-3, 1e3

# Distances are compared in exact units whose squares must fit 63 bits (NUMERICS.md N5): 16 m.
MAX_REACH_UNITS = 1 << 30
# Coordinates near a pose must be exact in float32, with a bit to spare (collide_poses.py).
MAX_FRAME_STEPS = 1 << 23

VALID, NOT_FINITE, BAD_LAST_ROW, MIRRORED, SHEARED, BAD_SCALE, TOO_FAR, LONG_REACH, LARGE_AVATAR = range(9)


class Avatar(NamedTuple):
    """BSH of an avatar as the kernels read it; a nodes, b leaf nodes.

    center: (a, 3), radius: (a,) float64, avatar frame [m], rounded outward.
    first: (a,) int32, first child, or ~block for a leaf node.  count: (a,) int32, children or
    points.
    points: (b, 3, LANES) float64 [m], as the client sent them, the last one repeated.
    front: (4, f) float64, x[], y[], z[], radius[] of one level of the tree, see avatar_front.py.
    front_first: its first node.
    """

    center: NDArray[np.float64]
    radius: NDArray[np.float64]
    first: NDArray[np.int32]
    count: NDArray[np.int32]  # type: ignore[assignment]  # hides tuple.count, which nobody calls
    points: NDArray[np.float64]
    front: NDArray[np.float64]
    front_first: int


@njit_no_refcount
def check_poses(poses, node_radius, radius, other_units, scene, scales, units):
    """Check that poses (k, 4, 4) float64 are similarities (N6); compute scales and reaches.

    Writes scales (k,) and units (k,) int64, the reach of each pose in exact units.
    node_radius: (a,) of the avatar's nodes, root first, may be empty.  radius: of its points [m].
    other_units: the scan's radius plus the margin, exact units.  scene: SceneArrays.
    A scale within SIMILARITY_TOLERANCE of 1 becomes 1, so that the rounding of a rigid pose changes
    no radius.
    Returns (GOOD, 0, 0.0), or the first fault, its pose and the value found. Once scene.stop is
    set, it also returns (GOOD, 0, 0.0), with the output incomplete: a caller that has a stop flag
    must check it after this call.
    """
    for i in range(poses.shape[0]):
        if i % POSES_AT_ONCE == 0 and stopped(scene.stop):
            break
        m = poses[i]
        for r in range(4):
            for c in range(4):
                if not math.isfinite(m[r, c]):
                    return NOT_FINITE, i, m[r, c]
        if m[3, 0] != 0.0 or m[3, 1] != 0.0 or m[3, 2] != 0.0 or m[3, 3] != 1.0:
            return BAD_LAST_ROW, i, m[3, 3]
        for r in range(3):
            if not abs(m[r, 3]) <= MAX_COORDINATE:
                return TOO_FAR, i, m[r, 3]
            for c in range(3):
                if not abs(m[r, c]) <= 2.0 * LARGEST_SCALE:
                    return BAD_SCALE, i, m[r, c]
        minor0 = m[1, 1] * m[2, 2] - m[1, 2] * m[2, 1]
        minor1 = m[1, 0] * m[2, 2] - m[1, 2] * m[2, 0]
        minor2 = m[1, 0] * m[2, 1] - m[1, 1] * m[2, 0]
        volume = m[0, 0] * minor0 - m[0, 1] * minor1 + m[0, 2] * minor2
        square = 0.0
        for r in range(3):
            for c in range(3):
                square += m[r, c] * m[r, c]
        square /= 3.0
        scale = math.sqrt(square)
        # A scale of 1000 is valid, even if its square root is rounded up.
        least = SMALLEST_SCALE * (1.0 - SIMILARITY_TOLERANCE)
        if not least <= scale <= LARGEST_SCALE * (1.0 + SIMILARITY_TOLERANCE):
            return BAD_SCALE, i, scale
        worst = 0.0
        for a in range(3):
            for b in range(3):
                dot = m[0, a] * m[0, b] + m[1, a] * m[1, b] + m[2, a] * m[2, b]
                worst = max(worst, abs(dot - (square if a == b else 0.0)))
        # Factor 2: an entry that is off by the tolerance changes a product of two entries by twice
        # that.
        if worst > 2.0 * SIMILARITY_TOLERANCE * square:
            return SHEARED, i, worst / square
        if volume < 0.0:
            return MIRRORED, i, volume
        scales[i] = 1.0 if abs(scale - 1.0) <= SIMILARITY_TOLERANCE else scale
        reach = np.rint(scales[i] * radius * UNITS_PER_METRE) + float(other_units)
        if reach > MAX_REACH_UNITS:
            return LONG_REACH, i, reach / UNITS_PER_METRE
        units[i] = np.int64(reach)
        extent = reach / UNITS_PER_METRE + (node_radius[0] * scales[i] if node_radius.shape[0] else 0.0)
        if extent / scene.step + scene.voxel_steps > MAX_FRAME_STEPS:
            return LARGE_AVATAR, i, extent
    return VALID, 0, 0.0


@njit_no_refcount
def place(m, shift, r, x, y, z):
    """Return coordinate r of an avatar point placed by pose m, from the dataset's origin [m].

    shift: t - O (3,).
    """
    return ((m[r, 0] * x + m[r, 1] * y) + m[r, 2] * z) + shift[r]


@njit_no_refcount
def largest_term(m, shift, x, y, z):
    """Return the largest sum of the absolute values of the terms of a placed coordinate [m].

    2^-50 of it bounds the rounding of `place` for this point and for one next to it, also where
    large terms cancel.
    """
    largest = 0.0
    for r in range(3):
        size = abs(m[r, 0] * x) + abs(m[r, 1] * y) + abs(m[r, 2] * z) + abs(shift[r])
        largest = max(largest, size)
    return largest


@njit_no_refcount
def to_units(metres):
    """Convert a placed coordinate to exact units: times 2^26, half to even, int64."""
    return np.int64(np.rint(metres * UNITS_PER_METRE))


@njit_no_refcount
def lattice_to_units(steps, units_per_step):
    """Convert a lattice coordinate to exact units: one float64 product, half to even, int64."""
    return np.int64(np.rint(np.float64(steps) * units_per_step))
