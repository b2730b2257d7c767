"""State of one frame of a walking avatar, the tape of its queries, and its vectors.

The frame's code asks queries, such as sweeps, one after the other. Each answer is a row of the tape.
If a query cannot be answered in compiled code, because voxels have to be loaded or bodies are in the
way, the frame is left with `AskedError`. Python writes the answer to the tape and calls the kernel
again (server/simulation/world/walker.py). The kernel repeats the frame from its beginning, with
the known answers. Nothing in a frame depends on anything but its start and these answers, so it
arrives at the same query again. There is therefore one implementation of a frame, whatever is in
memory.

Vectors are tuples of three float64. Their operations and the order of these are those of
server/simulation/world/vectors.py, so that both give the same bits.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ....schemas.runtime import compiling as nb
from ....schemas.wire.answers import Verdict
from ..core.array_references import AvatarReference, SceneReference, record_type, reference
from ..core.kernel_decorators import njit_no_refcount
from ..motion.sweep_resident import SWEPT, MotionScratch

CLEAR, CONTACT, UNKNOWN = int(Verdict.CLEAR), int(Verdict.CONTACT), int(Verdict.UNKNOWN)

# Queries that Python answers. FULL: the tape needs more rows.
FULL, SWEPT_TO, BODIES_SWEPT, CLEAR_AT, BODIES_AT, TOUCHED, GIVES_WAY, NORMAL_AT, HIGHEST, NEAREST, LANDS = (
    range(11)
)
# Parts of a frame, in their order, as bits. FOLLOW: the motion command.
FOLLOW, SLIDE, STEP, GROUND = 1, 2, 4, 8
PARTS = 4
# Value of `log.apart` if a body was near.
NEAR = -1
# Limit of the voxels of a frame whose use is recorded.
_MOST_USED = 256

# Options of a scene's effects.
# up: unit.  continuous: whether motions are swept.  skin, tolerance: of sweeps [m].  slides: whether
# there is `slide`.  surfaces, normal_reach: of `slide`; the reach also without it [m].  lift: distance
# to move off a bump [m].  walkable_slide: least vertical component of a normal that `slide` does not
# treat as a wall's; below -1: there is no `ground`.  step: height of `step` [m].  clearance: height of
# feet above the ground [m].  near_reach, down: distances of the first and the full search for ground
# [m].  gravity: [m/s^2].  max_speed: of falling [m/s].  walkable: least vertical component of the normal
# of ground.
SETTINGS = record_type(
    ("up", "f8", (3,)), ("continuous", "?"), ("skin", "f8"), ("tolerance", "f8"), ("slides", "?"),
    ("surfaces", "i8"), ("normal_reach", "f8"), ("lift", "f8"), ("walkable_slide", "f8"), ("step", "f8"),
    ("clearance", "f8"), ("near_reach", "f8"), ("down", "f8"), ("gravity", "f8"), ("max_speed", "f8"),
    ("walkable", "f8"),
)  # fmt: skip
# Row of the tape. For a motion: the fields of `sweep_resident`. Then, for a hit: its verdict; the number
# of its archive (-1: not of the scan); what of it is known; its normal; whether it is of a body (named),
# and whether voxels are not in memory; the length of the motion that was left [m]. The answer of other
# queries is `answer` or three heights.
ROW = record_type(
    *SWEPT, ("verdict", "i8"), ("archive", "i8"), ("has_pair", "?"), ("has_point", "?"), ("has_end", "?"),
    ("has_normal", "?"), ("normal", "f8", (3,)), ("named", "?"), ("unloaded", "?"), ("rest", "f8"),
    ("answer", "?"), ("heights", "f8", (3,)),
)  # fmt: skip
# What repetitions keep: number of known rows, the query asked, whether the call repeats a frame's part,
# number of voxels used, whether something in reach was not examined, whether no body was near where the
# frame began and on its ways (1, NEAR: one was), and the node visits of each part.
LOG = record_type(
    ("known", "i8"), ("asked", "i8"), ("repeats", "?"), ("used", "i8"), ("missed", "?"), ("apart", "i8"),
    ("visits", "i8", (PARTS,)),
)  # fmt: skip
# What the query that Python answers is about; walker.py tells which fields each query has.
QUESTION = record_type(
    ("tolerance", "f8"), ("skin", "f8"), ("below", "?"), ("proved", "?"), ("stood", "?"), ("hit", "i8"),
    ("archive", "i8"), ("level", "i8"), ("count", "i8"), ("reach", "f8"), ("place", "f8", (3,)),
    ("toward", "f8", (3,)), ("directions", "f8", (3, 3)),
)  # fmt: skip
# What the body keeps from the frame before: duration of the frame [s], speed of falling [m/s], whether
# the avatar stood, point and normal of the plane that it stood on, and the place where it was raised last,
# if they are known.
BEFORE = record_type(
    ("seconds", "f8"), ("fall_speed", "f8"), ("stood", "?"), ("has_plane", "?"), ("plane", "f8", (2, 3)),
    ("was_raised", "?"), ("raised_at", "f8", (3,)),
)  # fmt: skip
# State: next row of the tape, part, number of hits, row of the hit that ended the motion command (-1:
# none), verdict, whether the pose is known to be clear, what is left of the motion command [m], height
# climbed by `step` [m] (NaN: none). Results of `ground`: whether it ran, whether the avatar stands, its
# speed of falling [m/s], the normal of the ground, point and normal of the plane that it stands on, and
# where it was raised.
STATE = record_type(
    ("row", "i8"), ("part", "i8"), ("hits", "i8"), ("blocked", "i8"), ("verdict", "i8"), ("clear", "?"),
    ("left", "f8", (3,)), ("stepped", "f8"), ("grounded", "?"), ("stands", "?"), ("fall_speed", "f8"),
    ("has_ground", "?"), ("ground", "f8", (3,)), ("has_plane", "?"), ("plane", "f8", (2, 3)),
    ("raised", "?"), ("raised_at", "f8", (3,)),
)  # fmt: skip
# A recorded hit: its row, and its normal if that was estimated.
HIT = record_type(("row", "i8"), ("has_normal", "?"), ("normal", "f8", (3,)))


class WalkArrays(NamedTuple):
    """Arrays of a frame's state, see `make_arrays`; kernels take them as a `WalkMemory`."""

    tape: NDArray[np.void]
    log: NDArray[np.void]
    question: NDArray[np.void]
    before: NDArray[np.void]
    state: NDArray[np.void]
    bytes: NDArray[np.uint8]
    saved_bytes: NDArray[np.uint8]
    hits: NDArray[np.void]
    begin: NDArray[np.float64]
    target: NDArray[np.float64]
    poses: NDArray[np.float64]
    saved_poses: NDArray[np.float64]
    asked_poses: NDArray[np.float64]
    used: NDArray[np.int64]
    verdict: NDArray[np.uint8]
    counts: NDArray[np.uint32]
    one: NDArray[np.float64]


