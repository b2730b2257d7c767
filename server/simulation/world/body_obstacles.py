"""BodyObstacle: the bodies of a scene that obstruct one mover, as an `Obstacle` of one frame.

First, one kernel call of some microseconds tests the bounds of all bodies against those of the
motion; usually no body is near. The kernel `walk_frame` makes this test itself, and asks an obstacle
only where a body is near. Near bodies are then tested exactly (kernels/bodies/body_sweep.py,
kernels/bodies/body_pairs.py).

A body that the mover overlaps when the frame begins blocks only a translation against
`Bodies.escape_direction`. A translation along it, across it, up or down is permitted, and so is a
turn. Bodies that overlap, by their initial poses or because a motion command placed an object
there, can therefore always separate.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ....schemas.archive.units import UNITS_PER_METRE
from ....schemas.wire.answers import Verdict
from ...avatars.avatar_model import AvatarModel, make_avatar
from ...kernels.bodies.body_pairs import bound_body, find_near_bodies
from ...kernels.bodies.body_sweep import sweep_bodies
from ...runtime.stop_flag import NO_STOP, StopFlag
from .bodies import USER, Bodies, Shape
from .frame import Body, Frame, Hit, Pose, Vec
from .vectors import dot, horizontal, norm, rotate

# Tolerance for a translation across an overlapped body, so that rounding does not count as deeper.
_ACROSS = 1e-9


class _FirstHit(NamedTuple):
    """First body that ends a motion.

    row: of the body.  fraction: of the motion.  witness: (2, 3) centres of the two spheres, world
    [m].  point: number of the touching point of the body's model.
    """

    row: int
    fraction: float
    witness: NDArray[np.float64]
    point: int


class BodyObstacle:
    """Bodies of some kinds, as obstacles for one mover and one frame.

    `Hit.what` names the body. A body that was touched when the frame began blocks only motions that
    go deeper into it. For other motions, neither `sweep` nor `touches` reports it.
    """

    def __init__(
        self, name: str, bodies: Bodies, wanted: int, mover: str, model: AvatarModel, start: Pose,
        *, user: bool = True, margin_units: int = 0, skip: str = "", stop: StopFlag = NO_STOP,
    ) -> None:  # fmt: skip
        """Prepare the obstacle. Its attributes `bodies`, `wanted` and `margin_units` are those given.

        name: of the effect.  wanted: kinds of bodies, bits.  mover: name of the mover.
        model, start: of the mover: its avatar, and its pose (4, 4) when the frame begins.
        user: whether the mover is a user; False for an object.
        margin_units: distance to keep, exact units.  skip: name of a user that does not block.
        stop: stop flag of the frame; once it is set, results are meaningless.
        """
        self.name = name
        self.bodies, self.wanted, self.margin_units = bodies, wanted, margin_units
        self._mover, self._user, self._skip, self._stop = mover, user, skip, stop
        self._model, self._start = model, start.copy()
        self._layout = bodies.layout
        self._overlapped: dict[int, bool] = {}
        self._hits: list[Hit] = []

    def sweep(
        self, avatar: AvatarModel, pose_from: Pose, pose_to: Pose, tolerance: float, *, below: bool = False
    ) -> Hit | None:
        """Return the hit that ends the motion first; of equals, that of the lowest row; None if none does.

        Nothing is touched before the hit's fraction.
        below: leave out bodies beside the avatar.
        """
        hit = self._sweep(avatar, pose_from, pose_to, tolerance, below=below)
        if hit is not None:
            self._hits.append(hit)
        return hit

    def touches(self, avatar: AvatarModel, pose: Pose) -> Hit | None:
        """Return the hit of the touched body with the lowest row; None if no body is touched.

        `avatar` and `cloud` of the hit are the two bodies' centres at the same height.
        """
        hit = self._touches(avatar, pose)
        if hit is not None:
            self._hits.append(hit)
        return hit

    @property
    def margin(self) -> float:
        """Return the distance within which the kernel `walk_frame` has to ask about a body [m].

        It is infinite once a body is known to have been overlapped when the frame began: whether a
        motion leads deeper does not depend on its bounds.
        """
        return math.inf if any(self._overlapped.values()) else self.margin_units / UNITS_PER_METRE

    def is_own(self, hit: Hit) -> bool:
        """Return whether this obstacle reported the hit."""
        return any(hit is own for own in self._hits)

    def _sweep(
        self, avatar: AvatarModel, pose_from: Pose, pose_to: Pose, tolerance: float, *, below: bool
    ) -> Hit | None:
        """Implement `sweep`."""
        bodies = self.bodies
        with bodies.lock:
            shape = bodies.shape_of(avatar)
            ends = self._from_origin(pose_from), self._from_origin(pose_to)
            rows = self._near(shape, pose_from, pose_to)
            if below and len(rows):
                rows = rows[~self._beside(shape, pose_from, rows)]
            while len(rows):
                first = self._first(shape, ends, rows, tolerance)
                if first is None:
                    break
                if first.fraction > 0.0 or not self._is_overlapped(first.row):
                    return self._deepening_hit(shape, pose_from, pose_to) or self._hit_of(first)
                rows = rows[rows != first.row]
            return self._deepening_hit(shape, pose_from, pose_to)

    def _touches(self, avatar: AvatarModel, pose: Pose) -> Hit | None:
        """Implement `touches`."""
        bodies = self.bodies
        with bodies.lock:
            shape = bodies.shape_of(avatar)
            rows = self._near(shape, pose, pose)
            if len(rows):
                rows = rows[bodies.touching(shape, pose, rows, self.margin_units, self._stop)]
            for row in rows.tolist():
                if not self._is_overlapped(row):
                    return self._hit_at(shape, pose, row)
            return self._deepening_hit(shape, self._start, pose)

    def overlaps(self, avatar: AvatarModel, pose: Pose) -> bool:
        """Return whether any body is touched at a pose, without the margin.

        Bodies that were touched when the frame began count too.
        """
        bodies = self.bodies
        with bodies.lock:
            shape = bodies.shape_of(avatar)
            rows = self._in_reach(shape, pose, pose)
            return bool(len(rows) and bodies.touching(shape, pose, rows, 0, self._stop).any())

    def give_way(self, frame: Frame, hit: Hit, to: Pose) -> bool:
        """Move the body that ended a motion, if possible; return whether to try the motion again.

        Called for each hit. The avatar is at frame.pose and on its way to `to`. None of these bodies
        gives way.
        """
        return False

    def _in_reach(self, shape: Shape, first: Pose, last: Pose) -> NDArray[np.int64]:
        """Return the rows (m,) whose bounds a motion may touch."""
        bodies = self.bodies
        rows = np.empty(len(bodies.names), np.int64)
        if not len(rows) or not len(shape.model.points):
            return rows[:0]
        own = bodies.row_of(self._mover, user=self._user)
        more = shape.model.radius + self.margin_units / UNITS_PER_METRE
        count = find_near_bodies(
            shape.model.box,
            np.ascontiguousarray(first),
            np.ascontiguousarray(last),
            bodies.origin,
            more,
            bodies.bounds,
            bodies.kinds,
            self.wanted,
            own,
            rows,
        )
        return rows[:count]

    def _near(self, shape: Shape, first: Pose, last: Pose) -> NDArray[np.int64]:
        """Return the rows of `_in_reach`, except those overlapped when the frame began."""
        bodies = self.bodies
        if self._layout != bodies.layout:
            self._layout, self._overlapped = bodies.layout, {}
        found = self._in_reach(shape, first, last)
        left_out = [row for row, overlapped in self._overlapped.items() if overlapped]
        if self._skip:
            left_out.append(bodies.row_of(self._skip, user=True))
        return found[~np.isin(found, left_out)] if len(found) and left_out else found

    def _beside(self, shape: Shape, pose: Pose, rows: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Return which bodies (m,) stand beside the avatar: their tops are above the middle of its height."""
        bodies, own = self.bodies, np.empty((2, 3))
        bound_body(shape.model.box, np.ascontiguousarray(pose), bodies.origin, shape.model.radius, own)
        tops = np.maximum(bodies.bounds[rows, 0] * bodies.up, bodies.bounds[rows, 1] * bodies.up).sum(axis=1)
        heights = np.sort(own * bodies.up, axis=0).sum(axis=1)
        beside: NDArray[np.bool_] = tops > heights.mean()
        return beside

    def _from_origin(self, pose: Pose) -> Pose:
        """Return a pose with its translation relative to the bodies' origin."""
        there = np.array(pose, np.float64, order="C")
        there[:3, 3] -= self.bodies.origin
        return there

    def _first(
        self, shape: Shape, ends: tuple[Pose, Pose], rows: NDArray[np.int64], tolerance: float
    ) -> "_FirstHit | None":
        """Return the first hit of a motion with the bodies of these rows; None if there is none."""
        bodies, numbers = self.bodies, self.bodies.numbers[rows]
        best: _FirstHit | None = None
        until = np.inf
        while len(rows):
            same = numbers == numbers[0]
            other = bodies.shapes[int(rows[0])]
            if len(other.model.points):
                witness, named = np.empty((2, 3)), np.empty(2, np.int64)
                row, fraction = sweep_bodies(
                    shape.model.arrays, shape.model.box, shape.units, *ends, other.model.arrays, bodies.poses,
                    other.units, rows[same], bodies.origin, self.margin_units, tolerance, until, witness, named,
                    bodies.scratch, self._stop.flag,
                )  # fmt: skip
                if row >= 0:
                    best, until = (
                        _FirstHit(row, fraction, witness, int(other.model.rows[named[0], named[1]])),
                        fraction,
                    )
            rows, numbers = rows[~same], numbers[~same]
        return best

    def _hit_of(self, first: "_FirstHit") -> Hit:
        """Return the hit of the body that ended a motion, with its normal for an object."""
        bodies, row, (own, other) = self.bodies, first.row, first.witness
        normal = bodies.shapes[row].normal_at(first.point)
        if normal is not None:
            normal = rotate(bodies.poses[row], normal)
            normal = -normal if dot(normal, own - other) < 0.0 else normal
        return Hit(first.fraction, Verdict.CONTACT, own, other, bodies.names[row], normal=normal)

    def _is_overlapped(self, row: int) -> bool:
        """Return whether the mover touched a body when the frame began."""
        found = self._overlapped.get(row)
        if found is None:
            bodies = self.bodies
            shape = bodies.shape_of(self._model)
            touching = bodies.touching(shape, self._start, np.array([row]), self.margin_units, self._stop)
            found = self._overlapped[row] = bool(touching[0])
        return found

    def _deepening_hit(self, shape: Shape, pose_from: Pose, pose_to: Pose) -> Hit | None:
        """Return a hit if a motion leads deeper into a body that was overlapped at the start.

        It does if its translation is directed against the body's `_out`. Return None otherwise.
        """
        way = pose_to[:3, 3] - pose_from[:3, 3]
        for row in sorted(row for row, overlapped in self._overlapped.items() if overlapped):
            out = self._out(row)
            if dot(way, out) < -_ACROSS * norm(out) * norm(way):
                center = shape.center(pose_from)
                return Hit(0.0, Verdict.CONTACT, center, center - out, self.bodies.names[row])
        return None

    def _out(self, row: int) -> Vec:
        """Return the direction out of a body that the mover overlapped when the frame began."""
        bodies = self.bodies
        center = bodies.shape_of(self._model).center(self._start)
        return bodies.escape_direction(row, self._mover if self._user else "", center)

    def _hit_at(self, shape: Shape, pose: Pose, row: int) -> Hit:
        """Return the hit of a body touched at a pose.

        The contact point is unknown, so the position is derived from the body's centre and the
        frame's start.
        """
        bodies, center = self.bodies, shape.center(pose)
        out = shape.center(self._start) - bodies.shapes[row].center(bodies.poses[row])
        return Hit(0.0, Verdict.CONTACT, center, center - horizontal(out, bodies.up), bodies.names[row])


def warm_kernels() -> None:
    """Compile the kernels before the first request needs them."""
    model = make_avatar([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0]], 0.05)
    bodies = Bodies(np.zeros(3), np.array([0.0, 0.0, 1.0]))
    poses = [np.eye(4), np.eye(4)]
    poses[1][0, 3] = 1.0
    for name, pose in zip("ab", poses, strict=True):
        bodies[name] = Body(name, model, pose)
    blocking = BodyObstacle("", bodies, USER, "a", model, poses[0])
    blocking.sweep(model, poses[0], poses[1], 1e-6)
    blocking.touches(model, poses[1])
    bodies.shape_of(model).normal_at(0)
