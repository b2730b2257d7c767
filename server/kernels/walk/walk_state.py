"""State of one frame of a walking avatar, and the tape of its queries.

The frame's code asks queries, such as sweeps, one after the other. Each answer is a row of the tape.
If a query cannot be answered in compiled code, because voxels have to be loaded or bodies are in the
way, the frame is left with `AskedError`. Python writes the answer to the tape and calls the kernel
again (server/simulation/world/frame_walk.py). The kernel repeats the frame from its beginning, with
the known answers. Nothing in a frame depends on anything but its start and these answers, so it
arrives at the same query again. There is therefore one implementation of a frame, whatever is in
memory.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ....schemas.kernels import compiling as nb
from ....schemas.wire.answers import Verdict
from ..core.array_references import AvatarReference, SceneReference
from ..motion.sweep_resident import COLUMNS, MotionScratch

CLEAR, CONTACT, UNKNOWN = int(Verdict.CLEAR), int(Verdict.CONTACT), int(Verdict.UNKNOWN)

# Columns of a row of the tape. The first are those of `sweep_resident`. Then, for a hit: its verdict,
# number of its archive (-1: not of the scan), whether the centres of the touching spheres, the
# touching point, the end and the normal are known, the normal (3,), whether it is of a named body
# (STAYS: of one that never gives way), whether voxels are not in memory, and the length of the motion
# that was left [m]. The answer of other queries is a number or three heights.
VERDICT = COLUMNS
ARCHIVE, HAS_PAIR, HAS_POINT, HAS_END, HAS_NORMAL, NORMAL = (COLUMNS + n for n in range(1, 7))
NAMED, UNLOADED, REST, ANSWER, HEIGHTS, ROW = (COLUMNS + n for n in (9, 10, 11, 12, 13, 16))
# Queries that Python answers. FULL: the tape needs more rows.
FULL, SWEPT, BODIES_SWEPT, CLEAR_AT, BODIES_AT, TOUCHED, GIVES_WAY, NORMAL_AT, HIGHEST, NEAREST, LANDS = (
    range(11)
)
BODIES_HIT = 11  # the kernel found the body that ends a motion, and Python names it
STAYS = 2.0
# Elements of `asked` of BODIES_HIT after those of a motion: row of the body, fraction, centres of the two
# spheres (6,), and block and lane of the body's point.
HIT_ROW, HIT_FRACTION, HIT_PAIR, HIT_POINT = 3, 4, 5, 11
# `Walk.own` where Python answers all queries about bodies.
ASKS = -2

# Elements of `log`, which repetitions keep: number of known rows, the query asked, whether the call
# repeats a frame's part, number of voxels used, whether something in reach was not examined, whether
# no body was touched where the frame began, and the node visits of each part.
KNOWN, ASKED, REPEATS, USED, MISSED, APART, VISITS = range(7)
# Parts of a frame, in their order, as bits. FOLLOW: the motion command.
FOLLOW, SLIDE, STEP, GROUND = 1, 2, 4, 8
PARTS = 4
LOG = VISITS + PARTS
# Limit of the voxels of a frame whose use is recorded.
_MOST_USED = 256

# Elements of `numbers`: next row of the tape, part, number of hits, row of the hit that ended the
# motion command (-1: none), verdict, whether the pose is known to be clear; results of `ground`: whether
# it ran, the avatar stands, its normal and a plane are known, and it was raised.
AT, PART, HITS, BLOCKED, FRAME_VERDICT, IS_CLEAR = range(6)
GROUNDED, STANDS, HAS_STOOD_ON, HAS_PLANE, RAISED, NUMBERS = range(6, 12)
# Elements of `values`: speed of falling [m/s], height climbed by `step` [m] (NaN: none), what is left of
# the motion command (3,) [m], normal of the ground (3,), point and normal of the plane (6,), and place
# where the avatar was raised (3,).
FALL_SPEED, STEPPED, LEFT, STOOD_ON, PLANE, RAISED_AT, VALUES = 0, 1, 2, 5, 8, 14, 17
# Elements of `inputs`: duration of the frame [s], speed of falling [m/s]; whether the avatar stood,
# whether the plane that it stood on and the place of its last raise are known.
SECONDS, FELL, STOOD, HAD_PLANE, WAS_RAISED, INPUTS = range(6)
# Poses: where the frame began, the commanded one, that reached so far, and that where the motion
# command was obstructed.
BEGIN, TARGET, POSE, BLOCKED_POSE, POSES = range(5)

_SETTINGS = [
    "up", "continuous", "skin", "tolerance", "slides", "surfaces", "normal_reach", "lift", "walkable_slide",
    "step", "clearance", "near_reach", "down", "gravity", "max_speed", "walkable",
]  # fmt: skip
_WALK = [
    "settings", "avatar", "scratch", "memory", "held", "stop", "unknown_everywhere", "alone", "native", "bodies",
    "other_units", "least_tolerance", "tolerance_units", "squares", "standing", "own",
]  # fmt: skip


class WalkArrays(NamedTuple):
    """Arrays of a frame's state, see `make_arrays`; kernels take them as a `WalkMemory`."""

    tape: NDArray[np.float64]
    log: NDArray[np.int64]
    numbers: NDArray[np.int64]
    values: NDArray[np.float64]
    inputs: NDArray[np.float64]
    poses: NDArray[np.float64]
    old_plane: NDArray[np.float64]
    old_raised: NDArray[np.float64]
    hits: NDArray[np.int64]
    normals: NDArray[np.float64]
    asked_poses: NDArray[np.float64]
    asked: NDArray[np.float64]
    used: NDArray[np.int64]
    verdict: NDArray[np.uint8]
    counts: NDArray[np.uint32]
    one: NDArray[np.float64]
    saved_numbers: NDArray[np.int64]
    saved_values: NDArray[np.float64]
    saved_poses: NDArray[np.float64]


