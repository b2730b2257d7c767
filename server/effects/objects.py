"""`objects`: dynamic objects block users; those that can be pushed give way as far as the scene lets them.

A kinematic object is where wishes put it (`Bodies.tell`), whatever is there. A pushed one is moved by the user whose
motion it ended: by what is left of the translation, level, as far as nothing is touched by it on its way; then the
user follows. It has no momentum: it never goes farther than its user wished to, and stands when nobody pushes. An
object that touches the scene where it stands, such as the floor, is not moved: place it clear of it.

What objects touch is found anew only of those that have moved (contact as server/objects.py has it).
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from ...schemas.answers import Verdict
from ...schemas.effects import Objects
from ...schemas.moves import ObjectsReport
from ...schemas.scene import ObjectItem
from ..effort import Effort
from ..vectors import dot, level, size
from .blocking import Blocking, warm
from .bodies import PUSHED, TOLD, USER, Bodies
from .frame import Frame, Hit, Pose, Vec, moved_by

# A pushed object keeps so far from what stops it, along its way [m], as `stop` has it of users.
_SKIN = 0.002
# How far any point may go between the last clear moment known and a touch [m].
_TOLERANCE = 1e-5
# What would move an object less than this does not [m].
_LEAST = 1e-4
# Cosine: an object goes where it is pushed within 60 degrees of head on; users slide along it otherwise.
_HEAD_ON = 0.5


def make(effect: Objects, world: Any) -> "ObjectsRunner":
    """The effect of a scene. BadRequestError for objects that are none."""
    warm()
    return ObjectsRunner(world, world.file.objects)


class ObjectsRunner:
    """Puts the scene's objects in a frame's way. bodies: the simulation keeps its users in them up to date.

    world: of the scene.  Not thread-safe but for what `Bodies` is asked.
    """

    name = "objects"

    def __init__(self, world: Any, items: Sequence[ObjectItem]) -> None:
        """items: the objects, as they begin."""
        self._world = world
        with world as seen:
            self.bodies = Bodies(seen[0].data.arrays.origin, world.up, self._begin)
        self._items = list(items)
        # Row: when it had moved last, and the archives asked, as it was asked what it touches.
        self._asked: dict[int, tuple[int, tuple[int, ...]]] = {}
        self._touching: set[tuple[int, int]] = set()  # rows, the lesser first; -1: the scene

    def _begin(self, bodies: Bodies) -> None:
        """The objects where they begin."""
        for item in self._items:
            model = self._world.avatar(item.avatar)
            bodies.add_object(item.name, model, np.array(item.pose), pushed=item.kind == "pushed")

    def run(self, frame: Frame) -> None:
        """Add the objects to what blocks, and say which moved since the user's frame before, and what they touch."""
        bodies = self.bodies
        with bodies.lock:
            bodies.begin()
            since, frame.kept[self.name] = frame.body.kept.get(self.name, 0), bodies.clock
            frame.obstacles.append(Things(self, frame, since))
            frame.reports[self.name] = self.report(since, frame.effort)

    def report(self, since: int, effort: Effort) -> ObjectsReport:
        """What moved since a count of moves, and what touches."""
        bodies = self.bodies
        poses = {
            bodies.names[row]: bodies.poses[row].tolist()
            for row in self._objects()
            if bodies.changed[row] > since
        }
        names = {-1: ""} | dict(enumerate(bodies.names))
        return ObjectsReport(
            poses, [(names[one], names[other]) for one, other in self._find_touching(effort)]
        )

    def _objects(self) -> list[int]:
        """The objects' rows: they came first."""
        return np.flatnonzero(self.bodies.kinds != USER).tolist()

    def _find_touching(self, effort: Effort) -> list[tuple[int, int]]:
        """What touches, by rows; asked of what has moved since it was asked last."""
        bodies, rows, archives = self.bodies, self._objects(), self._world.generations()
        for row in rows:
            now = bodies.changed[row], archives
            if self._asked.get(row) == now:
                continue
            shape, pose = bodies.shapes[row], bodies.poses[row]
            self._touching = {pair for pair in self._touching if row not in pair}
            verdict = self._world.collide(shape.model, pose, effort)
            if verdict == Verdict.CONTACT:
                self._touching.add((-1, row))
            apart = (bodies.bounds[:, 0] > bodies.bounds[row, 1]) | (
                bodies.bounds[:, 1] < bodies.bounds[row, 0]
            )
            near = np.array([other for other in rows if other != row and not apart[other].any()], np.int64)
            for other in near[bodies.touching(shape, pose, near, 0, effort.stop)].tolist():
                self._touching.add((min(row, other), max(row, other)))
            if verdict == Verdict.UNKNOWN or effort.stop:
                continue  # it is asked again, once what is missing may be there
            self._asked[row] = now
        return sorted(self._touching)

    def push(self, name: str, way: Vec, user: str, effort: Effort) -> bool:
        """Move an object along a level way, as far as nothing is touched; whether it moved.

        user: who pushes, and follows: it does not stand in the way.
        """
        bodies = self.bodies
        row, length = bodies.row_of(name, user=False), size(way)
        if length < _LEAST:
            return False
        model, pose = bodies.shapes[row].model, bodies.poses[row].copy()
        to = moved_by(pose, way)
        swept = self._world.sweep(model, pose, to, _TOLERANCE, effort)
        clear = 1.0 if swept.verdict == Verdict.CLEAR else swept.lower
        others = Blocking(
            self.name, bodies, USER | TOLD | PUSHED, name, model, pose, user=False, skip=user, stop=effort.stop
        )  # fmt: skip
        hit = others.sweep(model, pose, to, _TOLERANCE)
        if hit is not None:
            clear = min(clear, hit.fraction)
        if clear < 1.0:
            clear -= _SKIN / length
            if clear * length < _LEAST:
                return False
            to = moved_by(pose, way * clear)
        if effort.stop:
            return False  # what was found may be too little
        bodies.put(row, to)
        return True


class Things(Blocking):
    """The objects, for one user's frame. Those that are pushed give way."""

    def __init__(self, runner: ObjectsRunner, frame: Frame, since: int) -> None:
        """frame: whose it is.  since: the moves it was told of."""
        body, stop = frame.body, frame.effort.stop
        super().__init__(
            runner.name, runner.bodies, TOLD | PUSHED, body.name, body.avatar, body.pose, stop=stop
        )
        self._runner, self._since = runner, since

    def give_way(self, frame: Frame, hit: Hit, to: Pose) -> bool:
        """One that can be pushed is moved by what is left of the way; of a move nothing is remembered of, none is."""
        bodies = self._runner.bodies
        if not self.is_own(hit):
            return False
        with bodies.lock:
            row = bodies.row_of(hit.what, user=False)
            if row < 0 or bodies.kinds[row] != PUSHED or not bodies.remembers(frame.body):
                return False
            if hit.avatar is None or hit.cloud is None:
                return False
            left = level(to[:3, 3] - frame.pose[:3, 3], bodies.up)
            inward = level(hit.cloud - hit.avatar, bodies.up)
            if not dot(left, inward) > _HEAD_ON * size(left) * size(inward):
                return False
            if not self._runner.push(hit.what, left, frame.body.name, frame.effort):
                return False
            frame.reports[self._runner.name] = self._runner.report(self._since, frame.effort)
            return True
