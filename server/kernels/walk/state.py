"""State of one frame of a walking avatar, and the tape of its queries.

The frame's code asks queries, such as sweeps, one after the other. Each answer is a row of the tape.
If a query cannot be answered in compiled code, because voxels have to be loaded or bodies are in the
way, the frame is left with `AskedError`. Python writes the answer to the tape and calls the kernel
again (server/simulation/world/walker.py). The kernel repeats the frame from its beginning, with
the known answers. Nothing in a frame depends on anything but its start and these answers, so it
arrives at the same query again. There is therefore one implementation of a frame, whatever is in
memory.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ....schemas.runtime import compiling as nb
from ....schemas.wire.answers import Verdict
from ..core.array_references import AvatarReference, SceneReference, record_type, reference
from ..motion.sweep_resident import SWEPT, MotionScratch
from ..motion.vector_tuples import place_of

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
# of its archive (-1: not of the scan); what of it is known: the two centres, the touching point, avatar
# frame [m], a pose at which the motion ends, and the normal; whether it is of a body (named), and whether
# voxels are not in memory; the length of the motion that was left [m]. The answer of other queries is
# `answer` or three heights.
ROW = record_type(
    *SWEPT, ("verdict", "i8"), ("archive", "i8"), ("has_pair", "?"), ("has_point", "?"), ("point", "f8", (3,)),
    ("has_end", "?"), ("end", "f8", (4, 4)), ("has_normal", "?"), ("normal", "f8", (3,)), ("named", "?"),
    ("unloaded", "?"), ("rest", "f8"), ("answer", "?"), ("heights", "f8", (3,)),
)  # fmt: skip
# What repetitions keep: number of rows that are known or asked about, the query asked, whether the call
# repeats a frame's part, number of voxels used, whether something in reach was not examined, whether no
# body was near where the frame began and on its ways (1, NEAR: one was), and the node visits of each part.
LOG = record_type(
    ("known", "i8"), ("asked", "i8"), ("repeats", "?"), ("used", "i8"), ("missed", "?"), ("apart", "i8"),
    ("visits", "i8", (PARTS,)),
)  # fmt: skip
# What the query that Python answers is about; walker.py tells which fields each query has.
QUESTION = record_type(
    ("below", "?"), ("proved", "?"), ("stood", "?"), ("hit", "i8"), ("archive", "i8"), ("level", "i8"),
    ("count", "i8"), ("reach", "f8"), ("place", "f8", (3,)), ("toward", "f8", (3,)), ("directions", "f8", (3, 3)),
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
    saved_state: NDArray[np.void]
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
    """All that a frame reads and writes.

    avatar: reference to its arrays.  scratch: of its motions.  memory: state of the frame; the caller has
    written how it begins.  held: reference to the scene's arrays.
    stop, unknown_everywhere, other_units: as for `sweep_resident`.  alone: whether the scene is one
    archive at the identity.  native: whether queries may be answered here: it is alone, and the avatar is
    small and not empty.  bodies: whether other bodies are obstacles.
    least_tolerance, tolerance_units: of the frame's budget [m], [exact units].
    squares: (3,) int64, the normal reach, thrice and nine times that, squared [steps^2]; 0 if invalid.
    bounds, kinds, bounds_origin, wanted, own: of the bodies that may be in the way, as for
    `find_near_bodies`.  margin: distance to keep from them [m].
    """

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

    log, question, before, state: one record each.  saved: state before a call.
    hits: (rows,).  begin, target: (4, 4), where the frame began, and the commanded pose.
    poses: (2, 4, 4), the pose reached so far, and where the motion command was obstructed.
    asked_poses: of the query that Python answers.  used: voxels of all queries.
    verdict, counts, one: scratch of `collide_resident`.
    """
    return WalkArrays(
        tape=np.zeros(rows, ROW),
        log=np.zeros(1, LOG),
        question=np.zeros(1, QUESTION),
        before=np.zeros(1, BEFORE),
        state=np.zeros(1, STATE),
        saved_state=np.zeros(1, STATE),
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
    return WalkMemory(*arrays)


@nb.njit(nogil=True, cache=True)
def ask(memory, query):
    """Leave the frame for Python to answer a query."""
    memory.log[0].asked = query
    raise AskedError


@nb.njit(nogil=True, cache=True)
def next_row(memory):
    """Return the row of the tape for the next query, and whether its answer is known.

    If not, the caller writes it, or asks Python to.
    """
    row, log = memory.state[0].row, memory.log[0]
    if row >= memory.tape.shape[0]:
        ask(memory, FULL)
    memory.state[0].row = row + 1
    known = row < log.known
    log.known = max(log.known, row + 1)
    return row, known


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
def place_now(walk):
    """Return the translation of `pose_now`."""
    return place_of(walk.memory.poses[0])


@nb.njit(nogil=True, cache=True)
def blocked_pose(walk):
    """Return the pose (4, 4) where the motion command was obstructed; callers do not write to it."""
    return walk.memory.poses[1]
