"""Each query as a call, and checks that an answer that was cut short is not wrong, for tests of stops."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from solidcloud.schemas.wire import question_table as questions
from solidcloud.schemas.wire.answers import ObjectsAnswers, Verdict
from solidcloud.server.avatars.avatar_model import AvatarModel
from solidcloud.server.queries.collide import collide_fast
from solidcloud.server.queries.contacts import contacts, separation_per_scan
from solidcloud.server.queries.distance import distance, distance_fast
from solidcloud.server.queries.load_and_search import ask_until_stopped
from solidcloud.server.queries.objects import objects
from solidcloud.server.queries.query_inputs import QueryBudget, SceneData, with_stop
from solidcloud.server.queries.rays_and_points import raycast, within
from solidcloud.server.queries.sweep import sweep

CLEAR, CONTACT, UNKNOWN = Verdict


class Asked(NamedTuple):
    """Arguments of the queries. poses: (k, 4, 4).  margin, reach: [m]."""

    data: SceneData
    avatar: AvatarModel
    poses: NDArray[np.float64]
    margin: float = 0.0
    reach: float = 0.5


def _ask(engine: Any, k: int, a: Asked, budget: QueryBudget, *what: Any) -> Any:
    data, question = with_stop(a.data, budget.stop), engine.__name__.removesuffix("_fast")
    return ask_until_stopped(
        questions.QUESTIONS[question], k, budget, lambda: engine(data, *what, budget=budget)
    )


def _objects(a: Asked, budget: QueryBudget) -> ObjectsAnswers:
    n, both = len(a.poses), np.full(len(a.poses), 0xFFFFFFFF, np.uint32)
    found: ObjectsAnswers = _ask(objects, n, a, budget, [a.avatar] * n, a.poses, both, both, a.margin)
    return found


def _collide(a: Asked, budget: QueryBudget) -> Any:
    return _ask(collide_fast, len(a.poses), a, budget, a.avatar, a.poses, a.margin)


def _distance(a: Asked, budget: QueryBudget) -> Any:
    return _ask(distance, len(a.poses), a, budget, a.avatar, a.poses, a.reach)


def _near(a: Asked, budget: QueryBudget) -> Any:
    data = with_stop(a.data, budget.stop)
    return ask_until_stopped(
        questions.DISTANCE, 1, budget, lambda: distance_fast(data, a.avatar, a.poses[0], a.reach, budget)
    )


def _places(a: Asked) -> NDArray[np.float64]:
    return np.ascontiguousarray(a.poses[:, :3, 3])


QUESTIONS: dict[str, Callable[[Asked, QueryBudget], Any]] = {
    "collide": _collide,
    "collide of one pose": lambda a, e: _collide(a._replace(poses=a.poses[:1]), e),
    "distance": _distance,
    "distance of one pose": _near,
    "contacts": lambda a, e: _ask(contacts, len(a.poses), a, e, a.avatar, a.poses, 20, a.margin + 0.02),
    "sweep": lambda a, e: _ask(
        sweep, len(a.poses) - 1, a, e, a.avatar, a.poses[:-1], a.poses[1:], a.margin, 1e-6
    ),
    "raycast": lambda a, e: _ask(raycast, len(a.poses), a, e, _places(a), a.poses[:, :3, 0].copy(), 4.0),
    "within": lambda a, e: _ask(within, len(a.poses), a, e, _places(a), a.reach),
    "objects": _objects,
}


def gaps(a: Asked, budget: QueryBudget) -> Any:
    """Return `separation_per_scan` of the first pose."""
    return separation_per_scan(with_stop(a.data, budget.stop), a.avatar, a.poses[0], a.reach, 2, budget)
