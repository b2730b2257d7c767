"""Queries of a walking avatar, answered from what is in memory or by Python; see walk_state.py.

A hit is the number of its row of the tape; -1 stands for none.
"""

import numpy as np

from ....schemas.kernels import compiling as nb
from ..collide.collide_poses import collide_resident
from ..core.voxels_in_reach import VALID
from ..motion.sweep_resident import (
    AVATAR,
    CLOUD,
    END,
    ENDED,
    LOWER,
    MAX_UNDECIDED,
    OPEN,
    POINT,
    PROVED,
    SPEED,
    UPPER,
    longest_way,
    pose_between,
    sweep_resident,
)
from ..rays.hits import nearest_in_memory
from .walk_obstacles import first_body, touches_no_body
from .walk_state import (
    ANSWER,
    ARCHIVE,
    BODIES_AT,
    CLEAR,
    CLEAR_AT,
    CONTACT,
    FRAME_VERDICT,
    GIVES_WAY,
    HAS_END,
    HAS_NORMAL,
    HAS_PAIR,
    HAS_POINT,
    KNOWN,
    LANDS,
    MISSED,
    NAMED,
    NEAREST,
    PART,
    REST,
    STAYS,
    SWEPT,
    TOUCHED,
    UNKNOWN,
    UNLOADED,
    VERDICT,
    VISITS,
    ask,
    next_row,
    pose_now,
    use_voxels,
)
from .walk_vectors import copy_pose, norm, vector


@nb.njit(nogil=True, cache=True)
def pair_of(walk, hit):
    """Return the centres of the two touching spheres of a hit: the avatar's and the other, world [m]."""
    row = walk.memory.tape[hit]
    return vector(row[AVATAR:CLOUD]), vector(row[CLOUD:ENDED])


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
    log = walk.memory.log
    log[VISITS + walk.memory.numbers[PART]] += visits
    if missed:
        log[MISSED] = 1


@nb.njit(nogil=True, cache=True)
def ask_at(walk, query, place):
    """Ask about a place; see `WalkCall._answer` in frame_walk.py for the numbers that each query gives."""
    for r in range(3):
        walk.memory.asked[r] = place[r]
    ask(walk.memory, query)


@nb.njit(nogil=True, cache=True)
def _ask_motion(walk, query, to, tolerance, skin, below):
    """Ask about the motion to a pose (4, 4)."""
    memory = walk.memory
    copy_pose(pose_now(walk), memory.asked_poses[0])
    copy_pose(to, memory.asked_poses[1])
    memory.asked[0], memory.asked[1], memory.asked[2] = tolerance, skin, 1.0 if below else 0.0
    ask(memory, query)


@nb.njit(nogil=True, cache=True)
def first_hit(walk, to, tolerance, skin, below):
    """Return the first hit of the motion from the frame's pose to a pose (4, 4).

    skin: distance to keep from the hit [m], for its end; negative: not requested.
    below: for a search for ground, leave out bodies beside the avatar.
    """
    memory = walk.memory
    row = next_row(memory)
    if row >= memory.log[KNOWN]:
        if not (walk.native and _sweep(walk, to, tolerance, skin, row)):
            _ask_motion(walk, SWEPT, to, tolerance, skin, below)
        if walk.bodies:
            clear = memory.tape[row, VERDICT] == CLEAR
            query = first_body(
                walk, walk.standing, to, tolerance, below, np.inf if clear else memory.tape[row, LOWER]
            )
            if query >= 0:
                _ask_motion(walk, query, to, tolerance, skin, below)
        memory.log[KNOWN] = row + 1
    return -1 if memory.tape[row, VERDICT] == CLEAR else row


@nb.njit(nogil=True, cache=True)
def _sweep(walk, to, tolerance, skin, row):
    """Write the scene's answer about a motion to a row; return whether it is known."""
    memory = walk.memory
    result, pose = memory.tape[row], pose_now(walk)
    within = max(tolerance, walk.least_tolerance)
    needed, verdict, visits, _, _ = sweep_resident(
        pose, to, walk.avatar, walk.scratch, walk.other_units, walk.held, walk.stop, walk.unknown_everywhere, within,
        skin, result[:VERDICT],
    )  # fmt: skip
    if needed < 0:
        return False
    if verdict == CONTACT and result[UPPER] == 0.0 and memory.numbers[FRAME_VERDICT] == CONTACT:
        return False  # the frame began in contact: Python answers such motions
    use_voxels(walk, needed)
    exact = True
    if verdict == CONTACT:
        apart = result[UPPER] - result[LOWER]
        exact = apart == 0.0 or result[SPEED] * apart <= within
        if not exact and not farthest_motion(walk, pose, to) * apart <= MAX_UNDECIDED:
            verdict = UNKNOWN
    part_unknown = walk.unknown_everywhere or walk.held.tree.unknown.shape[0] > 0
    count_visits(walk, visits, (verdict == UNKNOWN and exact) or (not exact and part_unknown))
    pair, ends = verdict == CONTACT, verdict == CONTACT and skin >= 0.0
    result[VERDICT], result[ARCHIVE] = verdict, 0.0 if pair else -1.0
    result[HAS_PAIR], result[HAS_POINT] = 1.0 if pair else 0.0, 1.0 if ends else 0.0
    result[HAS_END] = 1.0 if ends and result[ENDED] != OPEN else 0.0
    if ends and result[ENDED] != OPEN and result[ENDED] != PROVED:
        copy_pose(pose, result[END:VERDICT].reshape(4, 4))
    result[HAS_NORMAL], result[NAMED], result[UNLOADED], result[REST] = 0.0, 0.0, 0.0, 0.0
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
    if row >= memory.log[KNOWN]:
        copy_pose(pose, memory.asked_poses[0])
        memory.asked[0] = 1.0 if proved else 0.0
        verdict = CLEAR if proved else _collide(walk, pose) if walk.native else -1
        if verdict < 0:
            ask(memory, CLEAR_AT)
        if verdict == CLEAR and walk.bodies and not touches_no_body(walk, walk.standing, pose):
            ask(memory, BODIES_AT)
        memory.tape[row, ANSWER] = 1.0 if verdict == CLEAR else 0.0
        memory.log[KNOWN] = row + 1
    return memory.tape[row, ANSWER] != 0.0


