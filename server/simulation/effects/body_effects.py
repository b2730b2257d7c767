"""Effects `crowd` and `objects`: other bodies are obstacles.

Effect `crowd`: users do not walk through one another.

The other users are obstacles at their current poses. Users whose turn came earlier in this frame
have already moved; the replay log records the order. A user blocks the others and is not moved by
them. Users that overlap, for example because they entered at the same place, may separate but not
move deeper (bodies.py).

Effect `objects`: dynamic objects block users; pushable ones give way where there is space.

Motion commands place a kinematic object (`Bodies.place_objects`), even into users. The user whose
motion ends at a pushable object moves it: by the horizontal part of the remaining translation, as
far as the object touches nothing. Then the user follows. The object has no momentum: it never moves
farther than the motion command, and does not move by itself.

A rough floor would stop an object that stands on it or just above it. An object that is stopped low
down is therefore lifted over the floor, by at most the last of _LIFTS, and put down again. Contacts
with the scan that exist when the push begins, such as that with the floor, block only motions that
lead deeper: the object first leaves them, along their normals, by as little.

Contacts are recomputed only for objects that have moved. server/queries/objects.py defines contact.
"""

from functools import partial
from typing import Any

import numpy as np

from ....schemas.errors import BadRequestError
from ....schemas.scene.effect_table import Crowd, Objects
from ....schemas.wire.answers import Verdict
from ....schemas.wire.motion_messages import CrowdReport, ObjectsReport
from ...queries.query_inputs import QueryBudget, to_units
from ..world.bodies import KINEMATIC, PUSHED, SURFACE_REACH, USER, Bodies, BodyObstacle, warm_kernels
from ..world.frame import Body, Frame, Hit, Pose, Run, Vec, dot, horizontal, lowest_height, norm, translated

# Largest permitted margin of `crowd` [m].
_MAX_MARGIN = 8.0
# A pushed object stops this far before whatever stops it, along its way [m], as `stop` does for
# users.
_SKIN = 0.002
# Largest distance that any point may move between the last time proved clear and the contact [m].
_TOLERANCE = 1e-5
# Shorter pushes do not move an object [m].
_MIN_PUSH = 1e-4
# Cosine of 60 degrees, the largest angle between a push and the surface's inward normal. At larger
# angles users slide along the object.
_HEAD_ON_COSINE = 0.5
# Heights by which a pushed object is lifted, tried in turn [m]. A floor with 2 mm of noise has bumps
# of 6 to 8 mm; an object 2 cm deep in the floor is stuck.
_LIFTS = (0.005, 0.01, 0.02)
# A pushed object that is this far above the floor, or less, is not put down [m].
_PUT_DOWN = 1e-3
# A contact opposes a push if the push leads into its surface at more than 6 degrees. Normals of
# floors with noise are wrong by a few degrees.
_OPPOSES = 0.1
# A lifted object is put down only where the floor's normal has at least this vertical component:
# slopes up to 20 degrees. With steeper ones, an object climbs steps over their rounded edges.
_LEVEL = 0.94
# Largest number of contacts that an object leaves before a push, and least cosine between normals
# of one of them.
_MAX_CONTACTS, _SAME_CONTACT = 4, 0.9


def make(effect: Objects | Crowd, world: Any) -> Run:
    """Create an effect of a scene. Raise BadRequestError for a margin that is too large."""
    warm_kernels()
    if isinstance(effect, Objects):
        return ObjectsRunner(world, bodies_of(world)).run
    if effect.margin > _MAX_MARGIN:
        raise BadRequestError(f"margin {effect.margin:g} m of crowd: expected at most {_MAX_MARGIN:g} m")
    return partial(_add_users, bodies_of(world), to_units(effect.margin, "margin"))


def bodies_of(world: Any) -> Bodies:
    """Return the bodies of a scene, which its effects share. They begin with the objects of its file."""
    if world.bodies is None:
        with world as seen:
            bodies = Bodies(seen[0].data.arrays.origin, world.up)
        for item in world.file.objects:
            model = world.avatar(item.avatar)
            bodies.add_object(item.name, model, np.array(item.pose), pushed=item.kind == "pushed")
        world.bodies = bodies
    found: Bodies = world.bodies
    return found


def _add_users(bodies: Bodies, margin_units: int, frame: Frame) -> CrowdReport:
    """Add the other users to the obstacles; the report counts those that block.

    margin_units: distance between users, exact units.
    """
    met: set[str] = set()

    def count(frame: Frame, hit: Hit, to: Pose) -> bool:
        met.add(hit.what)
        frame.reports["crowd"] = CrowdReport(len(met))
        return False  # users do not give way

    frame.obstacles.append(
        BodyObstacle(bodies, USER, frame.body, frame.budget.stop, margin_units=margin_units, give_way=count)
    )
    return CrowdReport()


