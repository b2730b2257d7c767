"""Points of an avatar and of the scan around a contact. Motions that begin in contact: which scan points
an avatar holds, and the planes it may not cross. Contacts of a walk: the patch of the avatar's surface
around the touched point (`lowest_heights`).

The rule, its proof and its limits are in schemas/SCENE.md, "A user in contact". Sums are float64 in
a fixed order, so that every machine finds the same motions and heights; distances below `SLACK` count as
contact.
"""

import itertools
import math

import numpy as np

from ....schemas.runtime import compiling as nb
from ..core.kernel_decorators import njit_no_refcount
from ..core.node_bounds import STACK
from ..core.normal_codes import NO_NORMAL, SUMS, add_sums, decode_normal, normal_code
from ..core.scene_arrays import COUNT, COUNTED, FIRST, LANES, ROW_WORDS, point_class
from ..motion.sweep_interval import scan_point
from ..motion.vector_tuples import (
    divided,
    dot,
    minus,
    norm,
    place_of,
    plus,
    point_of,
    put,
    rotate_back,
    times,
    vector,
)

# More than float64 loses at 10^7 m from the origin, and less than any skin [m].
SLACK = 1e-7
# Columns of a gathered point: place in the avatar's frame [m], lattice coordinates, radius deficit.
PLACE, LATTICE, DEFICIT, GATHERED = 0, 3, 6, 7
# Columns of a plane: unit normal away from the core, its offset, the nearest point's place and the
# core's point nearest to that.
NORMAL, OFFSET, NEAREST, CORE, PLANE = 0, 3, 4, 7, 10
# The normal of a plane is that of the points within one of these distances [m], as for `slide`, and
# half of it near an edge; the last is tried last, with the points that the best of the others
# leaves beyond.
REACHES = (0.04, 0.08, 0.24, 0.24)
# A plane lies up to this far before its nearest point [m], at most half the way to the core, so
# that the bumps of a scanned wall make no planes of their own. With 0, noise of 2 mm closed every
# corner.
MAX_BUMP = 0.02
# A plane that is nearer to the core than this share of its point's distance is not taken.
MIN_GAP = 0.25
MAX_PLANES = 256
# The points up to this far beyond a plane [m] are of its surface.
THICK = 0.05
# Steps per metre of the differences that are summed for a normal: with a reach of a metre, the sums
# over eight million points fit 63 bits.
PATCH_STEPS = 1 << 20
# A node farther than the reach by this share has no point in reach, whatever was rounded.
_ROUNDED = 1.0 + 1e-9
# Directions (290, 3) of the half-spaces around the avatar: whole numbers up to 3, the shortest first.
# Any direction is at most 9 degrees from one of them, so that the hull is a hundredth too large. Rows
# r and 5 - r are the axis r, against it and along it: they rule out most points.
DIRECTIONS = np.array(
    sorted(
        (way for way in itertools.product(range(-3, 4), repeat=3) if math.gcd(*way) == 1),
        key=lambda way: sum(each * each for each in way),
    ),
    np.float64,
)


@nb.njit(nogil=True, cache=True)
def gather_points(held, voxel, box, pose, found, count):
    """Append the points of a resident voxel in a box to found (capacity, GATHERED); return their number.

    box: (2, 3) int64, inclusive, lattice.  pose: (4, 4), avatar to archive.  count: number of
    points so far. Points beyond the capacity are counted and not written.
    """
    scene, shift = held.scene, minus(held.scene.origin, place_of(pose))
    words, ints, mask = scene.words, scene.ints, np.uint64(scene.radius_deficit.shape[0] - 1)
    base = scene.where[voxel, 0]
    rows, depth = np.empty(STACK, np.int64), 1
    rows[0] = base
    while depth > 0:
        depth -= 1
        row, near = rows[depth], True
        for r in range(3):
            middle, radius = scene.corners[voxel, r] + np.float64(words[row + r]), np.float64(words[row + 3])
            near &= middle + radius >= box[0, r] and middle - radius <= box[1, r]
        if not near:
            continue
        first, points = np.int64(ints[row + FIRST]), np.int64(ints[row + COUNT] & COUNTED)
        if first >= 0:
            for child in range(first, first + points):
                rows[depth] = base + child * ROW_WORDS
                depth += 1
            continue
        block_at = scene.where[voxel, 1] + ~first * scene.block_words
        lane_at = scene.where[voxel, 2] + ~first * 3 * LANES
        for j in range(points):
            steps, inside = scan_point(scene, voxel, lane_at, block_at, j), True
            for r in range(3):
                inside &= box[0, r] <= steps[r] <= box[1, r]
            if not inside:
                continue
            if count < found.shape[0]:
                to = found[count]
                put(to[PLACE:], rotate_back(pose, plus(times(scene.step, steps), shift)))
                put(to[LATTICE:], steps)
                to[DEFICIT] = scene.radius_deficit[point_class(ints, block_at, j, mask)]
            count += 1
    return count


