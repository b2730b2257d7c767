"""Answers of stopped requests: unknown where nothing was computed, with the reason of the stop."""

from collections.abc import Callable
from typing import Any, TypeVar

from msgspec import structs

from ...schemas.wire.answers import Cost
from ...schemas.wire.columns import unknown
from ...schemas.wire.questions import Question
from ..runtime.stop_flag import StoppedError
from .context.query_budget import Effort

_A = TypeVar("_A", bound=Cost)


def ask_until_stopped(question: Question[_A], k: int, effort: Effort, ask: Callable[[], _A]) -> _A:
    """Run a query of k poses (motions, rays, points, objects) with `ask`; add a stop's reason."""
    try:
        answers = ask()
    except StoppedError:
        stopped: _A = unknown_part(question.answers, k, effort)
        return stopped
    return structs.replace(answers, stopped=effort.stop.reason) if effort.stop else answers


def unknown_part(kind: type[Any], k: int, effort: Effort) -> Any:
    """Return `unknown` for k poses (motions, rays, points, objects), with the stop's reason."""
    answers = unknown(kind, k, bounded=effort.limited or effort.tolerance > 0.0)
    return structs.replace(answers, stopped=effort.stop.reason)
