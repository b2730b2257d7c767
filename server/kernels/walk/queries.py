"""Queries of a walking avatar, answered from what is in memory or by Python; see state.py.

A hit is the number of its row of the tape; -1 stands for none.

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
from ..bodies.body_pairs import find_near_bodies
from ..bodies.leave_contact import lowest_heights
from ..collide.collide_poses import collide_resident
from ..core.normal_codes import NO_NORMAL, SUMS, decode_normal, normal_code
from ..core.reach import VALID, all_resident
from ..motion.sweep_resident import MAX_UNDECIDED, longest_way, pose_between, sweep_resident
from ..motion.vector_tuples import (
    copy_pose,
    divided,
    dot,
    minus,
    norm,
    place_of,
    put,
    rotate,
    rotate_back,
    same_pose,
    times,
    vector,
)
from ..rays.hits import nearest_in_memory
from ..rays.surface import add_near, voxels_near
from . import state
from .state import CLEAR, CONTACT, NEAR, UNKNOWN, ask, next_row, pose_now, use_voxels


@nb.njit(nogil=True, cache=True)
def pair_of(walk, hit):
    """Return the centres of the two touching spheres of a hit: the avatar's and the other, world [m]."""
    row = walk.memory.tape[hit]
    return vector(row.avatar), vector(row.cloud)


@nb.njit(nogil=True, cache=True)
def farthest_motion(walk, pose_from, pose_to):
    """Return an approximate bound of the distance that any avatar point moves [m]."""
    if walk.avatar.points.shape[0] == 0:
        return 0.0
    return longest_way(pose_from, pose_to, walk.avatar.avatar)


@nb.njit(nogil=True, cache=True)
def pose_on_way(walk, pose_from, pose_to, fraction, pose):
    """Write the pose at a fraction of a motion (4, 4); return whether the proof of its sweep covers it."""
    origin = walk.held.scene.origin if walk.alone else np.zeros(3)
    return pose_between(pose_from, pose_to, fraction, walk.avatar.box, origin, pose) and walk.alone


@nb.njit(nogil=True, cache=True)
def count_visits(walk, visits, missed):
    """Add the cost of a query. missed: whether something in reach was not examined."""
    log = walk.memory.log[0]
    log.visits[walk.memory.state[0].part] += visits
    if missed:
        log.missed = True


@nb.njit(nogil=True, cache=True)
def ask_at(walk, query, place):
    """Ask about a place."""
    put(walk.memory.question[0].place, place)
    ask(walk.memory, query)


@nb.njit(nogil=True, cache=True)
def _ask_motion(walk, query, to, below):
    """Ask about the motion to a pose (4, 4)."""
    memory = walk.memory
    copy_pose(pose_now(walk), memory.asked_poses[0])
    copy_pose(to, memory.asked_poses[1])
    memory.question[0].below = below
    ask(memory, query)


@nb.njit(nogil=True, cache=True)
def _is_far_from_bodies(walk, pose_from, pose_to):
    """Return whether the bounds of no body meet those of a motion; False where only Python answers."""
    log, count = walk.memory.log[0], 1
    if walk.native:
        rows = np.empty(walk.bounds.shape[0], np.int64)
        count = find_near_bodies(
            walk.avatar.box, pose_from, pose_to, walk.bounds_origin, walk.avatar.radius + walk.margin, walk.bounds,
            walk.kinds, walk.wanted, walk.own, rows,
        )  # fmt: skip
    if count > 0:
        log.apart = NEAR
    elif log.apart != NEAR and same_pose(pose_from, walk.memory.begin):
        log.apart = 1
    return count == 0


@nb.njit(nogil=True, cache=True)
def first_hit(walk, to, below):
    """Return the first hit of the motion from the frame's pose to a pose (4, 4).

    below: for a search for ground, leave out bodies beside the avatar.
    """
    row, known = next_row(walk.memory)
    if not known:
        if not (walk.native and _sweep(walk, to, row)):
            _ask_motion(walk, state.SWEPT_TO, to, below)
        if walk.bodies and not _is_far_from_bodies(walk, pose_now(walk), to):
            _ask_motion(walk, state.BODIES_SWEPT, to, below)
    return -1 if walk.memory.tape[row].verdict == CLEAR else row


