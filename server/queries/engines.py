"""The function that answers each question of schemas/wire/questions.py.

Each takes the data of one archive, the avatar if the question is about one, the arguments of the request in their
order, and `budget`. `objects` takes avatars, poses, groups, masks and margin.
"""

from collections.abc import Callable
from typing import Any

from numpy.typing import ArrayLike

from ...schemas.wire.answers import SweepAnswers
from ...schemas.wire.questions import COLLIDE, CONTACTS, DISTANCE, OBJECTS, RAYCAST, SWEEP, WITHIN
from ..avatars.avatar_model import AvatarModel
from .contacts import contacts
from .context.query_budget import QueryBudget
from .context.query_context import SceneData
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
