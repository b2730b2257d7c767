"""Two leaf nodes in five kinds of arithmetic, and as cubes: do they hold a pair in contact, how near are they?

All are plain loops over blocks of LANES points, the last one repeated to the end, so that what differs is the
arithmetic alone. Coordinates are float64 metres from the dataset's origin until a kind makes its own of them.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ....schemas.archive.units import UNITS_PER_METRE
from ....schemas.kernels import compiling as nb
from ...kernels.core.borrowing_kernels import borrowing
from ...kernels.core.pose_transform import lattice_to_units, place, to_units
from ...kernels.core.voxel_layout import LANES

FLOAT32, FLOAT64, CERTIFIED, INTEGERS, FLOAT32_WORLD, CUBES = range(6)
# Where FLOAT32_WORLD has the dataset's origin stand, wherever that is: UTM zone 32, central Europe [m].
MAP_X, MAP_Y = 500_000.0, 5_600_000.0
U32 = 2.0**-24  # half a unit in the last place of 1, float32


class Lanes(NamedTuple):
    """The points of blocks in the three types that kinds use; scratch.

    narrow: (b, 3, LANES) float32, steps from a frame near the avatar, or metres on the map.  wide: float64 [m].
    units: int64, exact units.  stamp: (b,) int64, the pose that a block was placed for.
    """

    narrow: NDArray[np.float32]
    wide: NDArray[np.float64]
    units: NDArray[np.int64]
    stamp: NDArray[np.int64]


class Lattice(NamedTuple):
    """Where lattice steps are. origin: (3,) float64 world [m].  step: [m].  units_per_step: exact units."""

    origin: NDArray[np.float64]
    step: float
    units_per_step: float


class Limits(NamedTuple):
    """The thresholds of one pose. units: r_a + r_b, exact.  reach: the same [m], not rounded.

    square: of the reach in `narrow`'s unit.  near, far: what float32 certifies, squares [steps].
    """

    units: int
    reach: float
    square: np.float32
    near: np.float32
    far: np.float32


@nb.njit(nogil=True, cache=True)
def make_lanes(blocks):
    """Scratch for so many blocks, none placed."""
    shape = (blocks, 3, LANES)
    return Lanes(
        np.empty(shape, np.float32), np.empty(shape), np.empty(shape, np.int64), np.full(blocks, -1, np.int64)
    )


@borrowing
def make_limits(kind, units, reach, extent, farthest, lattice):
    """The thresholds of one pose. units, reach: see Limits.  extent: how far the avatar's points are from the frame,
    farthest: from the origin [steps].

    The error of a difference of float32 coordinates, in steps: both points' rounding to exact units, half a unit
    each; the float32 of the avatar's coordinate, U32 of its size, and of the difference, of a pair in reach; float64
    sums, some 2^-53 of the farthest. Scene coordinates from the frame are whole numbers, exact below 2^24.
    """
    steps = np.float64(units) / lattice.units_per_step
    error = 1.1 / lattice.units_per_step + U32 * (extent + 2.0 * steps + 1.0) + farthest * 2.0**-49
    around = math.sqrt(3.0) * error
    below, above = steps * (1.0 - 2.0 * U32) - around, steps * (1.0 + 2.0 * U32) + around
    near = np.float32(below * below * (1.0 - 9.0 * U32)) if below > 0.0 else np.float32(-1.0)
    far = np.float32(above * above * (1.0 + 9.0 * U32))
    plain = reach if kind == FLOAT32_WORLD else reach / lattice.step
    return Limits(units, reach, np.float32(plain) * np.float32(plain), near, far)


@borrowing
def place_points(kind, points, m, shift, frame, block, lattice, lanes):
    """Place a block of the avatar, points (b, 3, LANES) float64 [m], as `kind` has it. frame: (3,) int64 lattice."""
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


@borrowing
def take_points(kind, low, steps, frame, block, lattice, lanes):
    """Make block 0 of `lanes` of a scene's block, as `kind` has it. low: (b, 3) int64, steps: (b, 3, LANES) uint16."""
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


@borrowing
def _any_within(one, i, other, square):
    """Whether point i of one (3, LANES) is within the root of `square` of any of other (3, LANES)."""
    x, y, z = one[0, i], one[1, i], one[2, i]
    touched = False
    for j in range(LANES):
        dx, dy, dz = other[0, j] - x, other[1, j] - y, other[2, j] - z
        touched |= dx * dx + dy * dy + dz * dz <= square
    return touched


@borrowing
def _within(one, keep, other, square):
    """Whether any of the points marked in keep (LANES,) is, see `_any_within`; floats of either width, or integers."""
    for i in range(LANES):
        if not keep[i]:
            continue
        if _any_within(one, i, other, square):
            return True
    return False


@borrowing
def _cubes_meet(one, keep, other, reach):
    """Whether cubes whose half sides add up to `reach` meet: of one those in keep, any of other, exact units."""
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


@borrowing
def _settle(m, shift, points, block, i, low, steps, at, lattice, body, scene, limits):
    """Point i, which float32 leaves open or near: whether any pair of it is near, or by the integers in contact."""
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


@borrowing
def blocks_touch(kind, m, shift, points, block, keep, low, steps, at, lattice, placed, taken, limits):
    """Whether a placed block of the avatar holds, among the points in keep (LANES,), one in contact with a point of the
    scene's block `at`, which `taken` holds; as `kind` computes it."""
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


@borrowing
def _least_square(one, i, other):
    """The least square of point i of one (3, LANES) to any of other (3, LANES)."""
    x, y, z = one[0, i], one[1, i], one[2, i]
    dx, dy, dz = other[0, 0] - x, other[1, 0] - y, other[2, 0] - z
    least = dx * dx + dy * dy + dz * dz
    for j in range(1, LANES):
        dx, dy, dz = other[0, j] - x, other[1, j] - y, other[2, j] - z
        least = min(least, dx * dx + dy * dy + dz * dz)
    return least


@borrowing
def _cube_gap(one, i, other, reach):
    """Least gap [exact units] of cubes whose half sides add up to `reach`, negative where they overlap."""
    least = np.inf
    for j in range(LANES):
        gaps, inside = 0.0, -np.inf
        for r in range(3):
            gap = np.float64(abs(other[r, j] - one[r, i]) - reach)
            inside = max(inside, gap)
            gaps += max(gap, 0.0) ** 2
        least = min(least, math.sqrt(gaps) if inside > 0.0 else inside)
    return least


@borrowing
def blocks_gap(kind, block, count, lattice, placed, taken, limits):
    """The least signed distance [m] of spheres (of cubes: CUBES) in two blocks, as `kind` computes it."""
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
