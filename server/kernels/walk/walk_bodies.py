"""Other users as obstacles of a walking avatar, in compiled code.

Users block one another in most frames of a crowd, and to ask Python about each motion took more than half
of such a frame. What is answered here is what BodyObstacle answers (simulation/world/body_obstacles.py)
while all bodies have the mover's own avatar, and none was touched when the frame began. Else Python is asked.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ....schemas.kernels import compiling as nb
from ..bodies.body_pairs import CLEAR, STACK, bound_body, find_near_bodies, touch_bodies
from ..bodies.body_sweep import sweep_bodies
from ..bodies.moving_bodies import BodyScratch, make_body_scratch
from ..core.scene_arrays import LANES
from .walk_state import (
    APART,
    ASKS,
    BEGIN,
    BODIES_HIT,
    BODIES_SWEPT,
    HIT_FRACTION,
    HIT_PAIR,
    HIT_POINT,
    HIT_ROW,
    pose_now,
)

_FIELDS = [
    "box", "units", "margin_units", "radius", "reach", "wanted", "poses", "bounds", "kinds", "origin", "up",
    "scratch", "rows", "nodes", "at", "lanes", "ends", "witness", "named",
]  # fmt: skip

if nb.config.DISABLE_JIT:

    class StandingBodies(NamedTuple):
        """Bodies that may block one avatar, and scratch; see `refer_to_bodies`."""

        box: NDArray[np.float64]
        units: int
        margin_units: int
        radius: float
        reach: float
        wanted: int
        poses: NDArray[np.float64]
        bounds: NDArray[np.float64]
        kinds: NDArray[np.uint8]
        origin: NDArray[np.float64]
        up: NDArray[np.float64]
        scratch: BodyScratch
        rows: NDArray[np.int64]
        nodes: NDArray[np.int64]
        at: NDArray[np.float64]
        lanes: NDArray[np.float32]
        ends: NDArray[np.float64]
        witness: NDArray[np.float64]
        named: NDArray[np.int64]

else:

    @nb.structref.register
    class _StandingType(nb.types.StructRef):  # type: ignore[misc]
        """numba's type of `StandingBodies`."""

    class StandingBodies(nb.structref.StructRefProxy):  # type: ignore[misc,no-redef]
        """Bodies that may block one avatar, and scratch; see `refer_to_bodies`."""

    nb.structref.define_proxy(StandingBodies, _StandingType, _FIELDS)


@nb.njit(nogil=True, cache=True)
def refer_to_bodies(
    box, units, margin_units, radius, reach, wanted, poses, bounds, kinds, origin, up, scratch
):
    """Return a reference to the bodies that may block an avatar, all of that avatar.

    box: (2, 3) of the avatar [m].  units, radius: of its spheres, exact units and metres.  margin_units:
    distance to keep.  reach: radius plus margin [m].  wanted, poses, bounds, kinds, origin, up: as in
    `Bodies`.  scratch: `BodyScratch` for the avatar.
    """
    return StandingBodies(
        box, units, margin_units, radius, reach, wanted, poses, bounds, kinds, origin, up, scratch,
        np.empty(poses.shape[0], np.int64), np.empty((STACK, 2), np.int64), np.empty((STACK, 6)),
        np.empty((2, 3, LANES), np.float32), np.empty((2, 4, 4)), np.empty((2, 3)), np.empty(2, np.int64),
    )  # fmt: skip


def no_bodies() -> StandingBodies:
    """Return a reference to no bodies, of the type of others."""
    return refer_to_bodies(
        np.zeros((2, 3)), 0, 0, 0.0, 0.0, 0, np.empty((0, 4, 4)), np.empty((0, 2, 3)), np.empty(0, np.uint8),
        np.zeros(3), np.zeros(3), make_body_scratch(1, 1),
    )  # fmt: skip


