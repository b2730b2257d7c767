"""Answers of stopped requests: unknown where nothing was computed, with the reason of the stop."""

from collections.abc import Callable
from typing import Any, TypeVar

from msgspec import structs

from ...schemas.wire.answers import (
    CollideAnswers,
    ContactsAnswers,
    Cost,
    DistanceAnswers,
    ObjectsAnswers,
    RaycastAnswers,
    SweepAnswers,
    WithinAnswers,
)
from ...schemas.wire.columns import unknown
from ..runtime.stop_flag import StoppedError
from .collide import collide
from .contacts import contacts
from .context.query_budget import Effort
from .distance import distance
from .objects import objects
from .raycast import raycast
from .sweep import sweep
from .within import within

_A = TypeVar("_A", bound=Cost)

_ANSWERS: dict[Callable[..., Any], type[Cost]] = {
    collide: CollideAnswers,
    distance: DistanceAnswers,
    contacts: ContactsAnswers,
    sweep: SweepAnswers,
    raycast: RaycastAnswers,
    within: WithinAnswers,
    objects: ObjectsAnswers,
}


def ask_until_stopped(question: Callable[..., _A], k: int, effort: Effort, ask: Callable[[], _A]) -> _A:
    """Run a query of k poses (motions, rays, points, objects) with `ask`; add a stop's reason."""
    try:
        answers = ask()
    except StoppedError:
        return unknown_part(_ANSWERS[question], k, effort)
    return structs.replace(answers, stopped=effort.stop.reason) if effort.stop else answers


def unknown_part(kind: type[Any], k: int, effort: Effort) -> Any:
    """Return `unknown` for k poses (motions, rays, points, objects), with the stop's reason."""
    answers = unknown(kind, k, bounded=effort.limited or effort.tolerance > 0.0)
    return structs.replace(answers, stopped=effort.stop.reason)
