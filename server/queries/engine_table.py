"""Table of the engines: the function that answers each question of schemas/wire/question_table.py.

An engine takes the data of one archive, the avatar if the question is about one, the arguments of
the request in their order, and `budget`. `objects` takes avatars, poses, groups, masks and margin.
"""

import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ...schemas.wire.answers import SweepAnswers
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
from ..avatars.avatar_model import AvatarModel, make_avatar
from ..residency.coarse_bounds import drop_clear_pairs
from .collide import collide
from .contacts import contacts
from .context.query_budget import EXACT, QueryBudget
from .context.query_context import SceneData, check_request
from .distance import distance
from .objects import objects
from .raycast import raycast
from .resident_fast_path import collide_fast
from .sweep import sweep
from .within import within


def _sweep(
    data: SceneData,
    avatar: AvatarModel,
    pose_from: ArrayLike,
    pose_to: ArrayLike,
    margin: float = 0.0,
    *,
    budget: QueryBudget,
) -> SweepAnswers:
    """Answer `sweep`, whose tolerance is also the length of its intervals."""
    return sweep(data, avatar, pose_from, pose_to, margin, budget.tolerance, budget)


ENGINES: dict[str, Callable[..., Any]] = {
    COLLIDE.name: collide_fast,
    DISTANCE.name: distance,
    CONTACTS.name: contacts,
    SWEEP.name: _sweep,
    RAYCAST.name: raycast,
    WITHIN.name: within,
    OBJECTS.name: objects,
}


def warm_engines(data: SceneData, place: Sequence[float], *, last_first: bool = False) -> None:
    """Run every query of an archive once, so that every kernel is compiled or read from its file.

    place: a scan point, world [m]; its voxel is loaded.  last_first: begin with what is needed
    last, while another process begins with the first.
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
    # Queries with a limit use separate kernels. These limits are too large to be reached here.
    limits = QueryBudget(tolerance=1e-3, visits=1 << 20), QueryBudget(deadline=time.perf_counter() + 3600.0)
    steps: list[Callable[[], Any]] = []
    for budget in (EXACT, *limits):
        # Several poses use other kernels than one pose.
        steps.append(partial(collide, data, avatar, poses, 0.0, budget))
        for question in (one for one in QUESTIONS.values() if not one.whole):
            arguments = [
                samples[name] for name in question.arguments if name in question.required or name in samples
            ]
            tolerance = max(budget.tolerance, question.other_defaults.get("tolerance", 0.0))
            limit = budget._replace(tolerance=tolerance)
            steps.append(partial(ENGINES[question.name], data, *arguments, budget=limit))
        steps.append(partial(objects, data, [avatar, avatar], poses, groups, groups, budget=budget))
    for step in reversed(steps) if last_first else steps:
        step()
    if data.coarse is not None:
        # A load has stored the coarse bounds of a voxel: test them as if it were not resident.
        reach = check_request(data, avatar, pose, data.radius_units)
        nowhere = data.arrays._replace(where=np.full_like(data.arrays.where, -1))
        drop_clear_pairs(nowhere, data.coarse.arrays, avatar.arrays, pose, reach)
