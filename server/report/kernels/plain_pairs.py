"""Contact and distance tests of two leaf nodes, in five kinds of arithmetic and with cubes.

All are plain loops over blocks of LANES points, padded with the last point: only the arithmetic
differs. Coordinates are float64 metres from the dataset's origin until a kind converts them.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ....schemas.archive.units import UNITS_PER_METRE
from ....schemas.kernels import compiling as nb
from ...kernels.core.kernel_decorators import njit_no_refcount
from ...kernels.core.placed_avatar import lattice_to_units, place, to_units
from ...kernels.core.scene_arrays import LANES

FLOAT32, FLOAT64, CERTIFIED, INTEGERS, FLOAT32_WORLD, CUBES = range(6)
# Position to which FLOAT32_WORLD moves the dataset's origin [m]: UTM zone 32, central Europe.
MAP_X, MAP_Y = 500_000.0, 5_600_000.0
U32 = 2.0**-24  # half a unit in the last place of 1, float32


class Lanes(NamedTuple):
    """Working memory for points of blocks, in the three types that the kinds use.

    narrow: (b, 3, LANES) float32, steps from a frame near the avatar, or map coordinates [m].
    wide: (b, 3, LANES) float64 [m].  units: (b, 3, LANES) int64, exact units.
    stamp: (b,) int64, the pose for which a block was transformed.
    """

    narrow: NDArray[np.float32]
    wide: NDArray[np.float64]
    units: NDArray[np.int64]
    stamp: NDArray[np.int64]


class Lattice(NamedTuple):
    """Lattice of a dataset.

    origin: (3,) float64, world frame [m].  step: [m].  units_per_step: exact units.
    """

    origin: NDArray[np.float64]
    step: float
    units_per_step: float


class Limits(NamedTuple):
    """Thresholds of one pose.

    units: r_a + r_b in exact units.  reach: the same [m], not rounded.
    square: square of the reach in the unit of `narrow`.
    near, far: squares of distances [steps²] up to which float32 certifies contact, and above which
    it certifies that there is none.
    """

    units: int
    reach: float
    square: np.float32
    near: np.float32
    far: np.float32


@nb.njit(nogil=True, cache=True)
def make_lanes(blocks):
    """Allocate working memory for a number of blocks, marked as not transformed."""
    shape = (blocks, 3, LANES)
    return Lanes(
        np.empty(shape, np.float32), np.empty(shape), np.empty(shape, np.int64), np.full(blocks, -1, np.int64)
    )


@njit_no_refcount
def make_limits(kind, units, reach, extent, farthest, lattice):
    """Return the thresholds of one pose.

    units, reach: see Limits.  extent, farthest: greatest distance of the avatar's points from the
    frame and from the origin [steps].

    The error of a difference of float32 coordinates, in steps, has these parts: the rounding of
    both points to exact units, half a unit each; the float32 rounding of the avatar's coordinate,
    U32 of its size, and of the difference, for a pair in reach; float64 sums, some 2^-53 of the
    farthest. Scene coordinates relative to the frame are integers, exact below 2^24.
    """
    steps = np.float64(units) / lattice.units_per_step
    error = 1.1 / lattice.units_per_step + U32 * (extent + 2.0 * steps + 1.0) + farthest * 2.0**-49
    around = math.sqrt(3.0) * error
    below, above = steps * (1.0 - 2.0 * U32) - around, steps * (1.0 + 2.0 * U32) + around
    near = np.float32(below * below * (1.0 - 9.0 * U32)) if below > 0.0 else np.float32(-1.0)
    far = np.float32(above * above * (1.0 + 9.0 * U32))
    plain = reach if kind == FLOAT32_WORLD else reach / lattice.step
    return Limits(units, reach, np.float32(plain) * np.float32(plain), near, far)


@njit_no_refcount
def place_points(kind, points, m, shift, frame, block, lattice, lanes):
    """Transform a block of the avatar to the pose, in the coordinates of `kind`.

    points: (b, 3, LANES) float64 [m].  frame: (3,) int64 [lattice steps].
    """
    for r in range(3):
        base = np.float64(frame[r]) * lattice.step
        offset = MAP_X if r == 0 else MAP_Y if r == 1 else 0.0
        for j in range(LANES):
            world = place(m, shift, r, points[block, 0, j], points[block, 1, j], points[block, 2, j])
            if kind in (FLOAT32, CERTIFIED):
                lanes.narrow[block, r, j] = np.float32((world - base) / lattice.step)
            elif kind == FLOAT32_WORLD:
                lanes.narrow[block, r, j] = np.float32(world + offset)
            elif kind == FLOAT64:
                lanes.wide[block, r, j] = world
            else:
                lanes.units[block, r, j] = to_units(world)


@njit_no_refcount
def take_points(kind, low, steps, frame, block, lattice, lanes):
    """Convert a scene's block to the coordinates of `kind`, in block 0 of `lanes`.

    low: (b, 3) int64.  steps: (b, 3, LANES) uint16.
    """
    for r in range(3):
        base, offset = low[block, r], MAP_X if r == 0 else MAP_Y if r == 1 else 0.0
        for j in range(LANES):
            step = base + np.int64(steps[block, r, j])
            if kind in (FLOAT32, CERTIFIED):
                lanes.narrow[0, r, j] = np.float32(step - frame[r])
            elif kind == FLOAT32_WORLD:
                lanes.narrow[0, r, j] = np.float32(np.float64(step) * lattice.step + offset)
            elif kind == FLOAT64:
                lanes.wide[0, r, j] = np.float64(step) * lattice.step
            else:
                lanes.units[0, r, j] = lattice_to_units(step, lattice.units_per_step)


@njit_no_refcount
def _any_within(one, i, other, square):
    """Return whether point i of `one` is within sqrt(square) of a point of `other`, (3, LANES)."""
    x, y, z = one[0, i], one[1, i], one[2, i]
    touched = False
    for j in range(LANES):
        dx, dy, dz = other[0, j] - x, other[1, j] - y, other[2, j] - z
        touched |= dx * dx + dy * dy + dz * dz <= square
    return touched


@njit_no_refcount
def _within(one, keep, other, square):
    """Return whether `_any_within` holds for a point marked in keep (LANES,), float or integer."""
    for i in range(LANES):
        if not keep[i]:
            continue
        if _any_within(one, i, other, square):
            return True
    return False


@njit_no_refcount
def _cubes_meet(one, keep, other, reach):
    """Return whether a cube of `one` marked in keep meets a cube of `other` [exact units].

    reach: sum of the half sides of two cubes.
    """
    for i in range(LANES):
        if not keep[i]:
            continue
        x, y, z = one[0, i], one[1, i], one[2, i]
        touched = False
        for j in range(LANES):
            dx, dy, dz = abs(other[0, j] - x), abs(other[1, j] - y), abs(other[2, j] - z)
            touched |= (dx <= reach) & (dy <= reach) & (dz <= reach)
        if touched:
            return True
    return False


@njit_no_refcount
def _settle(m, shift, points, block, i, low, steps, at, lattice, body, scene, limits):
    """Decide whether point i is in contact with a point of the scene's block.

    A pair within `near` is in contact. A pair between `near` and `far` is decided in integers.
    """
    x, y, z = body[0, i], body[1, i], body[2, i]
    for j in range(LANES):
        dx, dy, dz = scene[0, j] - x, scene[1, j] - y, scene[2, j] - z
        square = dx * dx + dy * dy + dz * dz
        if square <= limits.near:
            return True
        if square <= limits.far:
            exact = np.int64(0)
            for r in range(3):
                world = place(m, shift, r, points[block, 0, i], points[block, 1, i], points[block, 2, i])
                step = low[at, r] + np.int64(steps[at, r, j])
                apart = to_units(world) - lattice_to_units(step, lattice.units_per_step)
                exact += apart * apart
            if exact <= limits.units * limits.units:
                return True
    return False


@njit_no_refcount
def blocks_touch(kind, m, shift, points, block, keep, low, steps, at, lattice, placed, taken, limits):
    """Return whether a marked point of an avatar block is in contact with the scene's block `at`.

    keep: (LANES,), marks the points.
    placed: holds the avatar's block.  taken: holds the scene's block.  kind: the arithmetic.
    """
    if kind in (FLOAT32, FLOAT32_WORLD):
        return _within(placed.narrow[block], keep, taken.narrow[0], limits.square)
    if kind == FLOAT64:
        return _within(placed.wide[block], keep, taken.wide[0], limits.reach * limits.reach)
    if kind == INTEGERS:
        return _within(placed.units[block], keep, taken.units[0], limits.units * limits.units)
    if kind == CUBES:
        return _cubes_meet(placed.units[block], keep, taken.units[0], limits.units)
    body, scene = placed.narrow[block], taken.narrow[0]
    for i in range(LANES):
        if (
            keep[i]
            and _any_within(body, i, scene, limits.far)
            and _settle(m, shift, points, block, i, low, steps, at, lattice, body, scene, limits)
        ):
            return True
    return False


@njit_no_refcount
def _least_square(one, i, other):
    """Return the least squared distance of point i of `one` to points of `other`, (3, LANES)."""
    x, y, z = one[0, i], one[1, i], one[2, i]
    dx, dy, dz = other[0, 0] - x, other[1, 0] - y, other[2, 0] - z
    least = dx * dx + dy * dy + dz * dz
    for j in range(1, LANES):
        dx, dy, dz = other[0, j] - x, other[1, j] - y, other[2, j] - z
        least = min(least, dx * dx + dy * dy + dz * dz)
    return least


@njit_no_refcount
def _cube_gap(one, i, other, reach):
    """Return the least distance of cube i of `one` to the cubes of `other` [exact units].

    It is negative if they overlap.
    reach: sum of the half sides of two cubes.
    """
    least = np.inf
    for j in range(LANES):
        gaps, inside = 0.0, -np.inf
        for r in range(3):
            gap = np.float64(abs(other[r, j] - one[r, i]) - reach)
            inside = max(inside, gap)
            gaps += max(gap, 0.0) ** 2
        least = min(least, math.sqrt(gaps) if inside > 0.0 else inside)
    return least


@njit_no_refcount
def blocks_gap(kind, block, count, lattice, placed, taken, limits):
    """Return the least signed distance [m] of spheres, or for CUBES of cubes, in two blocks.

    kind: the arithmetic.
    """
    least = np.inf
    for i in range(count):
        if kind in (FLOAT32, CERTIFIED):
            square = np.float32(_least_square(placed.narrow[block], i, taken.narrow[0]))
            gap = np.float64(np.sqrt(square)) * lattice.step - limits.reach
        elif kind == FLOAT32_WORLD:
            square = np.float32(_least_square(placed.narrow[block], i, taken.narrow[0]))
            gap = np.float64(np.sqrt(square)) - limits.reach
        elif kind == FLOAT64:
            gap = math.sqrt(_least_square(placed.wide[block], i, taken.wide[0])) - limits.reach
        elif kind == INTEGERS:
            exact = np.float64(_least_square(placed.units[block], i, taken.units[0]))
            gap = (math.sqrt(exact) - limits.units) / UNITS_PER_METRE
        else:
            gap = _cube_gap(placed.units[block], i, taken.units[0], limits.units) / UNITS_PER_METRE
        least = min(least, gap)
    return least
