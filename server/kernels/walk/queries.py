"""Queries of a walking avatar, answered from what is in memory or by Python; see state.py.

A hit is the number of its row of the tape; -1 stands for none.
"""

import numpy as np

from ....schemas.runtime import compiling as nb
from ..bodies.body_pairs import find_near_bodies
from ..collide.collide_poses import collide_resident
from ..core.reach import VALID
from ..motion.sweep_resident import MAX_UNDECIDED, OPEN, PROVED, longest_way, pose_between, sweep_resident
from ..rays.hits import nearest_in_memory
from .state import (
    BODIES_AT,
    BODIES_SWEPT,
    CLEAR,
    CLEAR_AT,
    CONTACT,
    GIVES_WAY,
    LANDS,
    NEAR,
    NEAREST,
    SWEPT_TO,
    TOUCHED,
    UNKNOWN,
    ask,
    next_row,
    pose_now,
    use_voxels,
)
from .walk_vectors import copy_pose, minus, norm, place_of, put, rotate_back, same_pose, vector


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
def _ask_motion(walk, query, to, tolerance, skin, below):
    """Ask about the motion to a pose (4, 4)."""
    memory, question = walk.memory, walk.memory.question[0]
    copy_pose(pose_now(walk), memory.asked_poses[0])
    copy_pose(to, memory.asked_poses[1])
    question.tolerance, question.skin, question.below = tolerance, skin, below
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
def first_hit(walk, to, tolerance, skin, below):
    """Return the first hit of the motion from the frame's pose to a pose (4, 4).

    skin: distance to keep from the hit [m], for its end; negative: not requested.
    below: for a search for ground, leave out bodies beside the avatar.
    """
    memory = walk.memory
    row = next_row(memory)
    if row >= memory.log[0].known:
        if not (walk.native and _sweep(walk, to, tolerance, skin, row)):
            _ask_motion(walk, SWEPT_TO, to, tolerance, skin, below)
        if walk.bodies and not _is_far_from_bodies(walk, pose_now(walk), to):
            _ask_motion(walk, BODIES_SWEPT, to, tolerance, skin, below)
        memory.log[0].known = row + 1
    return -1 if memory.tape[row].verdict == CLEAR else row


@nb.njit(nogil=True, cache=True)
def _sweep(walk, to, tolerance, skin, row):
    """Write the scene's answer about a motion to a row; return whether it is known."""
    memory = walk.memory
    result, pose = memory.tape[row], pose_now(walk)
    within = max(tolerance, walk.least_tolerance)
    needed, verdict, visits, _, _ = sweep_resident(
        pose, to, walk.avatar, walk.scratch, walk.other_units, walk.held, walk.stop, walk.unknown_everywhere, within,
        skin, result,
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
    part_unknown = walk.unknown_everywhere or walk.held.tree.unknown.shape[0] > 0
    count_visits(walk, visits, (verdict == UNKNOWN and exact) or (not exact and part_unknown))
    pair, ends = verdict == CONTACT, verdict == CONTACT and skin >= 0.0
    result.verdict, result.archive = verdict, 0 if pair else -1
    result.has_pair, result.has_point = pair, ends
    result.has_end = ends and result.ended != OPEN
    if result.has_end and result.ended != PROVED:
        copy_pose(pose, result.end)
    result.has_normal, result.named, result.unloaded, result.rest = False, False, False, 0.0
    return True


@nb.njit(nogil=True, cache=True)
def _collide(walk, pose):
    """Return the verdict of the scene at a pose (4, 4); -1 if it is not known."""
    memory, avatar = walk.memory, walk.avatar
    if walk.unknown_everywhere or walk.held.tree.unknown.shape[0] > 0:
        return -1
    copy_pose(pose, memory.one[0])
    fault, _, needed = collide_resident(
        memory.one, avatar, avatar.radius, walk.other_units, walk.tolerance_units, walk.held, walk.stop,
        memory.verdict, memory.counts,
    )  # fmt: skip
    if fault != VALID or needed < 0:
        return -1
    use_voxels(walk, needed)
    found = memory.verdict[0]
    verdict = CLEAR if found == CLEAR else UNKNOWN if found == UNKNOWN else CONTACT
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
    row = next_row(memory)
    if row >= memory.log[0].known:
        copy_pose(pose, memory.asked_poses[0])
        memory.question[0].proved = proved
        verdict = CLEAR if proved else _collide(walk, pose) if walk.native else -1
        if verdict < 0:
            ask(memory, CLEAR_AT)
        if verdict == CLEAR and walk.bodies and not _is_far_from_bodies(walk, pose, pose):
            ask(memory, BODIES_AT)
        memory.tape[row].answer = verdict == CLEAR
        memory.log[0].known = row + 1
    return memory.tape[row].answer


@nb.njit(nogil=True, cache=True)
def hit_at(walk, pose):
    """Return a hit with fraction 0 if a pose (4, 4) touches something or is unknown."""
    memory = walk.memory
    row = next_row(memory)
    if row >= memory.log[0].known:
        far = not walk.bodies or _is_far_from_bodies(walk, pose, pose)
        if not far or not walk.native or _collide(walk, pose) != CLEAR:
            copy_pose(pose, memory.asked_poses[0])
            ask(memory, TOUCHED)
        memory.tape[row].verdict = CLEAR
        memory.log[0].known = row + 1
    return -1 if memory.tape[row].verdict == CLEAR else row


@nb.njit(nogil=True, cache=True)
def gives_way(walk, hit, to):
    """Let the touched body give way; return whether the motion to a pose (4, 4) should be tried again."""
    memory = walk.memory
    if not memory.tape[hit].named:
        return False
    row = next_row(memory)
    if row >= memory.log[0].known:
        memory.question[0].hit = hit
        _ask_motion(walk, GIVES_WAY, to, 0.0, 0.0, False)
    return memory.tape[row].answer


@nb.njit(nogil=True, cache=True)
def nearest_point(walk, place, reach):
    """Return the row with the scan point nearest to a place within `reach` [m]; -1 if there is none."""
    memory = walk.memory
    row = next_row(memory)
    if row >= memory.log[0].known:
        needed, known, visits = -1, False, 0
        if walk.native and not (walk.unknown_everywhere or walk.held.tree.unknown.shape[0] > 0):
            cloud = memory.tape[row].cloud
            needed, known, visits = nearest_in_memory(walk.held, place, reach, walk.stop, cloud)
        if needed < 0:
            memory.question[0].reach = reach
            ask_at(walk, NEAREST, place)
        use_voxels(walk, needed)
        count_visits(walk, visits, False)
        memory.tape[row].has_pair, memory.tape[row].archive = known, 0
        memory.log[0].known = row + 1
    return row if memory.tape[row].has_pair else -1


@nb.njit(nogil=True, cache=True)
def lands(walk, reach, stood):
    """Return the row that says whether the avatar would land if it fell, see `_write_landing` in walker.py.

    reach: distance below that is free [m].  stood: whether it stood in the last frame.
    """
    memory = walk.memory
    row = next_row(memory)
    if row >= memory.log[0].known:
        copy_pose(pose_now(walk), memory.asked_poses[0])
        memory.question[0].reach, memory.question[0].stood = reach, stood
        ask(memory, LANDS)
    return row


@nb.njit(nogil=True, cache=True)
def motion_left(walk, to):
    """Return the length of the translation from the frame's pose to a pose (4, 4) [m]."""
    pose = pose_now(walk)
    return norm((to[0, 3] - pose[0, 3], to[1, 3] - pose[1, 3], to[2, 3] - pose[2, 3]))


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