class AskedError(Exception):
    """Python has to answer a query; see `LOG`."""


WalkMemory = reference(WalkArrays)


@reference
class Walk(NamedTuple):
    """All that a frame reads and writes, see `walk_frame`."""

    settings: NDArray[np.void]
    avatar: AvatarReference
    scratch: MotionScratch
    memory: WalkArrays
    held: SceneReference
    stop: NDArray[np.int64]
    unknown_everywhere: bool
    alone: bool
    native: bool
    bodies: bool
    other_units: int
    least_tolerance: float
    tolerance_units: int
    squares: NDArray[np.int64]
    bounds: NDArray[np.float64]
    kinds: NDArray[np.uint8]
    bounds_origin: NDArray[np.float64]
    wanted: int
    own: int
    margin: float


def make_arrays(rows: int) -> WalkArrays:
    """Allocate the state of a frame. rows: of the tape.

    log, question, before, state: one record each.  bytes: of `state`; saved: state before a call.
    hits: (rows,).  begin, target: (4, 4), where the frame began, and the commanded pose.
    poses: (2, 4, 4), the pose reached so far, and where the motion command was obstructed.
    asked_poses: of the query that Python answers.  used: voxels of all queries.
    verdict, counts, one: scratch of `collide_resident`.
    """
    state = np.zeros(1, STATE)
    return WalkArrays(
        tape=np.zeros(rows, ROW),
        log=np.zeros(1, LOG),
        question=np.zeros(1, QUESTION),
        before=np.zeros(1, BEFORE),
        state=state,
        bytes=state.view(np.uint8),
        saved_bytes=np.zeros(STATE.itemsize, np.uint8),
        hits=np.zeros(rows, HIT),
        begin=np.zeros((4, 4)),
        target=np.zeros((4, 4)),
        poses=np.zeros((2, 4, 4)),
        saved_poses=np.zeros((2, 4, 4)),
        asked_poses=np.zeros((2, 4, 4)),
        used=np.zeros(_MOST_USED, np.int64),
        verdict=np.zeros(1, np.uint8),
        counts=np.zeros((3, 1), np.uint32),
        one=np.zeros((1, 4, 4)),
    )


@nb.njit(nogil=True, cache=True)
def refer_to_memory(arrays):
    """Return a reference to the state of a frame."""
    return WalkMemory(
        arrays.tape, arrays.log, arrays.question, arrays.before, arrays.state, arrays.bytes, arrays.saved_bytes,
        arrays.hits, arrays.begin, arrays.target, arrays.poses, arrays.saved_poses, arrays.asked_poses, arrays.used,
        arrays.verdict, arrays.counts, arrays.one,
    )  # fmt: skip


@nb.njit(nogil=True, cache=True)
def ask(memory, query):
    """Leave the frame for Python to answer a query."""
    memory.log[0].asked = query
    raise AskedError


