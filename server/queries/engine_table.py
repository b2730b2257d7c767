"""Table of the engines: the function that answers each question of schemas/wire/question_table.py.

An engine takes the data of one archive, the avatar if the question is about one, the arguments of
the request in their order, and `budget`. `objects` takes avatars, poses, groups, masks and margin.
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

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
from .collide import collide_fast
from .contacts import contacts
from .distance import distance_fast
from .objects import objects
from .query_inputs import QueryBudget, SceneData
from .rays_and_points import raycast, within
from .sweep import sweep_fast

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
    if part not in QUESTIONS:
        return
    question, pose = QUESTIONS[part], np.eye(4)[None]
    pose[0, :3, 3] = place
    avatar = make_avatar([[0.0, 0, 0], [0.1, 0, 0]])
    # One pose or motion takes other kernels than several do, and a tolerance asks the level of detail.
    for k, tolerance in ((2, 0.0), (1, 0.0), (1, 1e-3)):
        poses = np.repeat(pose, k, axis=0)
        points, groups = poses[:, :3, 3].copy(), np.full(k, 0xFFFFFFFF, np.uint32)
        samples: dict[str, Any] = {
            "avatar": avatar, "poses": poses, "pose_from": poses, "pose_to": poses, "points": points,
            "origins": points, "directions": np.full((k, 3), [0.0, 0.0, 1.0]), "reach": 0.01,
        }  # fmt: skip
        arguments = [samples[name] for name in question.arguments if name in samples]
        if question.name == OBJECTS.name:
            arguments = [[avatar] * k, poses, groups, groups]
        tolerance = max(tolerance, question.other_defaults.get("tolerance", 0.0))
        ENGINES[part](data, *arguments, budget=QueryBudget(tolerance=tolerance))