class AskedError(Exception):
    """Python has to answer a query; see `WalkMemory.log`."""


if nb.config.DISABLE_JIT:

    class WalkSettings(NamedTuple):
        """Options of a scene's effects, see `make_settings`."""

        up: NDArray[np.float64]
        continuous: bool
        skin: float
        tolerance: float
        slides: bool
        surfaces: int
        normal_reach: float
        lift: float
        walkable_slide: float
        step: float
        clearance: float
        near_reach: float
        down: float
        gravity: float
        max_speed: float
        walkable: float

    WalkMemory = WalkArrays

    class Walk(NamedTuple):
        """All that a frame reads and writes, see `walk_frame`."""

        settings: WalkSettings
        avatar: AvatarReference
        scratch: MotionScratch
        memory: WalkMemory
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
        standing: Any
        own: int

else:

    @nb.structref.register
    class _SettingsType(nb.types.StructRef):  # type: ignore[misc]
        """numba's type of `WalkSettings`."""

    @nb.structref.register
    class _MemoryType(nb.types.StructRef):  # type: ignore[misc]
        """numba's type of a `WalkMemory`."""

    @nb.structref.register
    class _WalkType(nb.types.StructRef):  # type: ignore[misc]
        """numba's type of a `Walk`."""

    class WalkSettings(nb.structref.StructRefProxy):  # type: ignore[misc,no-redef]
        """Options of a scene's effects, see `make_settings`."""

    class WalkMemory(nb.structref.StructRefProxy):  # type: ignore[misc,no-redef]
        """State of a frame, see `make_arrays`."""

    class Walk(nb.structref.StructRefProxy):  # type: ignore[misc,no-redef]
        """All that a frame reads and writes, see `walk_frame`."""

    nb.structref.define_proxy(WalkSettings, _SettingsType, _SETTINGS)
    nb.structref.define_proxy(WalkMemory, _MemoryType, list(WalkArrays._fields))
    nb.structref.define_proxy(Walk, _WalkType, _WALK)