@nb.njit(nogil=True, cache=True)
def next_row(memory):
    """Return the row of the tape for the next query."""
    row = memory.state[0].row
    if row >= memory.tape.shape[0]:
        ask(memory, FULL)
    memory.state[0].row = row + 1
    return row


@nb.njit(nogil=True, cache=True)
def use_voxels(walk, count):
    """Record a use of the first `count` voxels of the last query."""
    memory, log, rows = walk.memory, walk.memory.log[0], walk.held.one.reach.lists.rows
    for n in range(count):
        row, known = rows[n], False
        for m in range(log.used):
            known |= memory.used[m] == row
        if not known and log.used < memory.used.shape[0]:
            memory.used[log.used] = row
            log.used += 1


@nb.njit(nogil=True, cache=True)
def pose_now(walk):
    """Return the pose (4, 4) that the frame has reached; callers do not write to it."""
    return walk.memory.poses[0]


@nb.njit(nogil=True, cache=True)
def blocked_pose(walk):
    """Return the pose (4, 4) where the motion command was obstructed; callers do not write to it."""
    return walk.memory.poses[1]


@njit_no_refcount
def vector(row):
    """Return the vector in an array (3,)."""
    return row[0], row[1], row[2]


@njit_no_refcount
def put(row, one):
    """Write a vector to an array (3,)."""
    row[0], row[1], row[2] = one[0], one[1], one[2]


@njit_no_refcount
def place_of(pose):
    """Return the translation of a pose (4, 4)."""
    return pose[0, 3], pose[1, 3], pose[2, 3]


@njit_no_refcount
def dot(one, other):
    """Return the dot product."""
    return one[0] * other[0] + one[1] * other[1] + one[2] * other[2]


@njit_no_refcount
def norm(one):
    """Return the length."""
    return math.sqrt(one[0] * one[0] + one[1] * one[1] + one[2] * one[2])


@njit_no_refcount
def plus(one, other):
    """Return the sum."""
    return one[0] + other[0], one[1] + other[1], one[2] + other[2]


@njit_no_refcount
def minus(one, other):
    """Return the difference."""
    return one[0] - other[0], one[1] - other[1], one[2] - other[2]


@njit_no_refcount
def times(factor, one):
    """Return a multiple."""
    return factor * one[0], factor * one[1], factor * one[2]


@njit_no_refcount
def divided(one, by):
    """Return the quotient of a vector and a number."""
    return one[0] / by, one[1] / by, one[2] / by


@njit_no_refcount
def cross(one, other):
    """Return the cross product."""
    return (
        one[1] * other[2] - one[2] * other[1],
        one[2] * other[0] - one[0] * other[2],
        one[0] * other[1] - one[1] * other[0],
    )


@njit_no_refcount
def rotate(pose, one):
    """Return a vector of the frame of a pose (4, 4) in the world."""
    return (
        pose[0, 0] * one[0] + pose[0, 1] * one[1] + pose[0, 2] * one[2],
        pose[1, 0] * one[0] + pose[1, 1] * one[1] + pose[1, 2] * one[2],
        pose[2, 0] * one[0] + pose[2, 1] * one[1] + pose[2, 2] * one[2],
    )


@njit_no_refcount
def rotate_back(pose, one):
    """Return a vector of the world in the frame of a pose (4, 4)."""
    return (
        pose[0, 0] * one[0] + pose[1, 0] * one[1] + pose[2, 0] * one[2],
        pose[0, 1] * one[0] + pose[1, 1] * one[1] + pose[2, 1] * one[2],
        pose[0, 2] * one[0] + pose[1, 2] * one[1] + pose[2, 2] * one[2],
    )


@njit_no_refcount
def copy_pose(source, target):
    """Copy a pose (4, 4) to another array."""
    for r in range(4):
        for c in range(4):
            target[r, c] = source[r, c]


@nb.njit(nogil=True, cache=True)
def same_pose(one, other):
    """Return whether two poses (4, 4) have the same bits."""
    for r in range(4):
        for c in range(4):
            a, b = one[r, c], other[r, c]
            if a != b or np.signbit(a) != np.signbit(b):
                return False
    return True


@nb.njit(nogil=True, cache=True)
def translated(pose, way):
    """Return a new pose (4, 4), translated by a vector."""
    there = np.empty((4, 4))
    copy_pose(pose, there)
    for r in range(3):
        there[r, 3] += way[r]
    return there


@njit_no_refcount
def lowest_height(points, radius, pose, up):
    """Return the lowest height of spheres under a pose, along `up` [m].

    points: (n, 3) float64, their centres in the pose's frame; n > 0.  radius: [m].
    """
    down = rotate_back(pose, up)
    least = np.inf
    for n in range(points.shape[0]):
        least = min(least, points[n, 0] * down[0] + points[n, 1] * down[1] + points[n, 2] * down[2])
    return dot(place_of(pose), up) + least - radius
