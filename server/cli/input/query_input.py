"""Queries of `solidcloud query`: their options, the input files and the requests made from them."""

from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from ....schemas.errors import BadRequestError
from ....schemas.wire.answers import Cost
from ....schemas.wire.motion_messages import Moved
from ....schemas.wire.path_messages import part_to_answers
from ....schemas.wire.question_rules import Question
from ....schemas.wire.question_table import OBJECTS, QUESTIONS, join_answers, path_questions
from ....schemas.wire.request_limits import MAX_FRAME_SECONDS
from ....schemas.wire.requests import make_positions
from ...scene_interface import AvatarShape
from .pose_file import read_objects, read_poses, read_rays
from .scan_bounds import BodyPlaces, Places, PointPlaces, RayPlaces, box_of

# Files that give arguments of questions: option of each.
_FILES = {
    "avatar": "avatar",
    "poses": "poses",
    "pose_from": "poses",
    "pose_to": "poses",
    "origins": "rays",
    "directions": "rays",
    "points": "points",
    "objects": "objects",
}
# Options of the files of avatars, besides the radius.
AVATAR_OPTIONS = ("avatar_up", "avatar_units", "avatar_hollow")
# Options that are not sent as parameters.
_NOT_SENT = frozenset({*_FILES.values(), *AVATAR_OPTIONS, "radius", "along"})

ReadPoints = Callable[[Path], NDArray[np.float64]]
# Returns the shape of an avatar's file for the radius that was given.
ReadAvatar = Callable[[Path, float | None], AvatarShape]


class QueryTarget(Protocol):
    """A `Client` or a `Scene`."""

    def add_avatar(self, name: str, points: Any, /) -> Any: ...
    def ask(self, question: Question[Any], *what: Any, **parameters: Any) -> Any: ...
    def path(self, *what: Any, **parameters: Any) -> Any: ...
    def move(self, *what: Any, **parameters: Any) -> Moved: ...


class AnswerPart(NamedTuple):
    """Answers to a query or to a part of it.

    labels: description of the item of each answer.  times: of each item [s], if it is a pose or
    motion.
    places: positions of all items of the whole query, even if these answers are a part of it.
    """

    labels: list[str]
    times: list[float]
    answers: Cost
    places: Places


class Query(NamedTuple):
    """A query and its checked options.

    op: the query's name.  along: the query made along a path, if op is "path".
    given: the options that were given.
    """

    op: str
    along: str
    given: dict[str, Any]


def check_query(op: str, options: dict[str, Any]) -> Query:
    """Return the query for the options that are not None.

    Raises BadRequestError, which names an option that the query does not take or one that is
    missing.
    """
    if op not in (*QUESTIONS, "move", "path"):
        raise BadRequestError(f"--op {op}: expected one of {', '.join((*QUESTIONS, 'move', 'path'))}")
    given = {name: value for name, value in options.items() if value is not None}
    along = given.get("along", "collide")
    asked = f"--op path --along {along}" if op == "path" else f"--op {op}"
    needed: tuple[str, ...]
    others: tuple[str, ...]
    if op == "move":  # the budget of a frame is set by the scene, not by the request
        needed, others = ("avatar", "poses"), ("radius", *AVATAR_OPTIONS)
    elif op == "path":
        if along not in path_questions():
            raise BadRequestError(f"--along {along}: expected one of {', '.join(path_questions())}")
        needed, others = _options(QUESTIONS[along])
        others = (*others, "along")
    else:
        needed, others = _options(QUESTIONS[op])
    takes = ", ".join(map(_option, (*needed, *others)))
    for name in given:
        if name not in (*needed, *others):
            raise BadRequestError(f"{_option(name)} is not an option of {asked}: it takes {takes}")
    for name in needed:
        if name not in given:
            raise BadRequestError(f"{asked} needs {_option(name)}: it takes {takes}")
    return Query(op, along, given)


