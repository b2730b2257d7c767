"""Bodies: everything that moves in one scene, users and objects, with their current poses.

A simulation has at most one `Bodies`. It updates a user after each of its frames (`put_user`), and the
objects that motion commands place (`place_objects`).

Effects query the bodies through a `BodyObstacle`: those that obstruct one mover during one frame.
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
import threading
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ....schemas.archive.rigid_pose import rigid_pose
from ....schemas.archive.units import UNITS_PER_METRE
from ....schemas.errors import BadRequestError
from ....schemas.scene.effect_table import Slide
from ....schemas.wire.answers import Verdict
from ...avatars.avatar_model import AvatarModel, make_avatar
from ...kernels.bodies.body_pairs import CONTACT, bound_body, find_near_bodies, touch_pairs
from ...kernels.bodies.body_sweep import make_body_scratch, sweep_bodies
from ...kernels.core.normal_codes import NO_NORMAL, decode_normal, normal_code
from ...kernels.core.placed_avatar import MAX_REACH_UNITS
from ...queries.query_inputs import to_units
from ...runtime.stop_flag import NO_STOP, StopFlag
from .frame import Body, Frame, Hit, Pose, Vec, dot, horizontal, norm, rotate, rotate_back

USER, KINEMATIC, PUSHED = 1, 2, 4  # kinds, one bit each
# Points within this distance determine the normal of a surface [m], as `slide` has it unless told otherwise.
SURFACE_REACH = Slide().normal_reach
# Number of cached shapes of avatars that belong to no body, beyond which they are dropped.
_MAX_LOOSE_SHAPES = 64
# Tolerance for a translation across an overlapped body, so that rounding does not count as deeper.
_ACROSS = 1e-9


class Shape(NamedTuple):
    """Avatar's model with the data of the broad phase.

    units: its radius, exact units.  normals: normals computed so far, by point.
    """

    model: AvatarModel
    units: int
    normals: dict[int, Vec | None]

    def center(self, pose: Pose) -> Vec:
        """Return the placed centre of its box."""
        placed: Vec = rotate(pose, 0.5 * (self.model.box[0] + self.model.box[1])) + pose[:3, 3]
        return placed

    def normal_at(self, point: int) -> Vec | None:
        """Return a unit normal (3,) of the surface at a point, of either sign, avatar frame.

        Return None if the points form no surface. The normal is computed as for a scan
        (kernels/core/normal_codes.py), with exact units as the lattice.
        """
        if point not in self.normals:
            points = self.model.points
            apart = points[: len(points) - self.model.inner_points] - points[point]
            near = np.rint(apart[(apart * apart).sum(axis=1) <= SURFACE_REACH**2] * UNITS_PER_METRE).astype(
                np.int64
            )
            x, y, z = near.T
            products = [x * x, y * y, z * z, y * z, z * x, x * y]
            code = normal_code(np.array([len(near), *(c.sum() for c in (x, y, z, *products))], np.int64))
            self.normals[point] = None if code == NO_NORMAL else np.array(decode_normal(code))
        return self.normals[point]


class Bodies:
    """Bodies by row: the initial objects, then users in order of arrival.

    origin: (3,), the scene's origin, relative to which bodies are placed [m].  up: (3,) unit.
    lock: held during queries and changes, because a move that keeps no state may run at the same
    time as a frame.
    names, kinds (n,) uint8, shapes: by row.  poses: (n, 4, 4), world.
    bounds: (n, 2, 3), relative to the origin, radius included [m].
    changed: value of `clock` at the last move of each row.
    clock: counts moves.  layout: counts arrivals and departures of bodies, which change rows.
    """

    def __init__(self, origin: Vec, up: Vec) -> None:
        """Create an empty set of bodies."""
        self.origin, self.up = np.array(origin, np.float64), np.array(up, np.float64)
        self.lock = threading.RLock()
        self.scratch = make_body_scratch(1, 1)
        self.names: list[str] = []
        self.kinds = np.empty(0, np.uint8)
        self.poses = np.empty((0, 4, 4))
        self.bounds = np.empty((0, 2, 3))
        self.shapes: list[Shape] = []
        self.changed: list[int] = []
        self.clock = self.layout = 0
        self._rows: dict[tuple[bool, str], int] = {}
        self._known: dict[tuple[int, float], Shape] = {}
        # By user and object, see `_remember_origin`.
        self._came_from: dict[tuple[str, str], Vec] = {}

    # --- shapes --------------------------------------------------------------------------------

    def shape_of(self, model: AvatarModel) -> Shape:
        """Return the cached shape of a model; models of the same arrays and radius share it."""
        key = id(model.arrays), model.radius  # a cached shape keeps its arrays
        if key in self._known:
            return self._known[key]
        if len(self._known) > _MAX_LOOSE_SHAPES + len(self.names):
            self._known = {(id(kept.model.arrays), kept.model.radius): kept for kept in self.shapes}
        units = to_units(model.radius, "radius")
        if units > MAX_REACH_UNITS // 4:
            raise BadRequestError(
                f"avatar radius {model.radius:g} m: expected at most 4 m with crowd or objects"
            )
        nodes = max(len(model.arrays.radius), self.scratch.moving.shape[1])
        blocks = max(len(model.arrays.points), len(self.scratch.lanes))
        if nodes > self.scratch.moving.shape[1] or blocks > len(self.scratch.lanes):
            counters = self.scratch.counters
            self.scratch = make_body_scratch(nodes, blocks)
            self.scratch.counters[:] = counters
        shape = self._known[key] = Shape(model, units, {})
        return shape

    def by_shape(self, rows: NDArray[np.int64]) -> list[tuple[Shape, NDArray[np.int64]]]:
        """Return each shape of the bodies of rows (m,) that has points, and its places among the rows."""
        found: dict[int, tuple[Shape, list[int]]] = {}
        for place, row in enumerate(rows.tolist()):
            shape = self.shapes[row]
            found.setdefault(id(shape), (shape, []))[1].append(place)
        return [(shape, np.array(places)) for shape, places in found.values() if len(shape.model.points)]

    # --- arrivals and departures ---------------------------------------------------------------

    def put_user(self, body: Body) -> None:
        """Add a user, by the name of its body, or update its pose."""
        with self.lock:
            row = self._rows.get((True, body.name))
            if row is None:
                self._add(body.name, USER, body.avatar, body.pose)
                return
            self.shapes[row] = self.shape_of(body.avatar)
            self.put(row, body.pose)

    def remove_user(self, name: str) -> None:
        """Remove a user, if it is present; the numbers of later rows decrease by one."""
        with self.lock:
            row = self.row_of(name, user=True)
            if row < 0:
                return
            for rows in (self.names, self.shapes, self.changed):
                del rows[row]  # type: ignore[attr-defined]
            self.kinds = np.delete(self.kinds, row)
            self.poses, self.bounds = np.delete(self.poses, row, axis=0), np.delete(self.bounds, row, axis=0)
            self._rows = {(bool(self.kinds[at] == USER), each): at for at, each in enumerate(self.names)}
            self._came_from = {key: way for key, way in self._came_from.items() if key[0] != name}
            self.layout += 1

    def add_object(self, name: str, model: AvatarModel, pose: Pose, *, pushed: bool) -> None:
        """Add an object at its initial pose; BadTransformError unless the pose is rigid."""
        with self.lock:
            self._add(name, PUSHED if pushed else KINEMATIC, model, rigid_pose(pose, f"object {name!r}"))

    def row_of(self, name: str, *, user: bool) -> int:
        """Return the row of a user or an object, or -1."""
        return self._rows.get((user, name), -1)

    def _add(self, name: str, kind: int, model: AvatarModel, pose: Pose) -> None:
        """Append a row."""
        row = len(self.names)
        shape = self.shape_of(model)
        self.names.append(name)
        self.shapes.append(shape)
        self.changed.append(0)
        self.kinds = np.append(self.kinds, np.uint8(kind))
        self.poses = np.concatenate([self.poses, np.eye(4)[None]])
        self.bounds = np.concatenate([self.bounds, np.zeros((1, 2, 3))])
        self._rows[kind == USER, name] = row
        self.layout += 1
        self._set(row, pose)

    # --- poses ---------------------------------------------------------------------------------

    def restorer(self) -> Callable[[], None]:
        """Return a function that restores the poses of now, for a command that is refused or stopped.

        No body may arrive or leave before it is called.
        """
        with self.lock:
            poses, came_from = self.poses.copy(), dict(self._came_from)

        def restore() -> None:
            with self.lock:
                for row in np.flatnonzero((poses != self.poses).any(axis=(1, 2))).tolist():
                    self.put(row, poses[row])
                self._came_from = came_from

        return restore

    def put(self, row: int, pose: Pose) -> None:
        """Set the pose of a body."""
        with self.lock:
            if (self.poses[row] != pose).any():
                self._set(row, pose)
                self.clock += 1
                self.changed[row] = self.clock

    def _set(self, row: int, pose: Pose) -> None:
        """Set the pose of a body and its bounds."""
        self.poses[row] = pose
        model = self.shapes[row].model
        if len(model.points):
            bound_body(model.box, self.poses[row], self.origin, model.radius, self.bounds[row])
        else:
            self.bounds[row, 0], self.bounds[row, 1] = np.inf, -np.inf

    def place_objects(self, poses: Mapping[str, Sequence[Sequence[float]]], stop: StopFlag = NO_STOP) -> None:
        """Place objects where a motion command puts them, even into users.

        A user that is touched then starts its next frame in contact.
        poses: (4, 4) row-major by name. All are checked before any is set: BadRequestError,
        BadTransformError.
        """
        with self.lock:
            checked = [
                (self._kinematic_row(name), rigid_pose(poses[name], f"object {name!r}"))
                for name in sorted(poses)
            ]
            for row, pose in checked:
                before = self.poses[row].copy()
                self.put(row, pose)
                self._remember_origin(row, before, stop)

    def _kinematic_row(self, name: str) -> int:
        """Return the row of an object that motion commands may place, else BadRequestError."""
        row = self.row_of(name, user=False)
        if row < 0 or self.kinds[row] != KINEMATIC:
            told = [each for each, kind in zip(self.names, self.kinds, strict=True) if kind == KINEMATIC]
            found = "is not in this scene" if row < 0 else "is pushed by users and cannot be placed"
            raise BadRequestError(
                f"object {name!r} {found}: expected a kinematic object: {', '.join(told) or 'the scene has none'}"
            )
        return row

    def _remember_origin(self, thing: int, before: Pose, stop: StopFlag) -> None:
        """Store the direction from which a placed object moved into each user that it touches.

        The direction is in the object's frame. `escape_direction` uses it.
        """
        bounds, now = self.bounds, self.poses[thing]
        apart = (bounds[:, 0] > bounds[thing, 1]) | (bounds[:, 1] < bounds[thing, 0])
        near = np.flatnonzero((self.kinds == USER) & ~apart.any(axis=1))
        if not len(near):
            return
        touching = self.touching(self.shapes[thing], now, near, 0, stop)
        touching &= ~self.touching(self.shapes[thing], before, near, 0, stop)
        for row in near[touching].tolist():
            center = self.shapes[row].center(self.poses[row])
            own = [rotate_back(pose, center - pose[:3, 3]) for pose in (before, now)]
            self._came_from[self.names[row], self.names[thing]] = own[0] - own[1]

    def escape_direction(self, row: int, user: str, center: Vec) -> Vec:
        """Return the horizontal direction (3,) in which a mover separates from a body it overlaps.

        The direction is away from the body's centre. For an object that was moved into a user, it
        is the direction from which the object came, which does not lead through it. Zeros: every
        direction is allowed.
        center: (3,) of the mover.  user: the mover's name, "" for an object.
        """
        came_from = self._came_from.get((user, self.names[row])) if self.kinds[row] != USER else None
        pose = self.poses[row]
        way = center - self.shapes[row].center(pose) if came_from is None else rotate(pose, came_from)
        return horizontal(way, self.up)

    def touching(
        self, shape: Shape, pose: Pose, rows: NDArray[np.int64], margin_units: int, stop: StopFlag = NO_STOP
    ) -> NDArray[np.bool_]:
        """Return the mask (m,) of rows (m,) whose bodies an avatar at a pose touches.

        The test is exact, by the definition of contact. The result is meaningless once `stop` is
        set.
        """
        found = np.zeros(len(rows), bool)
        if not len(shape.model.points):
            return found
        for other, places in self.by_shape(rows):
            poses = np.concatenate([pose[None], self.poses[rows[places]]])
            pairs = np.stack([np.zeros(len(places), np.int64), np.arange(1, len(places) + 1)], axis=1)
            units = np.array([shape.units, *[other.units] * len(places)], np.int64)
            verdict = np.empty(len(places), np.uint8)
            touch_pairs(
                shape.model.arrays, other.model.arrays, poses, units, pairs, margin_units, self.origin,
                stop.flag, verdict, self.scratch.counters,
            )  # fmt: skip
            found[places] = verdict == CONTACT
        return found


class BodyObstacle:
    """Bodies of some kinds, as obstacles for one mover and one frame.

    `Hit.what` names the body. A body that was touched when the frame began blocks only motions that
    go deeper into it. For other motions, neither `sweep` nor `touches` reports it.
    """

    def __init__(
        self, bodies: Bodies, wanted: int, mover: Body, stop: StopFlag = NO_STOP,
        *, user: bool = True, margin_units: int = 0, skip: str = "",
        give_way: Callable[[Frame, Hit, Pose], bool] = lambda frame, hit, to: False,
    ) -> None:  # fmt: skip
        """Prepare the obstacle. Its attributes `bodies`, `wanted` and `margin_units` are those given.

        wanted: kinds of bodies, bits.  mover: as it is when the frame begins.
        stop: stop flag of the frame; once it is set, results are meaningless.
        user: whether the mover is a user; False for an object.
        margin_units: distance to keep, exact units.  skip: name of a user that does not block.
        give_way: moves the body that ended a motion, if possible, and returns whether to try the motion
        again. Called for each hit; the avatar is at frame.pose, on its way to a pose.
        """
        self.bodies, self.wanted, self.margin_units = bodies, wanted, margin_units
        self._mover, self._user, self._skip, self._stop = mover.name, user, skip, stop
        self._model, self._start = mover.avatar, mover.pose.copy()
        self.give_way = give_way
        self._layout = bodies.layout
        self._overlapped: dict[int, bool] = {}

    @property
    def margin(self) -> float:
        """Return the distance within which the kernel `walk_frame` has to ask about a body [m].

        It is infinite once a body is known to have been overlapped when the frame began: whether a
        motion leads deeper does not depend on its bounds.
        """
        return math.inf if any(self._overlapped.values()) else self.margin_units / UNITS_PER_METRE

    def sweep(self, pose_from: Pose, pose_to: Pose, tolerance: float, *, below: bool = False) -> Hit | None:
        """Return the hit that ends a motion first; of equals, that of the lowest row; None if none does.

        Nothing is touched before the hit's fraction.
        below: leave out bodies beside the avatar.
        """
        with self.bodies.lock:
            ends = self._from_origin(pose_from), self._from_origin(pose_to)
            rows = self._near(pose_from, pose_to)
            if below and len(rows):
                rows = rows[~self._beside(pose_from, rows)]
            while len(rows):
                row, first = self._first(ends, rows, tolerance)
                if first is None:
                    break
                if first.fraction > 0.0 or not self._is_overlapped(row):
                    return self._deepening_hit(pose_from, pose_to) or first
                rows = rows[rows != row]
            return self._deepening_hit(pose_from, pose_to)

    def touches(self, pose: Pose) -> Hit | None:
        """Return the hit of the touched body with the lowest row; None if no body is touched.

        `avatar` and `cloud` of the hit are the two bodies' centres at the same height: the contact point
        is unknown, so the latter is derived from the body's centre and the frame's start.
        """
        bodies = self.bodies
        with bodies.lock:
            shape, rows = self._shape, self._near(pose, pose)
            if len(rows):
                rows = rows[bodies.touching(shape, pose, rows, self.margin_units, self._stop)]
            for row in rows.tolist():
                if not self._is_overlapped(row):
                    out = shape.center(self._start) - bodies.shapes[row].center(bodies.poses[row])
                    return self._hit(row, shape.center(pose), horizontal(out, bodies.up))
            return self._deepening_hit(self._start, pose)

    def overlaps(self, pose: Pose) -> bool:
        """Return whether any body is touched at a pose, without the margin.

        Bodies that were touched when the frame began count too.
        """
        bodies = self.bodies
        with bodies.lock:
            rows = self._in_reach(pose, pose)
            return bool(len(rows) and bodies.touching(self._shape, pose, rows, 0, self._stop).any())

    @property
    def _shape(self) -> Shape:
        """Return the shape of the mover."""
        return self.bodies.shape_of(self._model)

    def _in_reach(self, first: Pose, last: Pose) -> NDArray[np.int64]:
        """Return the rows (m,) whose bounds a motion may touch."""
        bodies, model = self.bodies, self._model
        rows = np.empty(len(bodies.names), np.int64)
        if not len(rows) or not len(model.points):
            return rows[:0]
        own = bodies.row_of(self._mover, user=self._user)
        more = model.radius + self.margin_units / UNITS_PER_METRE
        count = find_near_bodies(
            model.box, np.ascontiguousarray(first), np.ascontiguousarray(last), bodies.origin, more,
            bodies.bounds, bodies.kinds, self.wanted, own, rows,
        )  # fmt: skip
        return rows[:count]

    def _near(self, first: Pose, last: Pose) -> NDArray[np.int64]:
        """Return the rows of `_in_reach`, except those overlapped when the frame began."""
        bodies = self.bodies
        if self._layout != bodies.layout:
            self._layout, self._overlapped = bodies.layout, {}
        found = self._in_reach(first, last)
        left_out = [row for row, overlapped in self._overlapped.items() if overlapped]
        if self._skip:
            left_out.append(bodies.row_of(self._skip, user=True))
        return found[~np.isin(found, left_out)] if len(found) and left_out else found

    def _beside(self, pose: Pose, rows: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Return which bodies (m,) stand beside the avatar: their tops are above the middle of its height."""
        bodies, model, own = self.bodies, self._model, np.empty((2, 3))
        bound_body(model.box, np.ascontiguousarray(pose), bodies.origin, model.radius, own)
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
        self, ends: tuple[Pose, Pose], rows: NDArray[np.int64], tolerance: float
    ) -> tuple[int, Hit | None]:
        """Return the first hit of a motion with the bodies of rows (m,) and its row, or None.

        ends: poses from the bodies' origin.
        """
        bodies, shape = self.bodies, self._shape
        row, point, fraction, witness = -1, 0, np.inf, np.empty((2, 3))
        for other, places in bodies.by_shape(rows):
            centers, named = np.empty((2, 3)), np.empty(2, np.int64)
            found, until = sweep_bodies(
                shape.model.arrays, shape.model.box, shape.units, *ends, other.model.arrays, bodies.poses,
                other.units, rows[places], bodies.origin, self.margin_units, tolerance, fraction, centers, named,
                bodies.scratch, self._stop.flag,
            )  # fmt: skip
            if found >= 0:
                row, point, fraction, witness = found, int(other.model.rows[tuple(named)]), until, centers
        if row < 0:
            return row, None
        own, theirs = witness
        normal = bodies.shapes[row].normal_at(point)
        if normal is not None:
            normal = rotate(bodies.poses[row], normal)
            normal = -normal if dot(normal, own - theirs) < 0.0 else normal
        return row, Hit(
            fraction, Verdict.CONTACT, own, theirs, bodies.names[row], normal=normal, obstacle=self
        )

    def _is_overlapped(self, row: int) -> bool:
        """Return whether the mover touched a body when the frame began."""
        found = self._overlapped.get(row)
        if found is None:
            touching = self.bodies.touching(
                self._shape, self._start, np.array([row]), self.margin_units, self._stop
            )
            found = self._overlapped[row] = bool(touching[0])
        return found

    def _deepening_hit(self, pose_from: Pose, pose_to: Pose) -> Hit | None:
        """Return a hit if a motion leads deeper into a body that was overlapped at the start.

        It does if its translation is directed against the body's way out. Return None otherwise.
        """
        way, shape = pose_to[:3, 3] - pose_from[:3, 3], self._shape
        for row in sorted(row for row, overlapped in self._overlapped.items() if overlapped):
            user = self._mover if self._user else ""
            out = self.bodies.escape_direction(row, user, shape.center(self._start))
            if dot(way, out) < -_ACROSS * norm(out) * norm(way):
                return self._hit(row, shape.center(pose_from), out)
        return None

    def _hit(self, row: int, center: Vec, out: Vec) -> Hit:
        """Return a hit with fraction 0 of a body that lies against `out` from the avatar's centre."""
        name = self.bodies.names[row]
        return Hit(0.0, Verdict.CONTACT, center, center - out, name, obstacle=self)


def warm_kernels() -> None:
    """Compile the kernels before the first request needs them."""
    corner = [[x, y, 0.0] for x in (0.0, 0.05) for y in (0.0, 0.05)]  # a surface, which has a normal
    model = make_avatar(corner, 0.05)
    bodies = Bodies(np.zeros(3), np.array([0.0, 0.0, 1.0]))
    poses = [np.eye(4), np.eye(4)]
    poses[1][0, 3] = 1.0
    for name, pose in zip("ab", poses, strict=True):
        bodies.put_user(Body(name, model, pose))
    blocking = BodyObstacle(bodies, USER, Body("a", model, poses[0]))
    blocking.sweep(poses[0], poses[1], 1e-6)
    blocking.touches(poses[1])
    bodies.shape_of(model).normal_at(0)