@nb.njit(nogil=True, cache=True)
def _has_unknown(walk):
    """Return whether a scan was left out anywhere, or a load proved the index wrong."""
    return walk.unknown_everywhere or walk.held.tree.unknown.shape[0] > 0


@nb.njit(nogil=True, cache=True)
def _sweep(walk, to, row):
    """Write the scene's answer about a motion to a row; return whether it is known."""
    memory = walk.memory
    result, pose = memory.tape[row], pose_now(walk)
    within = max(walk.settings[0].tolerance, walk.least_tolerance)
    needed, verdict, visits, _, _ = sweep_resident(
        pose, to, walk.avatar, walk.scratch, walk.other_units, walk.held, walk.stop, walk.unknown_everywhere, within,
        result,
    )  # fmt: skip
    if needed < 0:
        return False
    if verdict == CONTACT and result.upper == 0.0 and memory.state[0].verdict == CONTACT:
        return False  # the frame began in contact: Python answers such motions
    use_voxels(walk, needed)
    exact = True
    if verdict == CONTACT:
        apart = result.upper - result.lower
        exact = apart == 0.0 or result.speed * apart <= within
        if not exact and not farthest_motion(walk, pose, to) * apart <= MAX_UNDECIDED:
            verdict = UNKNOWN
    count_visits(walk, visits, (verdict == UNKNOWN and exact) or (not exact and _has_unknown(walk)))
    result.verdict, result.has_pair, result.archive = (
        verdict,
        verdict == CONTACT,
        0 if verdict == CONTACT else -1,
    )
    result.has_point, result.has_end, result.has_normal = False, False, False
    result.named, result.unloaded, result.rest = False, False, 0.0
    return True


@nb.njit(nogil=True, cache=True)
def _collide(walk, pose):
    """Return the verdict of the scene at a pose (4, 4); -1 if it is not known."""
    memory, avatar = walk.memory, walk.avatar
    if _has_unknown(walk):
        return -1
    copy_pose(pose, memory.one[0])
    fault, _, needed = collide_resident(
        memory.one, avatar, avatar.radius, walk.other_units, walk.tolerance_units, walk.held, walk.stop,
        memory.verdict, memory.counts,
    )  # fmt: skip
    if fault != VALID or needed < 0:
        return -1
    use_voxels(walk, needed)
    verdict = np.int64(memory.verdict[0])
    count_visits(walk, np.int64(memory.counts[1, 0]), verdict == UNKNOWN)
    return verdict


@nb.njit(nogil=True, cache=True)
def is_clear(walk, pose, proved):
    """Return whether it is known that nothing is touched at a pose (4, 4).

    proved: whether this is already proved for the scene; then only bodies are tested.
    """
    if proved and not walk.bodies:
        return True
    memory = walk.memory
    row, known = next_row(memory)
    if not known:
        copy_pose(pose, memory.asked_poses[0])
        memory.question[0].proved = proved
        verdict = CLEAR if proved else _collide(walk, pose) if walk.native else -1
        if verdict < 0:
            ask(memory, state.CLEAR_AT)
        if verdict == CLEAR and walk.bodies and not _is_far_from_bodies(walk, pose, pose):
            ask(memory, state.BODIES_AT)
        memory.tape[row].answer = verdict == CLEAR
    return memory.tape[row].answer


@nb.njit(nogil=True, cache=True)
def hit_at(walk, pose):
    """Return a hit with fraction 0 if a pose (4, 4) touches something or is unknown."""
    memory = walk.memory
    row, known = next_row(memory)
    if not known:
        far = not walk.bodies or _is_far_from_bodies(walk, pose, pose)
        if not far or not walk.native or _collide(walk, pose) != CLEAR:
            copy_pose(pose, memory.asked_poses[0])
            ask(memory, state.TOUCHED)
        memory.tape[row].verdict = CLEAR
    return -1 if memory.tape[row].verdict == CLEAR else row


