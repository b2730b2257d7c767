"""Time of contact of one pair of points along a chord.

Float64 with a proof of its bounds; integers decide at the end.
"""

import math

import numpy as np

from ....schemas.archive.units import UNITS_PER_METRE
from ..core.kernel_decorators import njit_no_refcount
from ..core.placed_avatar import lattice_to_units, pair_square, place, to_units
from ..core.scene_arrays import LANES, point_class
from .screw_motion import pose_at

INFINITE = np.inf


@njit_no_refcount
def pair_times(gap, displacement, inner, outer):
    """Compute when a point moving from `gap` by `displacement` is within `outer` and `inner`.

    Returns (earliest_possible, earliest_certain, closest), fractions. earliest_possible: when it
    comes within `outer`, rounded down; inf if it never does in [0, 1]. earliest_certain: when it
    comes within `inner`, rounded up; inf likewise. closest: the fraction of closest approach, in
    [0, 1].
    """
    dot = gap[0] * displacement[0] + gap[1] * displacement[1] + gap[2] * displacement[2]
    length = math.sqrt(
        displacement[0] * displacement[0]
        + displacement[1] * displacement[1]
        + displacement[2] * displacement[2]
    )
    apart = math.sqrt(gap[0] * gap[0] + gap[1] * gap[1] + gap[2] * gap[2])
    # Rounding of these lines: a few half units in the last place of the lengths, which are integers
    # or far above 2^-500.
    slack = 2.0**-48 * (apart + length)
    outer, inner = outer + slack, inner - slack
    at = -dot / (length * length) if length > 1e-100 else 0.0
    closest = min(max(at, 0.0), 1.0)
    ex, ey, ez = (
        gap[0] + closest * displacement[0],
        gap[1] + closest * displacement[1],
        gap[2] + closest * displacement[2],
    )
    if ex * ex + ey * ey + ez * ez > outer * outer:
        return INFINITE, INFINITE, closest
    earliest_possible, earliest_certain = INFINITE, INFINITE
    if apart <= outer:
        earliest_possible = 0.0
        if apart <= inner:
            return 0.0, 0.0, closest
    if length <= 1e-100 or at <= 0.0:
        return (
            earliest_possible,
            earliest_certain,
            closest,
        )  # never nearer than now, and contact is not certain now
    ex, ey, ez = gap[0] + at * displacement[0], gap[1] + at * displacement[1], gap[2] + at * displacement[2]
    square = ex * ex + ey * ey + ez * ez
    late = 2.0**-48 * (1.0 + apart / length)
    if earliest_possible > 0.0:
        earliest_possible = max(at - math.sqrt(max(outer * outer - square, 0.0)) / length - late, 0.0)
    if inner > 0.0 and square < inner * inner:
        earliest_certain = max(at - math.sqrt(inner * inner - square) / length + late, 0.0)
        if earliest_certain > 1.0:
            earliest_certain = INFINITE
    return earliest_possible, earliest_certain, closest


@njit_no_refcount
def _deficit_of(scene, pair):
    """Return the largest radius of the scan minus that of a pair's scan point, exact units."""
    return scene.radius_deficit[
        point_class(scene.ints, pair[4], pair[5], np.uint64(scene.radius_deficit.shape[0] - 1))
    ]


@njit_no_refcount
def touches_at(sweep, t, pair):
    """Return whether one pair (as in MovingAvatar) is in contact under M(t), by NUMERICS.md N5."""
    scene, moving = sweep.scene, sweep.moving
    pose_at(sweep.motion, t, moving.pose)
    for r in range(3):
        moving.shift[r] = moving.pose[r, 3] - scene.origin[r]
    units = sweep.units - _deficit_of(scene, pair)
    block, lane, voxel, lane_at, block_at, j = pair
    square = pair_square(sweep.avatar, moving.pose, block, lane, moving, scene, voxel, lane_at, block_at, j)
    return square >= 0 and square <= units * units


@njit_no_refcount
def scan_coordinate(scene, pair, r):
    """Return lattice coordinate r of a pair's scan point [steps]."""
    low = scene.corners[pair[2], r] + np.int64(scene.ints[pair[4] + r])
    return low + np.int64(scene.halves[pair[3] + r * LANES + pair[5]])


@njit_no_refcount
def _comes_first(sweep, pair, other):
    """Return whether `pair` precedes `other`, which touches at the same moment (NUMERICS.md N11).

    The scan point decides first, then the avatar's centre at the beginning of the chord.
    """
    for r in range(3):
        one, two = scan_coordinate(sweep.scene, pair, r), scan_coordinate(sweep.scene, other, r)
        if one != two:
            return one < two
    for r in range(3):
        a, b = _placed_coordinate(sweep, pair, r), _placed_coordinate(sweep, other, r)
        if a != b:
            return a < b
    return False


@njit_no_refcount
def _placed_coordinate(sweep, pair, r):
    """Return coordinate r of a pair's avatar point at the beginning of the chord, exact units."""
    moving, points = sweep.moving, sweep.avatar.points
    x, y, z = points[pair[0], 0, pair[1]], points[pair[0], 1, pair[1]], points[pair[0], 2, pair[1]]
    return to_units(place(moving.ends[0], moving.shifts[0], r, x, y, z))


@njit_no_refcount
def _certain_by_integers(sweep, chord, pair, earliest_possible, earliest_certain, closest):
    """Return the fraction at which a pair certainly touches, also tested by integers at two poses.

    It is for final chords. The poses are the first pose of the whole motion, where contact is that
    of `collide`, and the pose where the pair is closest.
    """
    if (
        earliest_possible == 0.0
        and chord.t0 == 0.0
        and earliest_certain > 0.0
        and touches_at(sweep, 0.0, pair)
    ):
        return 0.0
    if earliest_certain == INFINITE:
        t = chord.t1 if closest >= 1.0 else chord.t0 + closest * (chord.t1 - chord.t0)
        if touches_at(sweep, t, pair):
            return closest
    return earliest_certain


@njit_no_refcount
def try_pair(sweep, chord, pair):
    """Update moving.first and moving.pair with one pair, in float64."""
    scene, moving, points = sweep.scene, sweep.moving, sweep.avatar.points
    gap, displacement, first = moving.gap, moving.displacement, moving.first
    if first[2] <= 0.0 and not _comes_first(sweep, pair, moving.pair):
        return
    block, lane = pair[0], pair[1]
    x, y, z = points[block, 0, lane], points[block, 1, lane], points[block, 2, lane]
    for r in range(3):
        begin = place(moving.ends[0], moving.shifts[0], r, x, y, z) * UNITS_PER_METRE
        end = place(moving.ends[1], moving.shifts[1], r, x, y, z) * UNITS_PER_METRE
        steps = scan_coordinate(scene, pair, r)
        gap[r] = begin - np.float64(lattice_to_units(steps, scene.units_per_step))
        displacement[r] = end - begin
    deficit = np.float64(_deficit_of(scene, pair))
    earliest_possible, earliest_certain, closest = pair_times(
        gap, displacement, chord.inner - deficit, chord.outer - deficit
    )
    if earliest_possible > first[2]:
        return
    key, best = earliest_possible, first[0]
    if chord.final:
        earliest_certain = _certain_by_integers(
            sweep, chord, pair, earliest_possible, earliest_certain, closest
        )
        key, best = earliest_certain, first[1]
    first[0] = min(first[0], earliest_possible)
    if key < best or (key == best and key < INFINITE and _comes_first(sweep, pair, moving.pair)):
        first[1], first[2] = earliest_certain, key
        for n in range(6):
            moving.pair[n] = pair[n]
