"""Bodies: everything that moves in one scene, users and objects, with their current poses.

A simulation has at most one `Bodies`. It updates the users as in a dict (`bodies[user] = body`
after each frame, `pop`), and the objects that motion commands place (`place_objects`). Effects
query the bodies through `BodyObstacle` (body_obstacles.py).
"""

import threading
from collections.abc import Callable, Hashable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ....schemas.archive.rigid_pose import rigid_pose
from ....schemas.archive.units import UNITS_PER_METRE
from ....schemas.errors import BadRequestError
from ...avatars.avatar_model import AvatarModel
from ...kernels.bodies.body_pairs import CONTACT, bound_body, touch_pairs
from ...kernels.bodies.moving_bodies import make_body_scratch
from ...kernels.core.normal_codes import NO_NORMAL, decode_normal, normal_code
from ...kernels.core.placed_avatar import MAX_REACH_UNITS
from ...queries.query_inputs import to_units
from ...runtime.stop_flag import NO_STOP, StopFlag
from .frame import Body, Pose, Vec
from .vectors import horizontal, rotate, rotate_back

USER, KINEMATIC, PUSHED = 1, 2, 4  # kinds, one bit each
# Points within this distance determine the normal of a body's surface [m]; `slide` and `ground` use
# the same distance for scans.
_SURFACE = 0.08
# Number of cached shapes of avatars that belong to no body, beyond which they are dropped.
_MAX_LOOSE_SHAPES = 64