class ObjectsRunner:
    """Effect that adds the scene's objects to the obstacles of a frame.

    bodies: objects and users; the simulation updates the users.  world: of the scene.
    Not thread-safe, except for queries of `Bodies`.
    """

    def __init__(self, world: Any, bodies: Bodies) -> None:
        """Create the effect."""
        self._world, self.bodies = world, bodies
        # State for which the contacts of each row were computed: clock of its last move, archives.
        self._computed_for: dict[int, tuple[int, tuple[int, ...]]] = {}
        self._contacts: set[tuple[int, int]] = set()  # rows, the lesser first; -1: the scene

    def run(self, frame: Frame) -> ObjectsReport:
        """Add the objects to the obstacles, and report their moves and contacts.

        The report covers the moves since the user's previous frame.
        """
        bodies = self.bodies
        with bodies.lock:
            since, frame.effect_state["objects"] = frame.body.effect_state.get("objects", 0), bodies.clock
            obstacle = BodyObstacle(
                bodies, KINEMATIC | PUSHED, frame.body, frame.budget.stop, give_way=partial(self._push, since)
            )
            frame.obstacles.append(obstacle)
            return self.report(since, frame.budget)

    def _push(self, since: int, frame: Frame, hit: Hit, to: Pose) -> bool:
        """Push the object that ended a motion to `to` by the rest of the way; return whether it moved.

        Only pushable objects move, as far as they touch nothing. A user's first frame and `Simulation.move`,
        which keeps no state, push no object.
        since: clock of the last moves reported to the user.
        """
        bodies = self.bodies
        if hit.avatar is None or hit.cloud is None:
            return False
        with bodies.lock:
            row = bodies.row_of(hit.what, user=False)
            if row < 0 or bodies.kinds[row] != PUSHED or frame.body.time is None:
                return False
            left = horizontal(to[:3, 3] - frame.pose[:3, 3], bodies.up)
            inward = horizontal(hit.cloud - hit.avatar, bodies.up)
            if norm(left) < _MIN_PUSH or not dot(left, inward) > _HEAD_ON_COSINE * norm(left) * norm(inward):
                return False
            pushed = ObjectPush(bodies, row, left, frame).result()
            if pushed is None or frame.budget.stop:
                return False  # if stopped, the result may be incomplete
            bodies.put(row, pushed)
            frame.reports["objects"] = self.report(since, frame.budget)
            return True

    def report(self, since: int, budget: QueryBudget) -> ObjectsReport:
        """Return the objects that moved since a count of moves, and the contacts."""
        bodies = self.bodies
        rows = np.flatnonzero(bodies.kinds != USER).tolist()  # they precede those of users
        poses = {bodies.names[row]: bodies.poses[row].tolist() for row in rows if bodies.changed[row] > since}
        names = {-1: ""} | dict(enumerate(bodies.names))
        contacts = self._find_contacts(rows, budget)
        return ObjectsReport(poses, [(names[one], names[other]) for one, other in contacts])

    def _find_contacts(self, rows: list[int], budget: QueryBudget) -> list[tuple[int, int]]:
        """Return the contacts of objects, by rows; recompute those of objects that have moved."""
        bodies, archives = self.bodies, self._world.generations()
        for row in rows:
            now = bodies.changed[row], archives
            if self._computed_for.get(row) == now:
                continue
            shape, pose = bodies.shapes[row], bodies.poses[row]
            self._contacts = {pair for pair in self._contacts if row not in pair}
            verdict = self._world.collide(shape.model, pose, budget)
            if verdict == Verdict.CONTACT:
                self._contacts.add((-1, row))
            apart = (bodies.bounds[:, 0] > bodies.bounds[row, 1]) | (
                bodies.bounds[:, 1] < bodies.bounds[row, 0]
            )
            near = np.array([other for other in rows if other != row and not apart[other].any()], np.int64)
            for other in near[bodies.touching(shape, pose, near, 0, budget.stop)].tolist():
                self._contacts.add((min(row, other), max(row, other)))
            if verdict == Verdict.UNKNOWN or budget.stop:
                continue  # compute again in a later frame, when missing voxels may be resident
            self._computed_for[row] = now
        return sorted(self._contacts)


