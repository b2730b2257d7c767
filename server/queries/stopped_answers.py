"""Answers of stopped requests: unknown where nothing was computed, with the reason of the stop."""

from collections.abc import Callable
from typing import Any, TypeVar

from msgspec import structs

from ...schemas.wire.answers import Cost
from ...schemas.wire.columns import unknown
from ...schemas.wire.questions import QUESTIONS
from ..runtime.stop_flag import StoppedError
from .context.query_budget import Effort

_A = TypeVar("_A", bound=Cost)


def ask_until_stopped(question: Callable[..., _A], k: int, effort: Effort, ask: Callable[[], _A]) -> _A:
    """Run a query of k poses (motions, rays, points, objects) with `ask`; add a stop's reason.

    question: function of server/queries, which has the name of its question.
    """
    try:
        answers = ask()
    except StoppedError:
        return unknown_part(QUESTIONS[question.__name__].answers, k, effort)
    return structs.replace(answers, stopped=effort.stop.reason) if effort.stop else answers


def unknown_part(kind: type[Any], k: int, effort: Effort) -> Any:
    """Return `unknown` for k poses (motions, rays, points, objects), with the stop's reason."""
    answers = unknown(kind, k, bounded=effort.limited or effort.tolerance > 0.0)
    return structs.replace(answers, stopped=effort.stop.reason)
