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
from ..core.node_overlap import STACK
from ..core.normal_codes import NO_NORMAL, SUMS, add_sums, decode_normal, normal_code
from ..core.scene_arrays import COUNT, COUNTED, FIRST, LANES, ROW_WORDS, point_class

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
    scene = held.scene
    words, ints, halves = scene.words, scene.ints, scene.halves
    mask = np.uint64(scene.radius_deficit.shape[0] - 1)
    low, shift = np.empty(3, np.int64), np.empty(3)
    for r in range(3):
        low[r] = scene.corners[voxel, r]
        shift[r] = scene.origin[r] - pose[r, 3]
    base = scene.where[voxel, 0]
    rows, depth = np.empty(STACK, np.int64), 1
    rows[0] = base
    while depth > 0:
        depth -= 1
        row, near = rows[depth], True
        for r in range(3):
            middle, radius = low[r] + np.float64(words[row + r]), np.float64(words[row + 3])
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
            x = low[0] + ints[block_at] + np.int64(halves[lane_at + j])
            y = low[1] + ints[block_at + 1] + np.int64(halves[lane_at + LANES + j])
            z = low[2] + ints[block_at + 2] + np.int64(halves[lane_at + 2 * LANES + j])
            if (
                x < box[0, 0]
                or x > box[1, 0]
                or y < box[0, 1]
                or y > box[1, 1]
                or z < box[0, 2]
                or z > box[1, 2]
            ):
                continue
            if count < found.shape[0]:
                to = found[count]
                a, b, c = x * scene.step + shift[0], y * scene.step + shift[1], z * scene.step + shift[2]
                for k in range(3):
                    to[PLACE + k] = pose[0, k] * a + pose[1, k] * b + pose[2, k] * c
                to[LATTICE], to[LATTICE + 1], to[LATTICE + 2] = x, y, z
                to[DEFICIT] = scene.radius_deficit[point_class(ints, block_at, j, mask)]
            count += 1
    return count


@nb.njit(nogil=True, cache=True)
def meet_points(body, box, points, reach, skipped, planes, way, times, own):
    """Find when a translated avatar first meets each of some points.

    body: reference to the avatar's arrays.  box: (2, 3) of its centres.
    points: (n, 3) places in its frame [m].  reach: (n,) contact distance of each [m].
    skipped: (n,) bool, points to leave out.  planes: (k, PLANE); points up to THICK beyond one of
    them are left out.  way: (3,) the translation, avatar frame.
    times: (n,), set to the fraction of `way` at the first contact; inf if there is none, or if left
    out.  own: (n, 3), set to the centre that touches first, in the avatar's frame.
    """
    avatar = body.avatar
    square = way[0] * way[0] + way[1] * way[1] + way[2] * way[2]
    rows = np.empty(STACK, np.int64)
    for i in range(points.shape[0]):
        times[i] = np.inf
        x, y, z, most = points[i, 0], points[i, 1], points[i, 2], reach[i] + SLACK
        left_out = skipped[i]
        for r in range(3):
            low, high = box[0, r] + min(way[r], 0.0), box[1, r] + max(way[r], 0.0)
            left_out |= points[i, r] < low - most - SLACK or points[i, r] > high + most + SLACK
        if not left_out:
            for k in range(planes.shape[0]):
                beyond = (planes[k, 0] * x + planes[k, 1] * y) + planes[k, 2] * z - planes[k, OFFSET]
                left_out |= beyond >= 0.0 and beyond <= THICK
        if left_out:
            continue
        rows[0], depth = 0, 1
        while depth > 0:
            depth -= 1
            row = rows[depth]
            dx, dy, dz = x - avatar.center[row, 0], y - avatar.center[row, 1], z - avatar.center[row, 2]
            t = 0.0
            if square > 0.0:
                t = min(max((dx * way[0] + dy * way[1] + dz * way[2]) / square, 0.0), 1.0)
            dx, dy, dz = dx - t * way[0], dy - t * way[1], dz - t * way[2]
            both = (most + avatar.radius[row]) * (1.0 + 1e-9)
            if dx * dx + dy * dy + dz * dz > both * both:
                continue
            first, count = np.int64(avatar.first[row]), np.int64(avatar.count[row])
            if first >= 0:
                for child in range(first, first + count):
                    rows[depth] = child
                    depth += 1
                continue
            for j in range(count):
                ax, ay, az = (
                    avatar.points[~first, 0, j],
                    avatar.points[~first, 1, j],
                    avatar.points[~first, 2, j],
                )
                dx, dy, dz = x - ax, y - ay, z - az
                beyond = dx * dx + dy * dy + dz * dz - most * most
                time = np.inf
                if beyond <= 0.0:
                    time = 0.0
                else:
                    along = dx * way[0] + dy * way[1] + dz * way[2]
                    root = along * along - square * beyond
                    if along > 0.0 and root >= 0.0 and along - math.sqrt(root) <= square:
                        time = max(0.0, (along - math.sqrt(root)) / square)
                if time < times[i]:
                    times[i] = time
                    own[i, 0], own[i, 1], own[i, 2] = ax, ay, az


