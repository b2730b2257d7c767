"""Avatar under one pose, and the thresholds of one pose: the basis of every descent.

Distances are in lattice steps from the frame, a lattice point near the avatar. Relative to it,
scene coordinates are integers below 2^24 and therefore exact in float32. The placed avatar carries
an error, which every bound includes. Where float32 cannot decide, the integers of NUMERICS.md N5
do: `pair_square`.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ....schemas.kernels import compiling as nb
from .kernel_decorators import njit_no_refcount
from .pose_transform import MAX_REACH_UNITS, largest_term, lattice_to_units, place, to_units
from .voxel_layout import LANES

U32 = 2.0**-24  # half a unit in the last place of 1, float32
# Relative slack of a float32 test: more than 16 U32, while the sums below need at most 8.
SLACK = np.float32(1e-6)
ONE_SLACK = np.float32(1.0 + 2e-6)


class PlacedAvatar(NamedTuple):
    """Avatar under one pose, float32 steps from `frame`, a lattice point; scratch of one call.

    nodes: (4, a): x[], y[], z[], radius[], rounded outward.  lanes: (b, 3, LANES), points.
    stamp: (b,) int64, the pose a block was placed for. Blocks are placed when first reached; most
    are never reached.
    frame: (3,) int64.  shift: (3,) float64, t - O.
    """

    nodes: NDArray[np.float32]
    lanes: NDArray[np.float32]
    stamp: NDArray[np.int64]
    frame: NDArray[np.int64]
    shift: NDArray[np.float64]


class Thresholds(NamedTuple):
    """Thresholds of one pose.

    reach, error: [steps], float32, rounded up.  near, far: squares, float32. A pair below `near`
    touches, a pair above `far` does not.
    units: r_a + r_b + margin, exact units, int64.
    """

    reach: np.float32
    error: np.float32
    near: np.float32
    far: np.float32
    units: np.int64


class ClassThresholds(NamedTuple):
    """Thresholds of one pose by radius class; scratch of one call. As long as `radius_deficit`.

    threshold: reach plus error, float32 [steps].  near, far, units: as in `Thresholds`.
    mask: the number of classes minus one, uint64, for `node_class` and `point_class`.
    """

    threshold: NDArray[np.float32]
    near: NDArray[np.float32]
    far: NDArray[np.float32]
    units: NDArray[np.int64]
    mask: np.uint64


@nb.njit(nogil=True, cache=True)
def make_class_thresholds(deficit):
    """Allocate scratch for the radius classes of `SceneArrays.radius_deficit`."""
    n = deficit.shape[0]
    threshold, near, far = np.empty(n, np.float32), np.empty(n, np.float32), np.empty(n, np.float32)
    return ClassThresholds(threshold, near, far, np.empty(n, np.int64), np.uint64(n - 1))


@njit_no_refcount
def set_class_thresholds(by_class, deficit, units, units_per_step, extent, farthest, voxel_steps):
    """Compute the thresholds of one pose for each radius class.

    Arguments as for `make_thresholds`; `units` is for the largest radius.
    """
    for c in range(deficit.shape[0]):
        thresholds = make_thresholds(units - deficit[c], units_per_step, extent, farthest, voxel_steps)
        by_class.threshold[c] = thresholds.reach + thresholds.error
        by_class.near[c], by_class.far[c], by_class.units[c] = (
            thresholds.near,
            thresholds.far,
            thresholds.units,
        )


@njit_no_refcount
def make_thresholds(units, units_per_step, extent, farthest, voxel_steps):
    """Compute the thresholds for a reach of `units`.

    extent: how far placed avatar points lie from the frame.  farthest: the largest term of a placed
    coordinate.
    Errors of a coordinate difference, in steps:
    - rounding to exact units: half a unit for each of the two points;
    - float32 of the avatar's coordinate: U32 of its size, once relative to the frame and once
      relative to the voxel or block. There a pair in reach is within the larger of voxel and block,
      plus the reach (doubled, so that a pair beyond reach cannot pass as near);
    - float64 rounding far from the origin: 4 half units in the last place for a placed centre, 4
      for a point below it, 1 for the frame, 1 for the lattice point: 10 * 2^-53 of the largest
      term.
    """
    reach = np.float64(units) / units_per_step
    error = (
        1.1 / units_per_step
        + U32 * (extent + 2.0 * (max(65536.0, voxel_steps) + reach))
        + farthest * 2.0**-49
    )
    around = math.sqrt(3.0) * error
    below = max(reach * (1.0 - 2.0 * U32) - around, 0.0)
    above = reach * (1.0 + 2.0 * U32) + around
    near = np.float32(below * below * (1.0 - 8.0 * U32))
    far = np.float32(above * above * (1.0 + 8.0 * U32))
    # One float32 step outward covers the rounding to float32. At 0, nothing is certified near.
    near = np.nextafter(near, np.float32(-1.0)) if below > 0.0 else np.float32(-1.0)
    return Thresholds(
        np.nextafter(np.float32(reach), np.float32(np.inf)),
        np.nextafter(np.float32(around), np.float32(np.inf)),
        near,
        np.nextafter(far, np.float32(np.inf)),
        np.int64(units),
    )


@njit_no_refcount
def place_root(avatar, m, scale, placed, scene):
    """Choose the frame and place an avatar's root; fill placed.frame, shift and node 0.

    Returns (extent, farthest) for `make_thresholds`, of the whole avatar.
    """
    per_step = 1.0 / scene.step
    x, y, z = avatar.center[0, 0], avatar.center[0, 1], avatar.center[0, 2]
    extent = avatar.radius[0] * scale * per_step + 1.0
    for r in range(3):
        placed.shift[r] = m[r, 3] - scene.origin[r]
        root = place(m, placed.shift, r, x, y, z)
        placed.frame[r] = np.int64(np.rint(root * per_step))
        placed.nodes[r, 0] = np.float32((root - np.float64(placed.frame[r]) * scene.step) * per_step)
    placed.nodes[3, 0] = node_reach(avatar.radius[0], scale * per_step, extent)
    return extent, largest_term(m, placed.shift, x, y, z) * per_step + extent


@njit_no_refcount
def node_reach(radius, steps, extent):
    """Return the radius [steps] of a placed node, rounded outward.

    steps: lattice steps a metre of the avatar. The slack of 1e-6 covers the float32 centre, which
    is off by at most U32 of `extent`, and the radius, off by U32 of itself.
    """
    return np.float32(radius * steps * (1.0 + 1e-6) + extent * 1e-6)


@njit_no_refcount
def place_nodes(avatar, m, scale, placed, scene):
    """Place all nodes of an avatar; fill placed.frame, shift and nodes.

    Returns (extent, farthest), as `place_root` does.
    """
    extent, farthest = place_root(avatar, m, scale, placed, scene)
    step = scene.step
    per_step = 1.0 / step
    nodes = placed.nodes
    for r in range(3):
        base = np.float64(placed.frame[r]) * step
        for i in range(1, avatar.center.shape[0]):
            world = place(m, placed.shift, r, avatar.center[i, 0], avatar.center[i, 1], avatar.center[i, 2])
            nodes[r, i] = np.float32((world - base) * per_step)
    for i in range(1, avatar.center.shape[0]):
        nodes[3, i] = node_reach(avatar.radius[i], scale * per_step, extent)
    return extent, farthest


@njit_no_refcount
def place_block(avatar, m, block, placed, scene):
    """Place the points of one leaf node of the avatar, all LANES at once."""
    place_lanes(avatar.points, m, block, placed.lanes, placed.shift, placed.frame, scene.step)


@njit_no_refcount
def place_lanes(points, m, block, lanes, shift, frame, step):
    """Place the points of one leaf node, given the arrays themselves.

    Passing three tuples of arrays, as `place_block` does, takes as long as the work itself.
    """
    per_step = 1.0 / step
    b = np.uint64(block)
    for r in range(3):
        base = np.float64(frame[r]) * step
        m0, m1, m2, along = m[r, 0], m[r, 1], m[r, 2], shift[r]
        for lane in range(LANES):
            j = np.uint64(lane)
            # The formula of placing.place.
            world = ((m0 * points[b, 0, j] + m1 * points[b, 1, j]) + m2 * points[b, 2, j]) + along
            lanes[b, r, j] = np.float32((world - base) * per_step)


@nb.njit(nogil=True, cache=True)
def make_placed(avatar):
    """Allocate scratch for one avatar (not empty); nothing is placed yet."""
    blocks = avatar.points.shape[0]
    return PlacedAvatar(
        np.empty((4, avatar.center.shape[0]), np.float32),
        np.empty((blocks, 3, LANES), np.float32),
        np.full(blocks, -1, np.int64),
        np.empty(3, np.int64),
        np.empty(3, np.float64),
    )


@njit_no_refcount
def pair_square(avatar, m, block, lane, placed, scene, voxel, lane_at, block_at, j):
    """Compute |a - b|^2 of one pair by the definition (NUMERICS.md N5), int64, exact units.

    block, lane: of the avatar's point.  block_at, lane_at, j: of the scan's point in `voxel`, see
    voxel_layout.py.
    Returns -1 where the points are farther apart along an axis than any reach, MAX_REACH_UNITS;
    squares therefore fit 63 bits.
    """
    square = np.int64(0)
    points = avatar.points
    for r in range(3):
        world = place(
            m, placed.shift, r, points[block, 0, lane], points[block, 1, lane], points[block, 2, lane]
        )
        low = scene.coordinates[voxel, r] * scene.voxel_steps + np.int64(scene.ints[block_at + r])
        steps = low + np.int64(scene.halves[lane_at + r * LANES + j])
        difference = to_units(world) - lattice_to_units(steps, scene.units_per_step)
        if abs(difference) > MAX_REACH_UNITS:
            return np.int64(-1)
        square += difference * difference
    return square


@njit_no_refcount
def pair_in_reach(avatar, m, block, lane, placed, scene, voxel, lane_at, block_at, j, units):
    """Return whether one pair is within `units`, tangency included."""
    square = pair_square(avatar, m, block, lane, placed, scene, voxel, lane_at, block_at, j)
    return square >= 0 and square <= units * units
