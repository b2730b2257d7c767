"""Plain descent of two hierarchies with exchangeable node and leaf tests, for fair comparisons.

The descent is scalar and depth-first, as in figures 5 and 6 of [Fig12], with the correction
described in server/kernels/collide/collide_poses.py: a leaf is never opened, and of two inner nodes the
one with the larger sphere is. Node tests are in float64, inclusive and widened by SLACK. Therefore
no test loses a contact, and a bounding volume only changes the number of node pairs that are not
excluded.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ....schemas.archive.units import UNITS_PER_METRE
from ....schemas.kernels import compiling as nb
from ...kernels.core.kernel_decorators import njit_no_refcount
from ...kernels.core.placed_avatar import place
from ...kernels.core.scene_arrays import LANES
from .plain_pairs import (
    CUBES,
    Lanes,
    blocks_gap,
    blocks_touch,
    make_lanes,
    make_limits,
    place_points,
    take_points,
)

SPHERE, SLAB, BOX, SPHERE_AND_BOX = range(4)
# Widening of node tests [m]: covers the rounding of two points to exact units, and of float64 sums
# up to 10^7 m.
SLACK = 4.0 / UNITS_PER_METRE
# Size of the stack. Opening a pair pushes one pair per child, at most 16: two trees of 80 levels
# fit.
STACK = 2 * 80 * 15 + 16
CUBE_REACH = math.sqrt(3.0)  # distance of a cube's corner from its centre, in half sides


class Body(NamedTuple):
    """An avatar's hierarchy of a nodes and b leaf nodes, avatar frame [m].

    center: (a, 3), radius: (a,), bounding spheres.  middle, half: (a, 3), boxes of the nodes'
    points.
    first: (a,) int32, first child or ~block.  count: (a,) int32, number of children or points.
    points: (b, 3, LANES) float64.
    """

    center: NDArray[np.float64]
    radius: NDArray[np.float64]
    middle: NDArray[np.float64]
    half: NDArray[np.float64]
    first: NDArray[np.int32]
    count: NDArray[np.int32]  # type: ignore[assignment]  # hides tuple.count, which nobody calls
    points: NDArray[np.float64]


class Forest(NamedTuple):
    """Hierarchies of a scene's voxels as stored, with n nodes and b leaf nodes.

    Coordinates are metres from the dataset's origin.
    center, radius, middle, half, first, count: as in Body.
    normal: (n, 3).  norm: (n,), its length.
    slab: (n, 2), least and greatest dot(normal, point - center) [m].  roots: (v,) int64.
    low: (b, 3) int64 and steps: (b, 3, LANES) uint16: lattice points.
    """

    center: NDArray[np.float64]
    radius: NDArray[np.float64]
    normal: NDArray[np.float64]
    norm: NDArray[np.float64]
    slab: NDArray[np.float64]
    middle: NDArray[np.float64]
    half: NDArray[np.float64]
    first: NDArray[np.int32]
    count: NDArray[np.int32]  # type: ignore[assignment]  # as above
    roots: NDArray[np.int64]
    low: NDArray[np.int64]
    steps: NDArray[np.uint16]


class Scratch(NamedTuple):
    """Working memory of one call.

    center, middle, half: (a, 3), the avatar's nodes under the pose.  placed: the avatar's blocks.
    taken: one block of the scene.  shift: (3,), t - O.  frame: (3,) int64.
    stack: (STACK, 2): avatar node, scene node.  keep: (LANES,).
    """

    center: NDArray[np.float64]
    middle: NDArray[np.float64]
    half: NDArray[np.float64]
    placed: Lanes
    taken: Lanes
    shift: NDArray[np.float64]
    frame: NDArray[np.int64]
    stack: NDArray[np.int64]
    keep: NDArray[np.bool_]


@nb.njit(nogil=True, cache=True)
def make_scratch(body):
    """Allocate the working memory for one avatar, which must have points."""
    shape = body.center.shape
    return Scratch(
        np.empty(shape), np.empty(shape), np.empty(shape), make_lanes(body.points.shape[0]), make_lanes(1), np.empty(3),
        np.empty(3, np.int64), np.empty((STACK, 2), np.int64), np.zeros(LANES, np.bool_),
    )  # fmt: skip


@njit_no_refcount
def bounds_meet(kind, body_radius, center, middle, half, a, forest, b, reach):
    """Return whether points below avatar node a may be within `reach` of points below scene node b.

    reach: [m].  center, middle, half: (nodes, 3), the avatar's spheres and boxes under the pose.
    """
    if kind == BOX:
        return (
            (abs(middle[a, 0] - forest.middle[b, 0]) <= half[a, 0] + forest.half[b, 0] + reach)
            & (abs(middle[a, 1] - forest.middle[b, 1]) <= half[a, 1] + forest.half[b, 1] + reach)
            & (abs(middle[a, 2] - forest.middle[b, 2]) <= half[a, 2] + forest.half[b, 2] + reach)
        )
    span = body_radius[a] + reach
    if kind == SPHERE_AND_BOX:
        square = 0.0
        for r in range(3):
            gap = abs(center[a, r] - forest.middle[b, r]) - forest.half[b, r]
            if gap > 0.0:
                square += gap * gap
        return square <= span * span
    dx, dy, dz = (
        center[a, 0] - forest.center[b, 0],
        center[a, 1] - forest.center[b, 1],
        center[a, 2] - forest.center[b, 2],
    )
    both = span + forest.radius[b]
    if dx * dx + dy * dy + dz * dz > both * both:
        return False
    if kind == SPHERE:
        return True
    along = forest.normal[b, 0] * dx + forest.normal[b, 1] * dy + forest.normal[b, 2] * dz
    room = forest.norm[b] * span
    return (along <= forest.slab[b, 1] + room) & (along >= forest.slab[b, 0] - room)


@njit_no_refcount
def keep_points(kind, points, block, count, m, shift, forest, b, reach, keep):
    """Mark the points of an avatar block that may be within `reach` of points below scene node b.

    Uses the bound of node b. Considers the first `count` points. Writes keep (LANES,). Returns the
    number of marked points.
    """
    kept = 0
    for i in range(LANES):
        x = place(m, shift, 0, points[block, 0, i], points[block, 1, i], points[block, 2, i])
        y = place(m, shift, 1, points[block, 0, i], points[block, 1, i], points[block, 2, i])
        z = place(m, shift, 2, points[block, 0, i], points[block, 1, i], points[block, 2, i])
        if kind in (BOX, SPHERE_AND_BOX):
            meets = (
                (abs(x - forest.middle[b, 0]) <= forest.half[b, 0] + reach)
                & (abs(y - forest.middle[b, 1]) <= forest.half[b, 1] + reach)
                & (abs(z - forest.middle[b, 2]) <= forest.half[b, 2] + reach)
            )
        else:
            dx, dy, dz = x - forest.center[b, 0], y - forest.center[b, 1], z - forest.center[b, 2]
            both = forest.radius[b] + reach
            meets = dx * dx + dy * dy + dz * dz <= both * both
            if kind == SLAB:
                along = forest.normal[b, 0] * dx + forest.normal[b, 1] * dy + forest.normal[b, 2] * dz
                room = forest.norm[b] * reach
                meets &= (along <= forest.slab[b, 1] + room) & (along >= forest.slab[b, 0] - room)
        keep[i] = meets & (i < count)
        kept += 1 if keep[i] else 0
    return kept


@njit_no_refcount
def _lower_bound(body_radius, center, a, forest, b):
    """Return a lower bound of the distance of points below two nodes [m], by their spheres.

    It may be negative.
    """
    square = 0.0
    for r in range(3):
        apart = center[a, r] - forest.center[b, r]
        square += apart * apart
    return math.sqrt(square) - body_radius[a] - forest.radius[b]


@njit_no_refcount
def _place_nodes(kind, m, shift, body, center, middle, half):
    """Transform the avatar's nodes to the pose.

    Writes the spheres' centres and, for BOX, boxes around the rotated boxes.
    The half side of such a box is the sum of the old half sides, weighted by the absolute elements
    of the rotation: Arvo, "Transforming axis-aligned bounding boxes", Graphics Gems (1990).
    """
    for i in range(body.center.shape[0]):
        for r in range(3):
            center[i, r] = place(m, shift, r, body.center[i, 0], body.center[i, 1], body.center[i, 2])
            if kind == BOX:
                middle[i, r] = place(m, shift, r, body.middle[i, 0], body.middle[i, 1], body.middle[i, 2])
                half[i, r] = (
                    abs(m[r, 0]) * body.half[i, 0]
                    + abs(m[r, 1]) * body.half[i, 1]
                    + abs(m[r, 2]) * body.half[i, 2]
                )


@njit_no_refcount
def _begin(leaf, m, body, units, reach, lattice, shift, frame):
    """Choose the coordinate frame of one pose. Writes shift and frame, returns the Limits."""
    farthest = 0.0
    for r in range(3):
        shift[r] = m[r, 3] - lattice.origin[r]
        root = place(m, shift, r, body.center[0, 0], body.center[0, 1], body.center[0, 2])
        frame[r] = np.int64(np.rint(root / lattice.step))
        farthest = max(farthest, abs(shift[r]) + abs(root))
    extent = body.radius[0] / lattice.step + 1.0
    return make_limits(leaf, units, reach, extent, farthest / lattice.step + extent, lattice)


@nb.njit(nogil=True, cache=True)
def descend(poses, body, forest, lattice, units, reach, node, leaf, sift, verdict, counts):
    """Test whether the avatar touches the scene under rigid poses (k, 4, 4).

    Uses one kind of node test and one of leaf test.
    units, reach: r_a + r_b, in exact units and in metres.
    node: SPHERE .. SPHERE_AND_BOX.  leaf: FLOAT32 .. CUBES (plain_pairs.py).
    sift: for two leaf nodes, first test the avatar's points against the bound of the scene's node,
    as the server does; [Fig12] tests all pairs.
    Writes verdict (k,) bool and counts (2, k) int64: node tests, pair tests.
    """
    work = make_scratch(body)
    _descend(poses, body, forest, lattice, units, reach, node, leaf, sift, verdict, counts, work)


@njit_no_refcount
def _descend(poses, body, forest, lattice, units, reach, node, leaf, sift, verdict, counts, work):
    """Do the work of `descend`, with given working memory."""
    center, middle, half, placed, taken, shift, frame, stack, keep = work
    # A sphere around a cube is larger than the cube; a box around cubes is not.
    span = reach * (CUBE_REACH if leaf == CUBES and node != BOX else 1.0) + SLACK
    for k in range(poses.shape[0]):
        m = poses[k]
        limits = _begin(leaf, m, body, units, reach, lattice, shift, frame)
        _place_nodes(node, m, shift, body, center, middle, half)
        tests, pairs = 0, 0
        touched = False
        for root in forest.roots:
            stack[0, 0], stack[0, 1] = 0, root
            depth = 1
            while depth > 0 and not touched:
                depth -= 1
                a, b = stack[depth, 0], stack[depth, 1]
                tests += 1
                if not bounds_meet(node, body.radius, center, middle, half, a, forest, b, span):
                    continue
                first_a, first_b = body.first[a], forest.first[b]
                if first_a < 0 and first_b < 0:
                    block, at = ~first_a, ~first_b
                    kept = int(body.count[a])
                    if sift:
                        kept = keep_points(node, body.points, block, kept, m, shift, forest, b, span, keep)
                        if kept == 0:
                            continue
                    else:
                        for i in range(LANES):
                            keep[i] = i < kept
                    if placed.stamp[block] != k:
                        place_points(leaf, body.points, m, shift, frame, block, lattice, placed)
                        placed.stamp[block] = k
                    take_points(leaf, forest.low, forest.steps, frame, at, lattice, taken)
                    pairs += kept * int(forest.count[b])
                    touched = blocks_touch(
                        leaf, m, shift, body.points, block, keep, forest.low, forest.steps, at, lattice,
                        placed, taken, limits,
                    )  # fmt: skip
                elif first_b < 0 or (first_a >= 0 and body.radius[a] > forest.radius[b]):
                    for i in range(body.count[a]):
                        stack[depth, 0], stack[depth, 1] = first_a + i, b
                        depth += 1
                else:
                    for i in range(forest.count[b]):
                        stack[depth, 0], stack[depth, 1] = a, first_b + i
                        depth += 1
            if touched:
                break
        verdict[k] = touched
        counts[0, k], counts[1, k] = tests, pairs


@nb.njit(nogil=True, cache=True)
def nearest(poses, body, forest, lattice, units, reach, farthest, leaf, found):
    """Compute the signed distances (k,) [m] of the avatar under rigid poses (k, 4, 4).

    leaf: kind of leaf test, FLOAT32 .. CUBES (plain_pairs.py).
    farthest: reach of the search [m], and the result where nothing is nearer. Pruning always uses
    the spheres. Writes found (k,).
    """
    work = make_scratch(body)
    _nearest(poses, body, forest, lattice, units, reach, farthest, leaf, found, work)


@njit_no_refcount
def _nearest(poses, body, forest, lattice, units, reach, farthest, leaf, found, work):
    """Do the work of `nearest`, with given working memory."""
    center, middle, half, placed, taken, shift, frame, stack, _ = work
    span = reach * (CUBE_REACH if leaf == CUBES else 1.0) + SLACK
    for k in range(poses.shape[0]):
        m = poses[k]
        limits = _begin(leaf, m, body, units, reach, lattice, shift, frame)
        _place_nodes(SPHERE, m, shift, body, center, middle, half)
        best = farthest
        for root in forest.roots:
            stack[0, 0], stack[0, 1] = 0, root
            depth = 1
            while depth > 0:
                depth -= 1
                a, b = stack[depth, 0], stack[depth, 1]
                if _lower_bound(body.radius, center, a, forest, b) - span > best:
                    continue
                first_a, first_b = body.first[a], forest.first[b]
                if first_a < 0 and first_b < 0:
                    block, at = ~first_a, ~first_b
                    if placed.stamp[block] != k:
                        place_points(leaf, body.points, m, shift, frame, block, lattice, placed)
                        placed.stamp[block] = k
                    take_points(leaf, forest.low, forest.steps, frame, at, lattice, taken)
                    best = min(best, blocks_gap(leaf, block, body.count[a], lattice, placed, taken, limits))
                elif first_b < 0 or (first_a >= 0 and body.radius[a] > forest.radius[b]):
                    for i in range(body.count[a]):
                        stack[depth, 0], stack[depth, 1] = first_a + i, b
                        depth += 1
                else:
                    for i in range(forest.count[b]):
                        stack[depth, 0], stack[depth, 1] = a, first_b + i
                        depth += 1
        found[k] = best


@nb.njit(nogil=True, cache=True)
def box_nodes(first, count, leaf_low, leaf_high, low, high):
    """Compute the boxes low, high (n, 3) of nodes from those of their leaf nodes (b, 3).

    first: (n,) int32, first child or ~block; children follow their parents.
    count: (n,), number of children.
    """
    for i in range(first.shape[0] - 1, -1, -1):
        if first[i] < 0:
            low[i], high[i] = leaf_low[~first[i]], leaf_high[~first[i]]
            continue
        low[i], high[i] = low[first[i]], high[first[i]]
        for child in range(first[i] + 1, first[i] + count[i]):
            for r in range(3):
                low[i, r] = min(low[i, r], low[child, r])
                high[i, r] = max(high[i, r], high[child, r])


@nb.njit(nogil=True, cache=True)
def brute_touch(m, points, scene_units, units, origin):
    """Test for contact by definition (NUMERICS.md N5): every pair of points.

    points: (n, 3), of the avatar [m], under the pose m.  scene_units: (s, 3), exact units.
    """
    shift, at = np.empty(3), np.empty(3, np.int64)
    for r in range(3):
        shift[r] = m[r, 3] - origin[r]
    for i in range(points.shape[0]):
        for r in range(3):
            at[r] = np.int64(
                np.rint(place(m, shift, r, points[i, 0], points[i, 1], points[i, 2]) * UNITS_PER_METRE)
            )
        for j in range(scene_units.shape[0]):
            dx, dy, dz = (
                abs(scene_units[j, 0] - at[0]),
                abs(scene_units[j, 1] - at[1]),
                abs(scene_units[j, 2] - at[2]),
            )
            # A pair farther apart than `units` along one axis is out of reach. These tests also
            # keep the squares within 63 bits.
            if dx <= units and dy <= units and dz <= units and dx * dx + dy * dy + dz * dz <= units * units:
                return True
    return False