@nb.njit(nogil=True, cache=True)
def find_heights(body, directions, heights):
    """Write the greatest heights (k,) of an avatar's centres, not empty, along directions (k, 3).

    The tree rules out all but some of the points: those of a filled person, 82,000, took 20 ms of the
    first frame in contact.
    """
    avatar = body.avatar
    rows = np.empty(STACK, np.int64)
    for n in range(directions.shape[0]):
        a, b, c, most = directions[n, 0], directions[n, 1], directions[n, 2], -np.inf
        length = math.sqrt((a * a + b * b) + c * c) * (1.0 + 1e-9)
        rows[0], depth = 0, 1
        while depth > 0:
            depth -= 1
            row = rows[depth]
            height = (a * avatar.center[row, 0] + b * avatar.center[row, 1]) + c * avatar.center[row, 2]
            if height + length * avatar.radius[row] < most:
                continue
            first, count = np.int64(avatar.first[row]), np.int64(avatar.count[row])
            if first >= 0:
                for child in range(first, first + count):
                    rows[depth] = child
                    depth += 1
                continue
            for j in range(count):
                x, y, z = (
                    avatar.points[~first, 0, j],
                    avatar.points[~first, 1, j],
                    avatar.points[~first, 2, j],
                )
                most = max(most, (a * x + b * y) + c * z)
        heights[n] = most


@nb.njit(nogil=True, cache=True)
def find_held(directions, heights, points, reach, held):
    """Set held (n,) bool also for points inside the hull of an avatar's spheres.

    heights: of the avatar's centres along `directions` (h, 3), as `find_heights` writes them.
    points, reach: as for `meet_points`. A point in a hollow between spheres is inside too.
    """
    lengths = np.sqrt((directions * directions).sum(axis=1))
    for i in range(points.shape[0]):
        x, y, z, inside = points[i, 0], points[i, 1], points[i, 2], True
        for n in range(directions.shape[0]):
            height = (directions[n, 0] * x + directions[n, 1] * y) + directions[n, 2] * z
            if height > heights[n] + reach[i] * lengths[n]:
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