@nb.njit(nogil=True, cache=True)
def hit_at(walk, pose):
    """Return a hit with fraction 0 if a pose (4, 4) touches something or is unknown."""
    memory = walk.memory
    row = next_row(memory)
    if row >= memory.log[KNOWN]:
        if walk.bodies or not walk.native or _collide(walk, pose) != CLEAR:
            copy_pose(pose, memory.asked_poses[0])
            ask(memory, TOUCHED)
        memory.tape[row, VERDICT] = CLEAR
        memory.log[KNOWN] = row + 1
    return -1 if memory.tape[row, VERDICT] == CLEAR else row


@nb.njit(nogil=True, cache=True)
def gives_way(walk, hit, to):
    """Let the touched body give way; return whether the motion to a pose (4, 4) should be tried again."""
    memory = walk.memory
    if memory.tape[hit, NAMED] == 0.0 or memory.tape[hit, NAMED] == STAYS:
        return False
    row = next_row(memory)
    if row >= memory.log[KNOWN]:
        _ask_motion(walk, GIVES_WAY, to, np.float64(hit), 0.0, False)
    return memory.tape[row, ANSWER] != 0.0


@nb.njit(nogil=True, cache=True)
def nearest_point(walk, place, reach):
    """Return the row with the scan point nearest to a place within `reach` [m]; -1 if there is none."""
    memory = walk.memory
    row = next_row(memory)
    if row >= memory.log[KNOWN]:
        needed, known, visits = -1, False, 0
        if walk.native and not (walk.unknown_everywhere or walk.held.tree.unknown.shape[0] > 0):
            cloud = memory.tape[row, CLOUD:ENDED]
            needed, known, visits = nearest_in_memory(walk.held, place, reach, walk.stop, cloud)
        if needed < 0:
            memory.asked[3] = reach
            ask_at(walk, NEAREST, place)
        use_voxels(walk, needed)
        count_visits(walk, visits, False)
        memory.tape[row, HAS_PAIR], memory.tape[row, ARCHIVE] = 1.0 if known else 0.0, 0.0
        memory.log[KNOWN] = row + 1
    return row if memory.tape[row, HAS_PAIR] != 0.0 else -1


@nb.njit(nogil=True, cache=True)
def lands(walk, reach, stood):
    """Return the row that says whether the avatar would land if it fell, see `_write_landing` in frame_walk.py.

    reach: distance below that is free [m].  stood: whether it stood in the last frame.
    """
    memory = walk.memory
    row = next_row(memory)
    if row >= memory.log[KNOWN]:
        copy_pose(pose_now(walk), memory.asked_poses[0])
        memory.asked[0], memory.asked[1] = reach, 1.0 if stood else 0.0
        ask(memory, LANDS)
    return row


@nb.njit(nogil=True, cache=True)
def motion_left(walk, to):
    """Return the length of the translation from the frame's pose to a pose (4, 4) [m]."""
    pose = pose_now(walk)
    return norm((to[0, 3] - pose[0, 3], to[1, 3] - pose[1, 3], to[2, 3] - pose[2, 3]))


@nb.njit(nogil=True, cache=True)
def touching_point(walk, to, hit):
    """Write the centre of the avatar's touching sphere at a hit (3,), avatar frame, to a new array.

    The hit ended the motion from the frame's pose to a pose (4, 4).
    """
    result, there, point = walk.memory.tape[hit], np.empty((4, 4)), np.empty(3)
    pose_on_way(walk, pose_now(walk), to, min(result[LOWER], 1.0), there)
    x, y, z = result[AVATAR] - there[0, 3], result[AVATAR + 1] - there[1, 3], result[AVATAR + 2] - there[2, 3]
    for k in range(3):
        point[k] = there[0, k] * x + there[1, k] * y + there[2, k] * z
    return point


@nb.njit(nogil=True, cache=True)
def keep_point(walk, to, hit):
    """Complete a hit of the scan that ended the motion to a pose (4, 4) with its touching point."""
    result = walk.memory.tape[hit]
    if result[ARCHIVE] >= 0.0 and result[HAS_PAIR] != 0.0 and result[HAS_POINT] == 0.0:
        point = touching_point(walk, to, hit)
        for r in range(3):
            result[POINT + r] = point[r]
        result[HAS_POINT] = 1.0
