"""Table of the engines: the function that answers each question of schemas/wire/question_table.py.

An engine takes the data of one archive, the avatar if the question is about one, the arguments of
the request in their order, and `budget`. `objects` takes avatars, poses, groups, masks and margin.
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from ...schemas.wire.question_rules import Question
from ...schemas.wire.question_table import (
    COLLIDE,
    CONTACTS,
    DISTANCE,
    OBJECTS,
    QUESTIONS,
    RAYCAST,
    SWEEP,
    WITHIN,
)
from ..avatars.avatar_model import make_avatar
from .collide import collide, collide_fast
from .contacts import contacts
from .distance import distance, distance_fast
from .objects import objects
from .query_inputs import EXACT, QueryBudget, SceneData
from .rays_and_points import raycast, within
from .sweep import sweep, sweep_fast

ENGINES: dict[str, Callable[..., Any]] = {
    COLLIDE.name: collide_fast,
    DISTANCE.name: distance_fast,
    CONTACTS.name: contacts,
    SWEEP.name: sweep_fast,
    RAYCAST.name: raycast,
    WITHIN.name: within,
    OBJECTS.name: objects,
}


def warm_engines(data: SceneData, place: Sequence[float], part: str) -> None:
    """Run the queries of a part once, so that their kernels are compiled or read from their files.

    place: a scan point, world [m]; its voxel is loaded.  part: one of warming_parts.py.
    """
    pose = np.eye(4)[None]
    pose[0, :3, 3] = place
    points, poses = pose[:, :3, 3].copy(), np.concatenate([pose, pose])
    avatar = make_avatar([[0.0, 0, 0], [0.1, 0, 0]])
    groups = np.full(2, 0xFFFFFFFF, np.uint32)
    samples: dict[str, Any] = {
        "avatar": avatar, "poses": pose, "pose_from": pose, "pose_to": pose, "points": points, "origins": points,
        "directions": np.array([[0.0, 0.0, 1.0]]), "reach": 0.01,
    }  # fmt: skip

    def run(question: Question[Any], budget: QueryBudget) -> None:
        if question.name == OBJECTS.name:
            objects(data, [avatar, avatar], poses, groups, groups, budget=budget)
            return
        if question.name == COLLIDE.name:  # several poses use other kernels than one pose
            collide(data, avatar, poses, 0.0, budget)
        if question.name == DISTANCE.name:
            distance(data, avatar, poses, 0.01, budget)
        if question.name == SWEEP.name:
            sweep(data, avatar, poses, poses, budget=budget)
        arguments = [
            samples[name] for name in question.arguments if name in question.required or name in samples
        ]
        tolerance = max(budget.tolerance, question.other_defaults.get("tolerance", 0.0))
        ENGINES[question.name](data, *arguments, budget=budget._replace(tolerance=tolerance))

    if part in QUESTIONS:
        run(QUESTIONS[part], EXACT)
    if part == COLLIDE.name:
        run(COLLIDE, QueryBudget(tolerance=1e-3))