@nb.njit(nogil=True, cache=True)
def _surface(points, which, at, reach):
    """Return the code of the normal of points (n, 3) near the one of row `at`.

    which: (n,) bool, points that count.  reach: of the points around that one [m].
    """
    sums = np.zeros(SUMS, np.int64)
    for i in range(points.shape[0]):
        if not which[i]:
            continue
        x, y, z = points[i, 0] - points[at, 0], points[i, 1] - points[at, 1], points[i, 2] - points[at, 2]
        if x * x + y * y + z * z <= reach * reach:
            add_difference(x, y, z, sums)
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
    core, normal, heights = np.empty((points.shape[0], 3)), np.empty(3), np.empty(points.shape[0])
    toward, beyond = np.empty(3), np.empty(points.shape[0], np.bool_)
    _core(box, ends)
    length = 0.0
    for r in range(3):
        length += (ends[1, r] - ends[0, r]) ** 2
    for i in range(points.shape[0]):
        along, square = 0.0, 0.0
        for r in range(3):
            along += (points[i, r] - ends[0, r]) * (ends[1, r] - ends[0, r])
        along = min(max(along / length, 0.0), 1.0) if length > 0.0 else 0.0
        for r in range(3):
            core[i, r] = ends[0, r] + along * (ends[1, r] - ends[0, r])
            square += (points[i, r] - core[i, r]) ** 2
        distances[i] = math.sqrt(square)
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
        for r in range(3):
            best[NEAREST + r], best[CORE + r] = points[at, r], core[at, r]
            toward[r] = (points[at, r] - core[at, r]) / distances[at]
        for level in range(-1, len(REACHES)):
            for r in range(3):
                normal[r] = toward[r]
            if level >= 0:
                code = _surface(points, beyond if level == len(REACHES) - 1 else left, at, REACHES[level])
                if code == NO_NORMAL:
                    continue
                a, b, c = decode_normal(code)
                side = -1.0 if (a * toward[0] + b * toward[1]) + c * toward[2] < 0.0 else 1.0
                normal[0], normal[1], normal[2] = side * a, side * b, side * c
            gap = np.inf
            for i in range(points.shape[0]):
                heights[i] = (normal[0] * points[i, 0] + normal[1] * points[i, 1]) + normal[2] * points[i, 2]
            for end in range(2):
                own = (normal[0] * ends[end, 0] + normal[1] * ends[end, 1]) + normal[2] * ends[end, 2]
                gap = min(gap, heights[at] - own)
            if level >= 0 and gap < MIN_GAP * distances[at]:
                continue
            least, offset, found = heights[at] - min(MAX_BUMP, 0.5 * gap), heights[at], 0
            for i in range(points.shape[0]):
                if left[i] and heights[i] >= least:
                    offset = min(offset, heights[i])
                    found += 1
            if found > most:
                most, best[OFFSET] = found, offset
                for r in range(3):
                    best[NORMAL + r] = normal[r]
                for i in range(points.shape[0]):
                    beyond[i] = left[i] and heights[i] >= offset
        for i in range(points.shape[0]):
            left[i] &= not beyond[i]
        count += 1


# Steps per metre of the differences that are summed for a normal: with a reach of a metre, the sums
# over eight million points fit 63 bits.
PATCH_STEPS = 1 << 20
# A node farther than the reach by this share has no point in reach, whatever was rounded.
_ROUNDED = 1.0 + 1e-9


@njit_no_refcount
def add_difference(x, y, z, sums):
    """Add a point's difference to another one [m] to the sums for `normal_code`."""
    add_sums(
        sums,
        np.int64(np.rint(x * PATCH_STEPS)),
        np.int64(np.rint(y * PATCH_STEPS)),
        np.int64(np.rint(z * PATCH_STEPS)),
    )


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
    x, y, z = point[0], point[1], point[2]
    square = reach * reach
    rows = np.empty(STACK, np.int64)
    heights[:] = 0.0
    sums[:] = 0
    rows[0], depth = 0, 1
    while depth > 0:
        depth -= 1
        row = rows[depth]
        dx, dy, dz = avatar.center[row, 0] - x, avatar.center[row, 1] - y, avatar.center[row, 2] - z
        both = (reach + avatar.radius[row]) * _ROUNDED
        if dx * dx + dy * dy + dz * dz > both * both:
            continue
        first, count = np.int64(avatar.first[row]), np.int64(avatar.count[row])
        if first >= 0:
            for child in range(first, first + count):
                rows[depth] = child
                depth += 1
            continue
        for j in range(count):
            px = avatar.points[~first, 0, j] - x
            py = avatar.points[~first, 1, j] - y
            pz = avatar.points[~first, 2, j] - z
            if px * px + py * py + pz * pz > square or body.rows[~first, j] >= body.surface:
                continue
            for k in range(directions.shape[0]):
                height = (px * directions[k, 0] + py * directions[k, 1]) + pz * directions[k, 2]
                heights[k] = min(heights[k], height)
            add_difference(px, py, pz, sums)
