"""Blocking: what one mover meets of the bodies of a scene, as an `Obstacle` of one frame.

First the bounds of all bodies against those of the motion, in one kernel call of some microseconds; mostly nobody is
near. Then, exactly, those that are (kernels/meeting.py, kernels/pairs.py).

What is overlapped when the frame begins blocks only a translation that goes against `Bodies.way_out`: one along it,
across it, up or down is let, and so is a turn. So bodies that came to be in one place, by where they began or by an
object that was told to be there, get apart, and none is ever held.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...schemas.answers import Verdict
from ...schemas.units import UNITS_PER_METRE
from ..avatar import AvatarModel, make_avatar
from ..kernels.meeting import sweep_bodies
from ..kernels.near_bodies import find_near
from ..stop import NEVER, Stop
from ..vectors import dot, level, size, turned_by
from .bodies import USER, Bodies, Shape
from .frame import Body, Frame, Hit, Pose, Vec

# Of a way that is across what is overlapped: rounding is not going deeper.
_ACROSS = 1e-9


class _First(NamedTuple):
    """What ended a motion first. row: of the body.  witness: (2, 3) centres of the two spheres, world [m].  point: of
    the body's model that touches."""

    row: int
    fraction: float
    witness: NDArray[np.float64]
    point: int


class Blocking:
    """The bodies of some kinds, for one mover and one frame."""

    def __init__(
        self, name: str, bodies: Bodies, wanted: int, mover: str, model: AvatarModel, start: Pose,
        *, user: bool = True, margin_units: int = 0, skip: str = "", stop: Stop = NEVER,
    ) -> None:  # fmt: skip
        """name: of the effect.  wanted: kinds, bits.  mover: its name; user: whether it is one, or an object.

        start: where it is when the frame begins.  margin_units: apart, exact units.  skip: a user that does not block.
        stop: of the frame; once it is set, what is said is of no use.
        """
        self.name = name
        self._bodies, self._wanted, self._margin_units = bodies, wanted, margin_units
        self._mover, self._user, self._skip, self._stop = mover, user, skip, stop
        self._model, self._start = model, start.copy()
        self._layout = bodies.layout
        self._overlapped: dict[int, bool] = {}
        self._hits: list[Hit] = []

    def sweep(self, avatar: AvatarModel, pose_from: Pose, pose_to: Pose, tolerance: float) -> Hit | None:
        """What ends the motion first; see `Obstacle`. Of equal fractions the lowest row's."""
        hit = self._sweep(avatar, pose_from, pose_to, tolerance)
        if hit is not None:
            self._hits.append(hit)
        return hit

    def touches(self, avatar: AvatarModel, pose: Pose) -> Hit | None:
        """What is touched there, the lowest row; avatar and cloud of the hit are the two bodies' centres, level."""
        hit = self._touches(avatar, pose)
        if hit is not None:
            self._hits.append(hit)
        return hit

    def is_own(self, hit: Hit) -> bool:
        """Whether this said so."""
        return any(hit is own for own in self._hits)

    def _sweep(self, avatar: AvatarModel, pose_from: Pose, pose_to: Pose, tolerance: float) -> Hit | None:
        """`sweep`."""
        bodies = self._bodies
        with bodies.lock:
            shape = bodies.shape_of(avatar)
            ends = self._from_origin(pose_from), self._from_origin(pose_to)
            rows = self._near(shape, *ends)
            while len(rows):
                first = self._first(shape, ends, rows, tolerance)
                if first is None:
                    break
                if first.fraction > 0.0 or not self._is_overlapped(first.row):
                    return self._goes_deeper(shape, pose_from, pose_to) or self._hit_of(first)
                rows = rows[rows != first.row]
            return self._goes_deeper(shape, pose_from, pose_to)

    def _touches(self, avatar: AvatarModel, pose: Pose) -> Hit | None:
        """`touches`."""
        bodies = self._bodies
        with bodies.lock:
            shape = bodies.shape_of(avatar)
            there = self._from_origin(pose)
            rows = self._near(shape, there, there)
            if len(rows):
                rows = rows[bodies.touching(shape, pose, rows, self._margin_units, self._stop)]
            for row in rows.tolist():
                if not self._is_overlapped(row):
                    return self._hit_at(shape, pose, row)
            return self._goes_deeper(shape, self._start, pose)

    def overlaps(self, avatar: AvatarModel, pose: Pose) -> bool:
        """Whether any body is touched there, whatever the margin; those touched when the frame began, too."""
        bodies = self._bodies
        with bodies.lock:
            shape = bodies.shape_of(avatar)
            there = self._from_origin(pose)
            rows = self._in_reach(shape, there, there)
            return bool(len(rows) and bodies.touching(shape, pose, rows, 0, self._stop).any())

    def give_way(self, frame: Frame, hit: Hit, to: Pose) -> bool:
        """Nothing here does."""
        return False

    def _in_reach(self, shape: Shape, first: Pose, last: Pose) -> NDArray[np.int64]:
        """Rows that a motion, from the origin, could meet."""
        bodies = self._bodies
        rows = np.empty(len(bodies.names), np.int64)
        if not len(rows) or not len(shape.model.points):
            return rows[:0]
        own = bodies.row_of(self._mover, user=self._user)
        more = shape.model.radius + self._margin_units / UNITS_PER_METRE
        count = find_near(shape.box, first, last, more, bodies.bounds, bodies.kinds, self._wanted, own, rows)
        return rows[:count]

    def _near(self, shape: Shape, first: Pose, last: Pose) -> NDArray[np.int64]:
        """Rows that a motion, from the origin, could meet, but for those overlapped when the frame began."""
        bodies = self._bodies
        if self._layout != bodies.layout:
            self._layout, self._overlapped = bodies.layout, {}
        found = self._in_reach(shape, first, last)
        left_out = [row for row, overlapped in self._overlapped.items() if overlapped]
        if self._skip:
            left_out.append(bodies.row_of(self._skip, user=True))
        return found[~np.isin(found, left_out)] if len(found) and left_out else found

    def _from_origin(self, pose: Pose) -> Pose:
        """A pose with its translation from the bodies' origin."""
        there = np.array(pose, np.float64, order="C")
        there[:3, 3] -= self._bodies.origin
        return there

    def _first(
        self, shape: Shape, ends: tuple[Pose, Pose], rows: NDArray[np.int64], tolerance: float
    ) -> "_First | None":
        """What ends a motion first, of the bodies of these rows."""
        bodies, numbers = self._bodies, self._bodies.numbers[rows]
        best: _First | None = None
        until = np.inf
        while len(rows):
            same = numbers == numbers[0]
            other = bodies.shapes[int(rows[0])]
            if len(other.model.points):
                witness, named = np.empty((2, 3)), np.empty(2, np.int64)
                row, fraction = sweep_bodies(
                    shape.model.arrays, shape.box, shape.units, *ends, other.model.arrays, bodies.poses,
                    other.units, rows[same], bodies.origin, self._margin_units, tolerance, until, witness, named,
                    bodies.scratch, self._stop.flag,
                )  # fmt: skip
                if row >= 0:
                    best, until = (
                        _First(row, fraction, witness, int(other.model.rows[named[0], named[1]])),
                        fraction,
                    )
            rows, numbers = rows[~same], numbers[~same]
        return best

    def _hit_of(self, first: "_First") -> Hit:
        """What ended a motion; with the normal of its surface where it is an object."""
        bodies, row, (own, other) = self._bodies, first.row, first.witness
        normal = bodies.shapes[row].normal_at(first.point)
        if normal is not None:
            normal = turned_by(bodies.poses[row], normal)
            normal = -normal if dot(normal, own - other) < 0.0 else normal
        return Hit(first.fraction, Verdict.CONTACT, own, other, bodies.names[row], normal=normal)

    def _is_overlapped(self, row: int) -> bool:
        """Whether a body was touched where the mover was when the frame began."""
        found = self._overlapped.get(row)
        if found is None:
            bodies = self._bodies
            shape = bodies.shape_of(self._model)
            touching = bodies.touching(shape, self._start, np.array([row]), self._margin_units, self._stop)
            found = self._overlapped[row] = bool(touching[0])
        return found

    def _goes_deeper(self, shape: Shape, pose_from: Pose, pose_to: Pose) -> Hit | None:
        """What of that overlapped when the frame began the translation of a motion goes against the way out of."""
        way = pose_to[:3, 3] - pose_from[:3, 3]
        for row in sorted(row for row, overlapped in self._overlapped.items() if overlapped):
            out = self._out(row)
            if dot(way, out) < -_ACROSS * size(out) * size(way):
                center = shape.center(pose_from)
                return Hit(0.0, Verdict.CONTACT, center, center - out, self._bodies.names[row])
        return None

    def _out(self, row: int) -> Vec:
        """The way out of what the mover overlapped when the frame began."""
        bodies = self._bodies
        center = bodies.shape_of(self._model).center(self._start)
        return bodies.way_out(row, self._mover if self._user else "", center)

    def _hit_at(self, shape: Shape, pose: Pose, row: int) -> Hit:
        """A body touched at a pose: nothing is known of when, so that its middle says where, from the frame's start."""
        bodies, center = self._bodies, shape.center(pose)
        out = shape.center(self._start) - bodies.shapes[row].center(bodies.poses[row])
        return Hit(0.0, Verdict.CONTACT, center, center - level(out, bodies.up), bodies.names[row])


def warm() -> None:
    """Have the kernels compiled, before anybody waits for them."""
    model = make_avatar([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0]], 0.05)
    bodies = Bodies(np.zeros(3), np.array([0.0, 0.0, 1.0]))
    poses = [np.eye(4), np.eye(4)]
    poses[1][0, 3] = 1.0
    for name, pose in zip("ab", poses, strict=True):
        bodies[name] = Body(name, model, pose)
    blocking = Blocking("", bodies, USER, "a", model, poses[0])
    blocking.sweep(model, poses[0], poses[1], 1e-6)
    blocking.touches(model, poses[1])
    bodies.shape_of(model).normal_at(0)