@nb.njit(nogil=True, cache=True)
def meet_points(body, box, points, reach, skipped, planes, way, met, own):
    """Find when a translated avatar first meets each of some points.

    body: reference to the avatar's arrays.  box: (2, 3) of its centres.
    points: (n, 3) places in its frame [m].  reach: (n,) contact distance of each [m].
    skipped: (n,) bool, points to leave out.  planes: (k, PLANE); points up to THICK beyond one of
    them are left out.  way: (3,) the translation, avatar frame.
    met: (n,), set to the fraction of `way` at the first contact; inf if there is none, or if left
    out.  own: (n, 3), set to the centre that touches first, in the avatar's frame.
    """
    avatar, square, rows = body.avatar, dot(way, way), np.empty(STACK, np.int64)
    for i in range(points.shape[0]):
        met[i], left_out = np.inf, skipped[i]
        point, most = vector(points[i]), reach[i] + SLACK
        for r in range(3):
            low, high = box[0, r] + min(way[r], 0.0), box[1, r] + max(way[r], 0.0)
            left_out |= point[r] < low - most - SLACK or point[r] > high + most + SLACK
        if not left_out:
            for plane in planes:
                beyond = dot(plane, point) - plane[OFFSET]
                left_out |= beyond >= 0.0 and beyond <= THICK
        if left_out:
            continue
        rows[0], depth = 0, 1
        while depth > 0:
            depth -= 1
            row = rows[depth]
            gap, t = minus(point, avatar.center[row]), 0.0
            if square > 0.0:
                t = min(max(dot(gap, way) / square, 0.0), 1.0)
            gap = minus(gap, times(t, way))
            both = (most + avatar.radius[row]) * _ROUNDED
            if dot(gap, gap) > both * both:
                continue
            first, count = np.int64(avatar.first[row]), np.int64(avatar.count[row])
            if first >= 0:
                for child in range(first, first + count):
                    rows[depth] = child
                    depth += 1
                continue
            for j in range(count):
                centre = point_of(avatar.points, ~first, j)
                gap = minus(point, centre)
                beyond = dot(gap, gap) - most * most
                time = np.inf
                if beyond <= 0.0:
                    time = 0.0
                else:
                    along = dot(gap, way)
                    root = along * along - square * beyond
                    if along > 0.0 and root >= 0.0 and along - math.sqrt(root) <= square:
                        time = max(0.0, (along - math.sqrt(root)) / square)
                if time < met[i]:
                    met[i] = time
                    put(own[i], centre)


@nb.njit(nogil=True, cache=True)
def find_heights(body, directions, heights):
    """Write the greatest heights (k,) of an avatar's centres, not empty, along directions (k, 3).

    The tree rules out all but some of the points: those of a filled person, 82,000, took 20 ms of the
    first frame in contact.
    """
    avatar, rows = body.avatar, np.empty(STACK, np.int64)
    for n in range(directions.shape[0]):
        direction, most = vector(directions[n]), -np.inf
        length = norm(direction) * _ROUNDED
        rows[0], depth = 0, 1
        while depth > 0:
            depth -= 1
            row = rows[depth]
            if dot(direction, avatar.center[row]) + length * avatar.radius[row] < most:
                continue
            first, count = np.int64(avatar.first[row]), np.int64(avatar.count[row])
            if first >= 0:
                for child in range(first, first + count):
                    rows[depth] = child
                    depth += 1
                continue
            for j in range(count):
                most = max(most, dot(direction, point_of(avatar.points, ~first, j)))
        heights[n] = most


@nb.njit(nogil=True, cache=True)
def find_held(directions, heights, points, reach, held):
    """Set held (n,) bool also for points inside the hull of an avatar's spheres.

    heights: of the avatar's centres along `directions` (h, 3), as `find_heights` writes them.
    points, reach: as for `meet_points`. A point in a hollow between spheres is inside too.
    """
    lengths = np.empty(directions.shape[0])
    for n in range(directions.shape[0]):
        lengths[n] = norm(directions[n])
    for i in range(points.shape[0]):
        point, inside = vector(points[i]), True
        for n in range(directions.shape[0]):
            if dot(directions[n], point) > heights[n] + reach[i] * lengths[n]:
                inside = False
                break
        held[i] |= inside


@njit_no_refcount
def _core(box, ends):
    """Write the ends (2, 3) of the core of an avatar with a box (2, 3) of its centres.

    It is the segment through the middle of the box along its longest axis, shorter by the second
    extent.
    """
    longest = 0
    for r in range(1, 3):
        if box[1, r] - box[0, r] > box[1, longest] - box[0, longest]:
            longest = r
    second = 0.0
    for r in range(3):
        ends[0, r] = ends[1, r] = 0.5 * (box[0, r] + box[1, r])
        if r != longest:
            second = max(second, box[1, r] - box[0, r])
    half = 0.5 * (box[1, longest] - box[0, longest] - second)
    ends[0, longest] -= half
    ends[1, longest] += half