@nb.njit(nogil=True, cache=True)
def gives_way(walk, hit, to):
    """Let the touched body give way; return whether the motion to a pose (4, 4) should be tried again."""
    memory = walk.memory
    if not memory.tape[hit].named:
        return False
    row, known = next_row(memory)
    if not known:
        memory.question[0].hit = hit
        _ask_motion(walk, state.GIVES_WAY, to, False)
    return memory.tape[row].answer


@nb.njit(nogil=True, cache=True)
def nearest_point(walk, place, reach):
    """Return the row with the scan point nearest to a place within `reach` [m]; -1 if there is none."""
    memory = walk.memory
    row, known = next_row(memory)
    if not known:
        needed, is_found, visits = -1, False, 0
        if walk.native and not _has_unknown(walk):
            cloud = memory.tape[row].cloud
            needed, is_found, visits = nearest_in_memory(walk.held, place, reach, walk.stop, cloud)
        if needed < 0:
            memory.question[0].reach = reach
            ask_at(walk, state.NEAREST, place)
        use_voxels(walk, needed)
        count_visits(walk, visits, False)
        memory.tape[row].has_pair, memory.tape[row].archive = is_found, 0
    return row if memory.tape[row].has_pair else -1


@nb.njit(nogil=True, cache=True)
def lands(walk, reach, stood):
    """Return the row that says whether the avatar would land if it fell, see `_write_landing` in walker.py.

    reach: distance below that is free [m].  stood: whether it stood in the last frame.
    """
    memory = walk.memory
    row, known = next_row(memory)
    if not known:
        copy_pose(pose_now(walk), memory.asked_poses[0])
        memory.question[0].reach, memory.question[0].stood = reach, stood
        ask(memory, state.LANDS)
    return row


@nb.njit(nogil=True, cache=True)
def touching_point(walk, to, hit):
    """Return the centre of the avatar's touching sphere at a hit, avatar frame.

    The hit ended the motion from the frame's pose to a pose (4, 4).
    """
    result, there = walk.memory.tape[hit], np.empty((4, 4))
    pose_on_way(walk, pose_now(walk), to, min(result.lower, 1.0), there)
    return rotate_back(there, minus(vector(result.avatar), place_of(there)))


@nb.njit(nogil=True, cache=True)
def keep_point(walk, to, hit):
    """Complete a hit of the scan that ended the motion to a pose (4, 4) with its touching point."""
    result = walk.memory.tape[hit]
    if result.archive >= 0 and result.has_pair and not result.has_point:
        put(result.point, touching_point(walk, to, hit))
        result.has_point = True


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
def scan_normal(walk, archive, cloud, toward, level):
    """Return whether the normal at a scan point is known, and it: a unit vector on the side of `toward`.

    archive: number of the scan's archive.  cloud: the point, world [m].  level: 0: points within the
    normal reach form the surface; 1: those within three times that. If they form none, the next level
    is taken.
    """
    memory = walk.memory
    row, known = next_row(memory)
    if not known:
        is_found, code = True, NO_NORMAL
        for each in (level, level + 1):
            if is_found and code == NO_NORMAL:
                sums = np.zeros(SUMS, np.int64)
                is_found = _add_near(walk, cloud, each, sums, np.empty((0, 3)), np.empty(0))
                code = normal_code(sums)
        if not is_found:
            question = memory.question[0]
            put(question.toward, toward)
            question.archive, question.level = archive, level
            ask_at(walk, state.NORMAL_AT, cloud)
        memory.tape[row].has_normal = code != NO_NORMAL
        if code != NO_NORMAL:
            found = decode_normal(code)
            found = times(-1.0 if dot(found, toward) < 0.0 else 1.0, found)
            put(memory.tape[row].normal, found)
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
    row, known = next_row(memory)
    if not known:
        _, cloud = pair_of(walk, hit)
        count, heights, sums = directions.shape[0], np.zeros(3), np.zeros(SUMS, np.int64)
        if not _add_near(walk, cloud, level, sums, directions, heights[:count]):
            question = memory.question[0]
            question.archive, question.level, question.count = memory.tape[hit].archive, level, count
            for n in range(count):
                put(question.directions[n], vector(directions[n]))
            ask_at(walk, state.HIGHEST, cloud)
        put(memory.tape[row].heights, times(walk.held.scene.step, vector(heights)))
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