@nb.njit(nogil=True, cache=True)
def make_settings(
    up, continuous, skin, tolerance, slides, surfaces, normal_reach, lift, walkable_slide, step, clearance,
    near_reach, down, gravity, max_speed, walkable,
):  # fmt: skip
    """Return the options of a scene's effects.

    up: (3,) unit.  continuous: whether motions are swept.  skin, tolerance: of sweeps [m].
    slides: whether there is `slide`.  surfaces, normal_reach: of `slide`; the reach also without it [m].
    lift: distance to move off a bump [m].  walkable_slide: least vertical component of a normal that
    `slide` does not treat as a wall's; below -1: there is no `ground`.
    step: height of `step` [m].  clearance: height of feet above the ground [m].  near_reach, down:
    distances of the first and the full search for ground [m].  gravity: [m/s^2].  max_speed: of
    falling [m/s].  walkable: least vertical component of the normal of ground.
    """
    return WalkSettings(
        up, continuous, skin, tolerance, slides, surfaces, normal_reach, lift, walkable_slide, step, clearance,
        near_reach, down, gravity, max_speed, walkable,
    )  # fmt: skip


def make_arrays(rows: int) -> WalkArrays:
    """Allocate the state of a frame. rows: of the tape.

    tape: (rows, ROW).  log, numbers, values, inputs, poses: with the elements above.
    old_plane: point and normal of the plane that the avatar stood on.  old_raised: place of its last raise.
    hits: (rows,), row of each recorded hit.  normals: (rows, 4), whether its normal is known, and it.
    asked_poses, asked: of the query that Python answers.  used: voxels of all queries.
    verdict, counts, one: scratch of `collide_resident`.  saved: state before a call.
    """
    return WalkArrays(
        tape=np.zeros((rows, ROW)),
        log=np.zeros(LOG, np.int64),
        numbers=np.zeros(NUMBERS, np.int64),
        values=np.zeros(VALUES),
        inputs=np.zeros(INPUTS),
        poses=np.zeros((POSES, 4, 4)),
        old_plane=np.zeros(6),
        old_raised=np.zeros(3),
        hits=np.zeros(rows, np.int64),
        normals=np.zeros((rows, 4)),
        asked_poses=np.zeros((2, 4, 4)),
        asked=np.zeros(16),
        used=np.zeros(_MOST_USED, np.int64),
        verdict=np.zeros(1, np.uint8),
        counts=np.zeros((3, 1), np.uint32),
        one=np.zeros((1, 4, 4)),
        saved_numbers=np.zeros(NUMBERS, np.int64),
        saved_values=np.zeros(VALUES),
        saved_poses=np.zeros((POSES, 4, 4)),
    )


@nb.njit(nogil=True, cache=True)
def refer_to_memory(arrays):
    """Return a reference to the state of a frame."""
    return WalkMemory(
        arrays.tape, arrays.log, arrays.numbers, arrays.values, arrays.inputs, arrays.poses, arrays.old_plane,
        arrays.old_raised, arrays.hits, arrays.normals, arrays.asked_poses, arrays.asked, arrays.used, arrays.verdict,
        arrays.counts, arrays.one, arrays.saved_numbers, arrays.saved_values, arrays.saved_poses,
    )  # fmt: skip


@nb.njit(nogil=True, cache=True)
def ask(memory, query):
    """Leave the frame for Python to answer a query."""
    memory.log[ASKED] = query
    raise AskedError


@nb.njit(nogil=True, cache=True)
def next_row(memory):
    """Return the row of the tape for the next query."""
    row = memory.numbers[AT]
    if row >= memory.tape.shape[0]:
        ask(memory, FULL)
    memory.numbers[AT] = row + 1
    return row


@nb.njit(nogil=True, cache=True)
def use_voxels(walk, count):
    """Record a use of the first `count` voxels of the last query."""
    memory, rows = walk.memory, walk.held.one.reach.lists.rows
    for n in range(count):
        row, known = rows[n], False
        for m in range(memory.log[USED]):
            known |= memory.used[m] == row
        if not known and memory.log[USED] < memory.used.shape[0]:
            memory.used[memory.log[USED]] = row
            memory.log[USED] += 1


@nb.njit(nogil=True, cache=True)
def pose_now(walk):
    """Return the pose (4, 4) that the frame has reached; callers do not write to it."""
    return walk.memory.poses[POSE]
