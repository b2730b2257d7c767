"""Time of contact of one pair of points along a chord.

Float64 with a proof of its bounds; integers decide at the end.
"""

import math

import numpy as np

from ....schemas.archive.units import UNITS_PER_METRE
from ..core.borrowing_kernels import borrowing
from ..core.placed_avatar import pair_square
from ..core.pose_transform import SIMILARITY_TOLERANCE, lattice_to_units, place
from ..core.voxel_layout import LANES, point_class
from .screw_motion import pose_at

INFINITE = np.inf


@borrowing
def pair_times(gap, way, inner, outer):
    """Compute when a point moving from `gap` by `way` (3,) comes within `outer` and `inner` of 0.

    Returns (enters, certain, closest), fractions. enters: when it comes within `outer`, rounded
    down; inf when it never does in [0, 1]. certain: when it comes within `inner`, rounded up; inf
    likewise. closest: the fraction of closest approach, within [0, 1].
    """
    dot = gap[0] * way[0] + gap[1] * way[1] + gap[2] * way[2]
    length = math.sqrt(way[0] * way[0] + way[1] * way[1] + way[2] * way[2])
    apart = math.sqrt(gap[0] * gap[0] + gap[1] * gap[1] + gap[2] * gap[2])
    # Rounding of these lines: a few half units in the last place of the lengths, which are integers
    # or far above 2^-500.
    slack = 2.0**-48 * (apart + length)
    outer, inner = outer + slack, inner - slack
    at = -dot / (length * length) if length > 1e-100 else 0.0
    closest = min(max(at, 0.0), 1.0)
    ex, ey, ez = gap[0] + closest * way[0], gap[1] + closest * way[1], gap[2] + closest * way[2]
    if ex * ex + ey * ey + ez * ez > outer * outer:
        return INFINITE, INFINITE, closest
    enters, certain = INFINITE, INFINITE
    if apart <= outer:
        enters = 0.0
        if apart <= inner:
            return 0.0, 0.0, closest
    if length <= 1e-100 or at <= 0.0:
        return enters, certain, closest  # never nearer than now, and contact is not certain now
    ex, ey, ez = gap[0] + at * way[0], gap[1] + at * way[1], gap[2] + at * way[2]
    square = ex * ex + ey * ey + ez * ez
    late = 2.0**-48 * (1.0 + apart / length)
    if enters > 0.0:
        enters = max(at - math.sqrt(max(outer * outer - square, 0.0)) / length - late, 0.0)
    if inner > 0.0 and square < inner * inner:
        certain = max(at - math.sqrt(inner * inner - square) / length + late, 0.0)
        if certain > 1.0:
            certain = INFINITE
    return enters, certain, closest


@borrowing
def _drop_of(scene, pair):
    """Return the largest radius of the scan minus that of a pair's scan point, exact units."""
    return scene.drop[point_class(scene.ints, pair[4], pair[5], np.uint64(scene.drop.shape[0] - 1))]


@borrowing
def _scale_of(pose):
    """Return the scale of a pose, as `check_poses` computes it."""
    square = 0.0
    for r in range(3):
        for c in range(3):
            square += pose[r, c] * pose[r, c]
    scale = math.sqrt(square / 3.0)
    return 1.0 if abs(scale - 1.0) <= SIMILARITY_TOLERANCE else scale


@borrowing
def touches_at(job, t, pair):
    """Return whether one pair (as in Moving) is in contact under M(t), by NUMERICS.md N5."""
    scene, moving = job.scene, job.moving
    pose_at(job.motion, t, moving.pose)
    for r in range(3):
        moving.shift[r] = moving.pose[r, 3] - scene.origin[r]
    own = np.int64(np.rint(_scale_of(moving.pose) * job.radius * UNITS_PER_METRE))
    units = own + job.other_units - _drop_of(scene, pair)
    block, lane, voxel, lane_at, block_at, j = pair
    square = pair_square(job.avatar, moving.pose, block, lane, moving, scene, voxel, lane_at, block_at, j)
    return square >= 0 and square <= units * units


@borrowing
def scan_coordinate(scene, pair, r):
    """Return lattice coordinate r of a pair's scan point [steps]."""
    low = scene.coordinates[pair[2], r] * scene.voxel_steps + np.int64(scene.ints[pair[4] + r])
    return low + np.int64(scene.halves[pair[3] + r * LANES + pair[5]])


@borrowing
def _comes_first(job, pair, other):
    """Return whether `pair` precedes `other`, which touches at the same moment.

    The scan point decides first, then the avatar's point.
    """
    for r in range(3):
        one, two = scan_coordinate(job.scene, pair, r), scan_coordinate(job.scene, other, r)
        if one != two:
            return one < two
    points = job.avatar.points
    for r in range(3):
        if points[pair[0], r, pair[1]] != points[other[0], r, other[1]]:
            return points[pair[0], r, pair[1]] < points[other[0], r, other[1]]
    return False


@borrowing
def _certain_by_integers(job, chord, pair, enters, certain, closest):
    """Return the fraction at which a pair is known to touch, tested by integers at two poses.

    The chord is final. The poses are the first pose of the whole motion, whose contacts are those
    of `collide`, and the pose where the pair is closest.
    """
    if enters == 0.0 and chord.t0 == 0.0 and certain > 0.0 and touches_at(job, 0.0, pair):
        return 0.0
    if certain == INFINITE:
        t = chord.t1 if closest >= 1.0 else chord.t0 + closest * (chord.t1 - chord.t0)
        if touches_at(job, t, pair):
            return closest
    return certain


@borrowing
def try_pair(job, chord, pair):
    """Update moving.first and moving.pair with one pair, in float64."""
    scene, moving, points = job.scene, job.moving, job.avatar.points
    gap, way, first = moving.gap, moving.way, moving.first
    block, lane = pair[0], pair[1]
    x, y, z = points[block, 0, lane], points[block, 1, lane], points[block, 2, lane]
    for r in range(3):
        begin = place(moving.ends[0], moving.shifts[0], r, x, y, z) * UNITS_PER_METRE
        end = place(moving.ends[1], moving.shifts[1], r, x, y, z) * UNITS_PER_METRE
        steps = scan_coordinate(scene, pair, r)
        gap[r] = begin - np.float64(lattice_to_units(steps, scene.units_per_step))
        way[r] = end - begin
    drop = np.float64(_drop_of(scene, pair))
    enters, certain, closest = pair_times(gap, way, chord.inner - drop, chord.outer - drop)
    if enters > first[2]:
        return
    key, best = enters, first[0]
    if chord.final:
        certain = _certain_by_integers(job, chord, pair, enters, certain, closest)
        key, best = certain, first[1]
    first[0] = min(first[0], enters)
    if key < best or (key == best and key < INFINITE and _comes_first(job, pair, moving.pair)):
        first[1], first[2] = certain, key
        for n in range(6):
            moving.pair[n] = pair[n]
