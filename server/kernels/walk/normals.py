"""Normals of surfaces at touched points, and heights of the points around; see state.py.

The normal of a contact between an avatar and the scan holds at free edges, corners and creases too.
The smoothed normal of the scan points around a touched one is the surface's if the avatar touches
the surface from one side. At a free edge, such as the jamb of a door in a wall scanned as one sheet
of points, it is still the sheet's, and an avatar would press against the edge for ever.

The normal of a contact separates the two bodies: near the touched point, the avatar lies on one
side of the plane, and the scan on the other. The smoothed normal of the scan is therefore taken if
its plane separates the avatar's patch, which is the points of its surface within reach of the
touched one. Otherwise the contact is at an edge, and three directions are compared: the smoothed
normal of the scan, that of the avatar, and the direction from the touched sphere to the touching
one. The one whose plane the points of both patches exceed least is taken. Where a smooth body
touches an edge, this is the body's normal, as for the contact of a vertex with a face in Baraff
1989 (Analytical Methods for Dynamic Simulation of Non-penetrating Rigid Bodies).

The border of a scan is not recognized from the scan alone, as by Bendels et al. 2006 (Detecting
Holes in Point Set Surfaces): a body that stands flat against a sheet beside its edge keeps the
sheet's normal, and uneven spacing is not taken for a border.
"""

import numpy as np

from ....schemas.runtime import compiling as nb
from ..bodies.avatar_patch import lowest_heights
from ..core.normal_codes import NO_NORMAL, SUMS, decode_normal, normal_code
from ..core.reach import all_resident
from ..rays.surface import add_near, voxels_near
from .queries import ask_at, pair_of
from .state import HIGHEST, NORMAL_AT, next_row, pose_now, use_voxels
from .walk_vectors import divided, dot, minus, norm, put, rotate, rotate_back, times, vector


@nb.njit(nogil=True, cache=True)
def _add_near(walk, place, level, sums, directions, heights):
    """Add the scan points within reach of a place (3,) [m], as `add_near` does; return whether that is known.

    It is unknown unless all voxels within reach are in memory. level: as for `scan_normal`.
    """
    scene, square, rows = walk.held.scene, walk.squares[level], walk.held.one.reach.lists.rows
    if not walk.native or square == 0:
        return False
    # Rounds half to even, as `Lattice.to_lattice`.
    x = np.int64(np.rint((place[0] - scene.origin[0]) / scene.step))
    y = np.int64(np.rint((place[1] - scene.origin[1]) / scene.step))
    z = np.int64(np.rint((place[2] - scene.origin[2]) / scene.step))
    count = voxels_near(walk.held, x, y, z, square, rows)
    if not all_resident(scene.where, rows, count):
        return False
    voxels = rows[:count]
    use_voxels(walk, count)
    add_near(walk.held, voxels, x, y, z, square, sums, directions, heights)
    return True


@nb.njit(nogil=True, cache=True)
def _code(walk, place, level):
    """Return whether the normal at a place is known, and its code. level: as for `scan_normal`."""
    sums = np.zeros(SUMS, np.int64)
    known = _add_near(walk, place, level, sums, np.empty((0, 3)), np.empty(0))
    return known, normal_code(sums)


@nb.njit(nogil=True, cache=True)
def scan_normal(walk, archive, cloud, toward, level):
    """Return whether the normal at a scan point is known, and it: a unit vector on the side of `toward`.

    archive: number of the scan's archive.  cloud: the point, world [m].  level: 0: points within the
    normal reach form the surface; 1: those within three times that. If they form none, the next level
    is taken.
    """
    memory = walk.memory
    row = next_row(memory)
    if row >= memory.log[0].known:
        known, code = _code(walk, cloud, level)
        if known and code == NO_NORMAL:
            known, code = _code(walk, cloud, level + 1)
        if not known:
            question = memory.question[0]
            put(question.toward, toward)
            question.archive, question.level = archive, level
            ask_at(walk, NORMAL_AT, cloud)
        memory.tape[row].has_normal = code != NO_NORMAL
        if code != NO_NORMAL:
            found = decode_normal(code)
            found = times(-1.0 if dot(found, toward) < 0.0 else 1.0, found)
            put(memory.tape[row].normal, found)
        memory.log[0].known = row + 1
    result = memory.tape[row]
    return result.has_normal, vector(result.normal)