class ObjectPush:
    """One push of an object: where the object ends."""

    def __init__(self, bodies: Bodies, row: int, way: Vec, pusher: Frame) -> None:
        """Prepare the push.

        row: of the object.  way: (3,) horizontal [m].
        pusher: frame of the user that pushes and follows, who is not an obstacle of the object.
        """
        user = pusher.body.name
        self._bodies, self._row, self._way, self._length = bodies, row, way, norm(way)
        self._world, self._budget, self._pusher = pusher.world, pusher.budget, pusher
        self._model, self._pose = bodies.shapes[row].model, bodies.poses[row].copy()
        self._others = BodyObstacle(
            bodies, USER | KINEMATIC | PUSHED, Body(bodies.names[row], self._model, self._pose), pusher.budget.stop,
            user=False, skip=user,
        )  # fmt: skip

    def result(self) -> Pose | None:
        """Return the pose (4, 4) where the object ends; None if it does not move."""
        to, low = self._along(self._pose)
        best = to if self._gain(to) >= _MIN_PUSH else None
        if low:
            for lift in _LIFTS:
                begin = self._lifted(lift)
                if begin is None:
                    continue
                over, low = self._along(begin)
                if self._gain(over) >= max(_MIN_PUSH, self._gain(to) + _MIN_PUSH):
                    put = self._put_down(over, dot(begin[:3, 3] - self._pose[:3, 3], self._bodies.up))
                    best = to = to if put is None else put
                if not low:
                    break
        elif best is not None:
            put = self._put_down(best, 0.0)
            best = best if put is None else put
        return best

    def _gain(self, pose: Pose) -> float:
        """Return how far a pose is along the push [m]."""
        return dot(pose[:3, 3] - self._pose[:3, 3], self._way) / self._length

    def _along(self, begin: Pose) -> tuple[Pose, bool]:
        """Return the pose reached from a pose along the push, and whether the scan ended it low down.

        `Low down` is within the greatest lift above the lowest sphere.
        """
        to = translated(begin, self._way)
        low = lowest_height(self._model, begin, self._bodies.up) if len(self._model.points) else 0.0
        swept = self._world.sweep(self._model, begin, to, _TOLERANCE, self._budget)
        clear, stumbles = 1.0, False
        if swept is not None:
            clear = swept.fraction
            stumbles = swept.cloud is not None and (
                clear == 0.0 or dot(swept.cloud, self._bodies.up) - low <= _LIFTS[-1]
            )
        hit = self._others.sweep(begin, to, _TOLERANCE)
        if hit is not None and hit.fraction <= clear:
            clear, stumbles = hit.fraction, False
        if clear < 1.0:
            clear = max(0.0, clear - _SKIN / self._length)
            to = translated(begin, self._way * clear)
        return to, stumbles

    def _lifted(self, lift: float) -> Pose | None:
        """Return the object's pose lifted off the floor, clear of all; None if there is none.

        An object that touches the scan leaves each contact along its normal by `lift` [m]. There is
        none if the push leads into one of them.
        """
        directions: list[Vec] = [self._bodies.up]
        for _ in range(_MAX_CONTACTS):
            pose = translated(self._pose, lift * np.sum(directions, axis=0))
            verdict = self._world.collide(self._model, pose, self._budget)
            if verdict == Verdict.CLEAR:
                return None if self._is_obstructed(pose) else pose
            hit = self._world.deepest(self._model, pose, self._budget) if verdict == Verdict.CONTACT else None
            if hit is None or hit.avatar is None or hit.cloud is None:
                return None
            out = self._world.normal(hit, SURFACE_REACH, self._budget)
            if out is None:
                out = hit.avatar - hit.cloud
            if (
                dot(out, self._way) < -_OPPOSES * self._length * norm(out)
                or norm(out) == 0.0
                or any(dot(out, each) > _SAME_CONTACT * norm(out) for each in directions)
            ):
                return None
            directions.append(out / norm(out))
        return None

    def _is_obstructed(self, pose: Pose) -> bool:
        """Return whether another body obstructs the way from the object's pose to a pose."""
        return self._others.sweep(self._pose, pose, _TOLERANCE) is not None

    def _put_down(self, pose: Pose, rose: float) -> Pose | None:
        """Return the pose that results if the object is lowered; None if it would stand on an edge.

        The object ends just above the floor if that is at most the least lift below the height at
        which the push began, otherwise at this height.
        rose: height above that one [m].
        """
        up, deep = self._bodies.up, rose + _LIFTS[0]
        down = translated(pose, -deep * up)
        swept = self._world.sweep(self._model, pose, down, _TOLERANCE, self._budget)
        hit = self._others.sweep(pose, down, _TOLERANCE)
        lower = rose
        if swept is not None and swept.verdict == Verdict.CONTACT:
            normal = self._world.normal(swept, SURFACE_REACH, self._budget)
            if normal is not None and dot(normal, up) < _LEVEL:
                return None
        stops = [each.fraction for each in (swept, hit) if each is not None]
        if stops:
            lower = min(1.0, *stops) * deep - _SKIN
        if lower < _PUT_DOWN or self._touches_pusher(lowered := translated(pose, -lower * up)):
            return pose
        return lowered

    def _touches_pusher(self, pose: Pose) -> bool:
        """Return whether the object touches the user that pushes it."""
        frame, bodies = self._pusher, self._bodies
        shape, rows = bodies.shape_of(frame.body.avatar), np.array([self._row])
        before = bodies.poses[self._row].copy()
        bodies.poses[self._row] = pose
        touches = bodies.touching(shape, frame.pose, rows, 0, frame.budget.stop)
        bodies.poses[self._row] = before
        return bool(touches[0])
