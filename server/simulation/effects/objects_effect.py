"""Effect `objects`: dynamic objects block users; pushable ones give way where there is space.

Motion commands place a kinematic object (`Bodies.place_objects`), even into users. The user whose
motion ends at a pushable object moves it: by the horizontal part of the remaining translation, as
far as the object touches nothing. Then the user follows. The object has no momentum: it never moves
farther than the motion command, and does not move by itself. An object that touches the scene at
its pose, for example the floor, cannot be pushed, so it must be placed clear of the scene.

Contacts are recomputed only for objects that have moved. server/queries/objects.py defines contact.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from ....schemas.scene.effect_table import Objects
from ....schemas.scene.scene_file import ObjectItem
from ....schemas.wire.answers import Verdict
from ....schemas.wire.motion_messages import ObjectsReport
from ...queries.context.query_budget import QueryBudget
from ..world.bodies import KINEMATIC, PUSHED, USER, Bodies
from ..world.body_obstacles import BodyObstacle, warm_kernels
from ..world.frame import Frame, Hit, Pose, Vec, translated
from ..world.vectors import dot, horizontal, norm

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


def make(effect: Objects, world: Any) -> "ObjectsRunner":
    """Create the effect of a scene.

    Raises BadRequestError for invalid objects.
    """
    warm_kernels()
    return ObjectsRunner(world, world.file.objects)


class ObjectsRunner:
    """Effect that adds the scene's objects to the obstacles of a frame.

    bodies: objects and users; the simulation updates the users.  world: of the scene.
    Not thread-safe, except for queries of `Bodies`.
    """

    name = "objects"

    def __init__(self, world: Any, items: Sequence[ObjectItem]) -> None:
        """Create the effect. items: the objects at their initial poses."""
        self._world = world
        with world as seen:
            self.bodies = Bodies(seen[0].data.arrays.origin, world.up, self._add_initial)
        self._items = list(items)
        # State for which the contacts of each row were computed: clock of its last move, archives.
        self._computed_for: dict[int, tuple[int, tuple[int, ...]]] = {}
        self._contacts: set[tuple[int, int]] = set()  # rows, the lesser first; -1: the scene

    def _add_initial(self, bodies: Bodies) -> None:
        """Add the objects at their initial poses."""
        for item in self._items:
            model = self._world.avatar(item.avatar)
            bodies.add_object(item.name, model, np.array(item.pose), pushed=item.kind == "pushed")

    def run(self, frame: Frame) -> None:
        """Add the objects to the obstacles, and report their moves and contacts.

        The report covers the moves since the user's previous frame.
        """
        bodies = self.bodies
        with bodies.lock:
            bodies.begin()
            since, frame.effect_state[self.name] = frame.body.effect_state.get(self.name, 0), bodies.clock
            frame.obstacles.append(ObjectObstacle(self, frame, since))
            frame.reports[self.name] = self.report(since, frame.budget)

    def report(self, since: int, budget: QueryBudget) -> ObjectsReport:
        """Return the objects that moved since a count of moves, and the contacts."""
        bodies = self.bodies
        poses = {
            bodies.names[row]: bodies.poses[row].tolist()
            for row in self._objects()
            if bodies.changed[row] > since
        }
        names = {-1: ""} | dict(enumerate(bodies.names))
        return ObjectsReport(
            poses, [(names[one], names[other]) for one, other in self._find_contacts(budget)]
        )

    def _objects(self) -> list[int]:
        """Return the objects' rows, which precede those of users."""
        return np.flatnonzero(self.bodies.kinds != USER).tolist()

    def _find_contacts(self, budget: QueryBudget) -> list[tuple[int, int]]:
        """Return the contacts, by rows; recompute those of objects that have moved."""
        bodies, rows, archives = self.bodies, self._objects(), self._world.generations()
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

    def push(self, name: str, way: Vec, user: str, budget: QueryBudget) -> bool:
        """Move an object by a horizontal displacement (3,) [m], as far as it touches nothing.

        Return whether it moved.
        user: name of the user that pushes and follows; it is not an obstacle of the object.
        """
        bodies = self.bodies
        row, length = bodies.row_of(name, user=False), norm(way)
        if length < _MIN_PUSH:
            return False
        model, pose = bodies.shapes[row].model, bodies.poses[row].copy()
        to = translated(pose, way)
        swept = self._world.sweep(model, pose, to, _TOLERANCE, budget)
        clear = 1.0 if swept.verdict == Verdict.CLEAR else swept.lower
        others = BodyObstacle(
            self.name, bodies, USER | KINEMATIC | PUSHED, name, model, pose, user=False, skip=user, stop=budget.stop
        )  # fmt: skip
        hit = others.sweep(model, pose, to, _TOLERANCE)
        if hit is not None:
            clear = min(clear, hit.fraction)
        if clear < 1.0:
            clear -= _SKIN / length
            if clear * length < _MIN_PUSH:
                return False
            to = translated(pose, way * clear)
        if budget.stop:
            return False  # the result may be incomplete
        bodies.put(row, to)
        return True


class ObjectObstacle(BodyObstacle):
    """Obstacle formed by the objects, for one frame of one user. Pushable objects give way."""

    def __init__(self, runner: ObjectsRunner, frame: Frame, since: int) -> None:
        """Create the obstacle for a frame. since: clock of the last moves reported to its user."""
        body, stop = frame.body, frame.budget.stop
        super().__init__(
            runner.name, runner.bodies, KINEMATIC | PUSHED, body.name, body.avatar, body.pose, stop=stop
        )
        self._runner, self._since = runner, since

    def give_way(self, frame: Frame, hit: Hit, to: Pose) -> bool:
        """Push the object that ended the motion by the rest of the way; return whether it moved.

        Only pushable objects move. `Simulation.move`, which keeps no state, pushes no object.
        """
        bodies = self._runner.bodies
        if not self.is_own(hit):
            return False
        with bodies.lock:
            row = bodies.row_of(hit.what, user=False)
            if row < 0 or bodies.kinds[row] != PUSHED or not bodies.is_present(frame.body):
                return False
            if hit.avatar is None or hit.cloud is None:
                return False
            left = horizontal(to[:3, 3] - frame.pose[:3, 3], bodies.up)
            inward = horizontal(hit.cloud - hit.avatar, bodies.up)
            if not dot(left, inward) > _HEAD_ON_COSINE * norm(left) * norm(inward):
                return False
            if not self._runner.push(hit.what, left, frame.body.name, frame.budget):
                return False
            frame.reports[self._runner.name] = self._runner.report(self._since, frame.budget)
            return True