class Shape(NamedTuple):
    """Avatar's model with the data of the broad phase.

    units: its radius, exact units.  number: of this shape among its `Bodies`.
    normals: normals computed so far, by point.
    """

    model: AvatarModel
    units: int
    number: int
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
            near = np.rint(apart[(apart * apart).sum(axis=1) <= _SURFACE**2] * UNITS_PER_METRE).astype(
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
    bounds: (n, 2, 3), relative to the origin, radius included [m].  numbers: (n,), of shapes.
    changed: value of `clock` at the last move of each row.
    clock: counts moves.  layout: counts arrivals and departures of bodies, which change rows.
    """

    def __init__(self, origin: Vec, up: Vec, begin: "Callable[[Bodies], None] | None" = None) -> None:
        """Create an empty set of bodies.

        begin: adds the initial objects on first use, because avatars are loaded after effects.
        """
        self._begin = begin
        self.origin, self.up = np.array(origin, np.float64), np.array(up, np.float64)
        self.lock = threading.RLock()
        self.scratch = make_body_scratch(1, 1)
        self.names: list[str] = []
        self.kinds = np.empty(0, np.uint8)
        self.poses = np.empty((0, 4, 4))
        self.bounds = np.empty((0, 2, 3))
        self.numbers = np.empty(0, np.int64)
        self.shapes: list[Shape] = []
        self.changed: list[int] = []
        self.clock = self.layout = 0
        self._rows: dict[tuple[bool, str], int] = {}
        self._users: dict[Hashable, Body] = {}
        self._known: dict[int, Shape] = {}
        self._numbered = 0
        # By user and object, see `_remember_origin`.
        self._came_from: dict[tuple[str, str], Vec] = {}

    # --- shapes --------------------------------------------------------------------------------

    def shape_of(self, model: AvatarModel) -> Shape:
        """Return the cached shape of a model."""
        shape = self._known.get(id(model.points))
        if shape is not None and shape.model.arrays is model.arrays and shape.model.radius == model.radius:
            return shape
        if len(self._known) > _MAX_LOOSE_SHAPES + len(self.names):
            self._known = {id(kept.model.points): kept for kept in self.shapes}
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
        shape = self._known[id(model.points)] = Shape(model, units, self._numbered, {})
        self._numbered += 1
        return shape

    # --- arrivals and departures ---------------------------------------------------------------

    def begin(self) -> None:
        """Add the initial objects, once. Raise the error of an invalid object on each call.

        Without its objects, a scene would let users walk through them.
        """
        with self.lock:
            begin, self._begin = self._begin, None
            if begin is None:
                return
            try:
                begin(self)
            except BaseException:
                self._begin = begin
                for row in reversed(range(len(self.names))):
                    self._remove(row)
                raise

    def __setitem__(self, user: Hashable, body: Body) -> None:
        """Add a user, or update its body's pose."""
        with self.lock:
            self.begin()
            self._users[user] = body
            row = self._rows.get((True, body.name))
            if row is None:
                self._add(body.name, USER, body.avatar, body.pose)
                return
            if self.shapes[row].model is not body.avatar:
                self.shapes[row] = self.shape_of(body.avatar)
                self.numbers[row] = self.shapes[row].number
            self._put(row, body.pose)

    def pop(self, user: Hashable, default: Body | None = None) -> Body | None:
        """Remove a user and return its body."""
        with self.lock:
            body = self._users.pop(user, default)
            if body is not None and (True, body.name) in self._rows:
                self._remove(self._rows[True, body.name])
            return body

    def is_present(self, body: Body) -> bool:
        """Return whether this is the body of a present user.

        The body of a move that keeps no state is a different one.
        """
        return any(body is known for known in self._users.values())

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
        self.numbers = np.append(self.numbers, shape.number)
        self.poses = np.concatenate([self.poses, np.eye(4)[None]])
        self.bounds = np.concatenate([self.bounds, np.zeros((1, 2, 3))])
        self._rows[kind == USER, name] = row
        self.layout += 1
        self._put(row, pose, begun=True)

    def _remove(self, row: int) -> None:
        """Remove a row; the numbers of later rows decrease by one."""
        name = self.names[row]
        for rows in (self.names, self.shapes, self.changed):
            del rows[row]  # type: ignore[attr-defined]
        self.kinds, self.numbers = np.delete(self.kinds, row), np.delete(self.numbers, row)
        self.poses, self.bounds = np.delete(self.poses, row, axis=0), np.delete(self.bounds, row, axis=0)
        self._rows = {(bool(self.kinds[at] == USER), each): at for at, each in enumerate(self.names)}
        self._came_from = {key: way for key, way in self._came_from.items() if key[0] != name}
        self.layout += 1

    # --- poses ---------------------------------------------------------------------------------

    def snapshot(self) -> tuple[int, NDArray[np.float64]]:
        """Return the layout and the poses (n, 4, 4) of all bodies now, for `restore`."""
        with self.lock:
            return self.layout, self.poses.copy()

    def restore(self, snapshot: tuple[int, NDArray[np.float64]]) -> None:
        """Restore the poses that `snapshot` returned, if the bodies are still the same."""
        layout, poses = snapshot
        with self.lock:
            if layout == self.layout:
                for row in np.flatnonzero((poses != self.poses).any(axis=(1, 2))).tolist():
                    self._put(row, poses[row])

    def put(self, row: int, pose: Pose) -> None:
        """Set the pose of a body."""
        with self.lock:
            self._put(row, pose)

    def _put(self, row: int, pose: Pose, begun: bool = False) -> None:
        """Implement `put`. begun: the body is new."""
        if not begun and (self.poses[row] == pose).all():
            return
        self.poses[row] = pose
        shape = self.shapes[row]
        if len(shape.model.points):
            bound_body(shape.model.box, self.poses[row], self.origin, shape.model.radius, self.bounds[row])
        else:
            self.bounds[row, 0], self.bounds[row, 1] = np.inf, -np.inf
        if not begun:
            self.clock += 1
            self.changed[row] = self.clock

    def place_objects(
        self, poses: Mapping[str, Sequence[Sequence[float]]], stop: StopFlag = NO_STOP
    ) -> Callable[[], None]:
        """Place objects where a motion command puts them, even into users.

        A user that is touched then starts its next frame in contact.
        poses: (4, 4) row-major by name. All are checked before any is set: BadRequestError,
        BadTransformError.
        Returns a function that restores the poses, for a motion command that is refused or stopped
        later.
        """
        with self.lock:
            self.begin()
            checked = [
                (self._kinematic_row(name), rigid_pose(poses[name], f"object {name!r}"))
                for name in sorted(poses)
            ]
            came_from, stood = dict(self._came_from), [(row, self.poses[row].copy()) for row, _ in checked]
            for (row, pose), (_, before) in zip(checked, stood, strict=True):
                self._put(row, pose)
                self._remember_origin(row, before, stop)

        def restore() -> None:
            with self.lock:
                for row, before in stood:
                    self._put(row, before)
                self._came_from = came_from

        return restore

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
        poses = np.concatenate([pose[None], self.poses[rows]])
        units = np.array([shape.units, *(self.shapes[row].units for row in rows.tolist())], np.int64)
        numbers = self.numbers[rows]
        for number in np.unique(numbers).tolist():
            at = np.flatnonzero(numbers == number)
            model = self.shapes[int(rows[at[0]])].model
            if not len(model.points):
                continue
            pairs = np.stack([np.zeros(len(at), np.int64), at + 1], axis=1)
            verdict = np.empty(len(at), np.uint8)
            touch_pairs(
                shape.model.arrays, model.arrays, poses, units, pairs, margin_units, self.origin,
                stop.flag, verdict, self.scratch.counters,
            )  # fmt: skip
            found[at] = verdict == CONTACT
        return found