@njit_no_refcount
def _add_difference(gap, sums):
    """Add a point's difference to another one [m] to the sums for `normal_code`."""
    x, y, z = times(PATCH_STEPS, gap)
    add_sums(sums, np.int64(np.rint(x)), np.int64(np.rint(y)), np.int64(np.rint(z)))


@nb.njit(nogil=True, cache=True)
def _surface(points, which, at, reach):
    """Return the code of the normal of points (n, 3) near the one of row `at`.

    which: (n,) bool, points that count.  reach: of the points around that one [m].
    """
    sums = np.zeros(SUMS, np.int64)
    for i in range(points.shape[0]):
        if not which[i]:
            continue
        gap = minus(points[i], points[at])
        if dot(gap, gap) <= reach * reach:
            _add_difference(gap, sums)
    return normal_code(sums)


@nb.njit(nogil=True, cache=True)
def separate_core(box, points, planes):
    """Find planes between the core and the points that an avatar holds; return their number.

    box: (2, 3) of the avatar's centres.  points: (n, 3), avatar frame [m].
    planes: (MAX_PLANES, PLANE), written. Each point lies beyond one of the planes, and the core before all of them. The
    point nearest to the core of those left gives the next plane: of several normals, the one with
    the most points beyond.
    Returns -1 if the core touches a point, or there are more planes.
    """
    ends, left, distances = np.empty((2, 3)), np.ones(points.shape[0], np.bool_), np.empty(points.shape[0])
    core, heights = np.empty((points.shape[0], 3)), np.empty(points.shape[0])
    beyond = np.empty(points.shape[0], np.bool_)
    _core(box, ends)
    span = minus(ends[1], ends[0])
    length = dot(span, span)
    for i in range(points.shape[0]):
        along = dot(minus(points[i], ends[0]), span)
        along = min(max(along / length, 0.0), 1.0) if length > 0.0 else 0.0
        put(core[i], plus(ends[0], times(along, span)))
        distances[i] = norm(minus(points[i], core[i]))
    count = 0
    while True:
        at = -1
        for i in range(points.shape[0]):
            if left[i] and (at < 0 or distances[i] < distances[at]):
                at = i
        if at < 0:
            return count
        if distances[at] <= SLACK or count == MAX_PLANES:
            return -1
        best, most = planes[count], 0
        put(best[NEAREST:], points[at])
        put(best[CORE:], core[at])
        toward = divided(minus(points[at], core[at]), distances[at])
        for level in range(-1, len(REACHES)):
            normal = toward
            if level >= 0:
                code = _surface(points, beyond if level == len(REACHES) - 1 else left, at, REACHES[level])
                if code == NO_NORMAL:
                    continue
                normal = decode_normal(code)
                if dot(normal, toward) < 0.0:
                    normal = times(-1.0, normal)
            for i in range(points.shape[0]):
                heights[i] = dot(normal, points[i])
            gap = heights[at] - max(dot(normal, ends[0]), dot(normal, ends[1]))
            if level >= 0 and gap < MIN_GAP * distances[at]:
                continue
            least, offset, found = heights[at] - min(MAX_BUMP, 0.5 * gap), heights[at], 0
            for i in range(points.shape[0]):
                if left[i] and heights[i] >= least:
                    offset = min(offset, heights[i])
                    found += 1
            if found > most:
                most, best[OFFSET] = found, offset
                put(best[NORMAL:], normal)
                for i in range(points.shape[0]):
                    beyond[i] = left[i] and heights[i] >= offset
        for i in range(points.shape[0]):
            left[i] &= not beyond[i]
        count += 1


@nb.njit(nogil=True, cache=True)
def lowest_heights(body, point, reach, directions, heights, sums):
    """Find how low the points of an avatar's surface near one of them lie along directions.

    body: reference to the avatar's arrays.
    point: (3,) a place on the surface, avatar frame [m].  reach: inclusive [m].
    directions: (k, 3) unit, avatar frame.  heights: (k,), set to the least height over the points
    within reach, relative to `point` [m]; 0 if there are none.
    sums: (SUMS,) int64, set to the sums for `normal_code` (kernels/core/normal_codes.py), in
    1 / PATCH_STEPS of a metre.
    """
    avatar = body.avatar
    rows = np.empty(STACK, np.int64)
    heights[:] = 0.0
    sums[:] = 0
    rows[0], depth = 0, 1
    while depth > 0:
        depth -= 1
        row = rows[depth]
        gap, both = minus(avatar.center[row], point), (reach + avatar.radius[row]) * _ROUNDED
        if dot(gap, gap) > both * both:
            continue
        first, count = np.int64(avatar.first[row]), np.int64(avatar.count[row])
        if first >= 0:
            for child in range(first, first + count):
                rows[depth] = child
                depth += 1
            continue
        for j in range(count):
            gap = minus(point_of(avatar.points, ~first, j), point)
            if dot(gap, gap) > reach * reach or body.rows[~first, j] >= body.surface:
                continue
            for k in range(directions.shape[0]):
                heights[k] = min(heights[k], dot(gap, directions[k]))
            _add_difference(gap, sums)