@nb.njit(nogil=True, cache=True)
def hit_normal(walk, hit, level):
    """Return whether the normal at a hit is known, and it; of a body, as its hit has it."""
    result = walk.memory.tape[hit]
    if not result.has_pair or result.archive < 0:
        return result.has_normal, vector(result.normal)
    own, cloud = pair_of(walk, hit)
    return scan_normal(walk, result.archive, cloud, minus(own, cloud), level)


@nb.njit(nogil=True, cache=True)
def scan_heights(walk, hit, directions, level):
    """Return how high the scan points around a touched one lie along up to three directions [m].

    directions: (k, 3) unit.  level: as for `scan_normal`. Of further directions, the heights are zero.
    """
    memory = walk.memory
    row = next_row(memory)
    if row >= memory.log[0].known:
        archive, (_, cloud) = memory.tape[hit].archive, pair_of(walk, hit)
        count, heights, sums = directions.shape[0], np.zeros(3), np.zeros(SUMS, np.int64)
        if not _add_near(walk, cloud, level, sums, directions, heights[:count]):
            question = memory.question[0]
            question.archive, question.level, question.count = archive, level, count
            for n in range(count):
                put(question.directions[n], vector(directions[n]))
            ask_at(walk, HIGHEST, cloud)
        put(memory.tape[row].heights, times(walk.held.scene.step, vector(heights)))
        memory.log[0].known = row + 1
    return vector(memory.tape[row].heights)


# The avatar's patch may exceed the plane of the scan's normal by this share of the reach: by 1 cm
# with 8 cm. Bumps and noise of a wall let a body exceed it by less. Beside an edge, a body with a
# radius of 25 cm exceeds it by more if it is turned by more than 17 degrees.
MAX_EXCESS_SHARE = 0.125


@nb.njit(nogil=True, cache=True)
def contact_normal(walk, hit):
    """Return whether the normal of a contact is known, and it: a unit vector towards the avatar."""
    result = walk.memory.tape[hit]
    if result.has_normal:
        return True, vector(result.normal)  # of a body, or of a motion that began in contact
    known, smoothed = hit_normal(walk, hit, 0)
    if result.archive < 0 or not result.has_pair or not result.has_point:
        return known, smoothed
    own, cloud = pair_of(walk, hit)
    out = minus(own, cloud)
    apart = norm(out)
    if apart == 0.0:
        return known, smoothed
    normals, lowest, sums = np.zeros((3, 3)), np.zeros(3), np.zeros(SUMS, np.int64)
    count = 0
    if known:
        put(normals[0], smoothed)
        _lowest(walk, hit, out, apart, normals[:1], lowest[:1], sums)
        if lowest[0] >= -MAX_EXCESS_SHARE * walk.settings[0].normal_reach:
            return True, smoothed
        count = 1
    pair = divided(out, apart)
    put(normals[count], pair)
    count += 1
    _lowest(walk, hit, out, apart, normals[:count], lowest[:count], sums)
    code = normal_code(sums)
    if code != NO_NORMAL:
        own_normal = rotate(pose_now(walk), decode_normal(code))
        put(normals[count], times(-1.0 if dot(own_normal, pair) < 0.0 else 1.0, own_normal))
        _lowest(walk, hit, out, apart, normals[count : count + 1], lowest[count : count + 1], sums)
        count += 1
    highest = scan_heights(walk, hit, normals[:count], 0)
    best, least = 0, np.inf
    for n in range(count):
        excess = max(-lowest[n], highest[n])
        if excess < least:
            best, least = n, excess
    return True, vector(normals[best])


@nb.njit(nogil=True, cache=True)
def _lowest(walk, hit, out, apart, normals, lowest, sums):
    """Find the least height of the avatar's patch over the plane of each normal (k, 3).

    A plane touches the scan's sphere.  out: from the touched sphere to the touching one, `apart`
    long [m].  lowest: (k,), set [m].  sums: (SUMS,) int64, set as `normal_code` takes them.
    """
    pose, directions = pose_now(walk), np.empty((normals.shape[0], 3))
    for n in range(normals.shape[0]):
        put(directions[n], rotate_back(pose, vector(normals[n])))
    point = vector(walk.memory.tape[hit].point)
    lowest_heights(walk.avatar, point, walk.settings[0].normal_reach, directions, lowest, sums)
    for n in range(normals.shape[0]):
        lowest[n] = lowest[n] + dot(out, vector(normals[n])) - apart