@nb.njit(nogil=True, cache=True)
def _near_bodies(standing, own, pose_from, pose_to):
    """Write the ends of a motion relative to the origin, and the rows near it; return their number."""
    ends, origin = standing.ends, standing.origin
    for r in range(4):
        for c in range(4):
            ends[0, r, c], ends[1, r, c] = pose_from[r, c], pose_to[r, c]
    for r in range(3):
        ends[0, r, 3] -= origin[r]
        ends[1, r, 3] -= origin[r]
    return find_near_bodies(
        standing.box, ends[0], ends[1], standing.reach, standing.bounds, standing.kinds, standing.wanted, own,
        standing.rows,
    )  # fmt: skip


@nb.njit(nogil=True, cache=True)
def _leave_out_beside(standing, count):
    """Remove the bodies beside the avatar from the near rows, as `BodyObstacle` does; return their number."""
    own, up, bounds, middle, kept = np.empty((2, 3)), standing.up, standing.bounds, 0.0, 0
    bound_body(standing.box, standing.ends[0], np.zeros(3), standing.radius, own)
    for side in range(2):
        height = 0.0
        for r in range(3):
            one, other = own[0, r] * up[r], own[1, r] * up[r]
            height += min(one, other) if side == 0 else max(one, other)
        middle += height
    for at in range(count):
        row, top = standing.rows[at], 0.0
        for r in range(3):
            top += max(bounds[row, 0, r] * up[r], bounds[row, 1, r] * up[r])
        if not top > middle / 2.0:
            standing.rows[kept] = row
            kept += 1
    return kept


@nb.njit(nogil=True, cache=True)
def find_first_body(walk, standing, to, tolerance, below, until):
    """Return the query for Python about the first body in the way to a pose (4, 4); -1 if there is none.

    standing: that of the walk.  until: fraction from which bodies do not matter.  below: leave out
    bodies beside the avatar.
    For BODIES_HIT, writes the hit to `asked`.
    """
    if walk.own == ASKS:
        return BODIES_SWEPT
    memory, begin = walk.memory, pose_now(walk)
    count = _near_bodies(standing, walk.own, begin, to)
    if below:
        count = _leave_out_beside(standing, count)
    row, fraction = -1, np.inf
    if count > 0:
        avatar = walk.avatar.avatar
        row, fraction = sweep_bodies(
            avatar, standing.box, standing.units, standing.ends[0], standing.ends[1], avatar, standing.poses,
            standing.units, standing.rows[:count], standing.origin, standing.margin_units, tolerance, np.inf,
            standing.witness, standing.named, standing.scratch, walk.stop,
        )  # fmt: skip
    if row >= 0 and fraction <= 0.0:
        return BODIES_SWEPT  # it may have been touched when the frame began
    if not below:
        starts = True
        for r in range(4):
            for c in range(4):
                starts &= begin[r, c] == memory.poses[BEGIN, r, c]
        if starts:
            memory.log[APART] = 1
    if row < 0 or not fraction < until:
        return -1
    asked = memory.asked
    asked[HIT_ROW], asked[HIT_FRACTION] = row, fraction
    for side in range(2):
        for r in range(3):
            asked[HIT_PAIR + 3 * side + r] = standing.witness[side, r]
    asked[HIT_POINT], asked[HIT_POINT + 1] = standing.named[0], standing.named[1]
    return BODIES_HIT


@nb.njit(nogil=True, cache=True)
def is_clear_of_bodies(walk, standing, pose):
    """Return whether no body is touched at a pose (4, 4); False also if Python has to be asked."""
    if walk.own == ASKS:
        return False
    avatar = walk.avatar.avatar
    units, poses = standing.units + standing.units + standing.margin_units, standing.poses
    for at in range(_near_bodies(standing, walk.own, pose, pose)):
        verdict = touch_bodies(
            avatar, pose, avatar, poses[standing.rows[at]], units, standing.origin, walk.stop,
            standing.nodes, standing.at, standing.lanes, standing.scratch.counters,
        )  # fmt: skip
        if verdict != CLEAR:
            return False
    return True