def _options(question: Question[Any]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the required and the optional options of a question."""
    files = dict.fromkeys(_FILES[name] for name in question.arguments if name in _FILES)
    of_avatar = ("radius", *AVATAR_OPTIONS) if question.about_avatars else ()
    parameters = question.parameters
    needed = (*files, *(name for name in parameters if name in question.required))
    others = (name for name in parameters if name not in question.required)
    return needed, (*of_avatar, *others, *sorted(question.options))


def ask(
    scene: QueryTarget, query: Query, read_points: ReadPoints, read_avatar: ReadAvatar
) -> Iterator[AnswerPart]:
    """Make a query and yield its answers at once, or in parts for a path.

    read_points: returns the points (n, 3) of a file [m].
    """
    given = dict(query.given)
    parameters = {name: value for name, value in given.items() if name not in _NOT_SENT}
    question = QUESTIONS[query.along if query.op == "path" else query.op]
    if "objects" in question.arguments:
        yield _ask_objects(scene, given["objects"], read_avatar, parameters, given.get("radius"))
        return
    if "avatar" not in question.arguments:
        rays = "directions" in question.arguments
        what = read_rays(given["rays"]) if rays else (read_points(given["points"]),)
        answers = scene.ask(question, *what, **parameters)
        labels = [f"{'ray' if rays else 'point'} {number}" for number in range(len(answers))]
        kind: Any = RayPlaces if rays else PointPlaces
        yield AnswerPart(labels, [], answers, kind(*what, given.get("reach", 0.0)))
        return
    moving = question.moving
    times, poses = read_poses(given["poses"])
    labels, begins = _labels(times.tolist(), moving=moving)
    places = _add_body(scene, query, read_avatar, poses, moving=moving)
    if query.op == "path":
        for part in scene.path("avatar", poses, question.name, **parameters):
            which = slice(part.first, part.first + len(part))
            yield AnswerPart(labels[which], begins[which], part_to_answers(part), places)
    else:
        ends = (poses[:-1], poses[1:]) if moving else (poses,)
        yield AnswerPart(labels, begins, scene.ask(question, "avatar", *ends, **parameters), places)


def ask_moves(
    scene: QueryTarget, query: Query, read_avatar: ReadAvatar
) -> tuple[Places, Iterator[tuple[str, Moved]]]:
    """Simulate one frame from each pose towards the next; frames do not depend on one another.

    A frame lasts from the time of one pose to that of the next. Returns the positions of the
    motions, and an iterator over the frames: a label and the result of each.
    """
    times, poses = read_poses(query.given["poses"])
    places = _add_body(scene, query, read_avatar, poses, moving=True)
    labels, _ = _labels(times.tolist(), moving=True)

    def frames() -> Iterator[tuple[str, Moved]]:
        for number, (label, seconds) in enumerate(zip(labels, np.diff(times).tolist(), strict=True)):
            pose_from, pose_to = poses[number : number + 1], poses[number + 1 : number + 2]
            yield label, scene.move("avatar", pose_from, pose_to, min(seconds, MAX_FRAME_SECONDS))

    return places, frames()


def joined(found: list[AnswerPart]) -> AnswerPart:
    """Join the parts of one query's answers."""
    labels = [label for part in found for label in part.labels]
    times = [time for part in found for time in part.times]
    return AnswerPart(labels, times, join_answers([part.answers for part in found]), found[0].places)


def _add_body(
    scene: QueryTarget, query: Query, read_avatar: ReadAvatar, poses: NDArray[np.float64], *, moving: bool
) -> BodyPlaces:
    """Add the avatar of a query; return its positions at the poses, or on motions between them."""
    shape = read_avatar(query.given["avatar"], query.given.get("radius"))
    box = box_of(make_positions(shape.points))
    radius = scene.add_avatar("avatar", shape).radius
    ends = (poses[:-1], poses[1:]) if moving else (poses, poses)
    return BodyPlaces(box[None], np.array([radius or 0.0]), _around(query), *ends)


def _around(query: Query) -> float:
    """Return the margin or reach of a query, in addition to the radii [m]; 0 if it has neither."""
    question = QUESTIONS.get(query.along if query.op == "path" else query.op)
    if question is None or question.around is None:
        return 0.0
    name = question.arguments[question.around]
    around: float = query.given.get(name, question.defaults.get(name, 0.0))
    return around


def _ask_objects(
    scene: QueryTarget, path: Path, read_avatar: ReadAvatar, parameters: dict[str, Any], radius: float | None
) -> AnswerPart:
    """Query the objects of a file."""
    rows = read_objects(path)
    names = {
        avatar: f"avatar-{number}" for number, avatar in enumerate(dict.fromkeys(row.avatar for row in rows))
    }
    bodies = {}
    for avatar, name in names.items():
        shape = read_avatar(avatar, radius)
        bodies[avatar] = box_of(make_positions(shape.points)), scene.add_avatar(name, shape).radius or 0.0
    listed = [(names[row.avatar], row.pose, row.group, row.mask) for row in rows]
    answers = scene.ask(OBJECTS, listed, **parameters)
    boxes = np.array([bodies[row.avatar][0] for row in rows]).reshape(-1, 2, 3)
    radii = np.array([bodies[row.avatar][1] for row in rows], np.float64)
    poses = np.array([row.pose for row in rows]).reshape(-1, 4, 4)
    places = BodyPlaces(boxes, radii, parameters.get("margin", 0.0), poses, poses)
    labels = [f"object {number} {row.avatar.name}" for number, row in enumerate(rows)]
    return AnswerPart(labels, [], answers, places)


def _labels(times: list[float], *, moving: bool) -> tuple[list[str], list[float]]:
    """Return the label of each answer and the time at which its item begins [s]."""
    if not moving:
        return [f"{time:10.3f} s" for time in times], times
    return [f"{begin:10.3f} .. {end:10.3f} s" for begin, end in pairwise(times)], times[:-1]


def _option(name: str) -> str:
    """Return the command-line option for a parameter."""
    return "--" + name.replace("_", "-")
