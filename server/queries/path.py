"""Query `path`: one query along thousands of poses, answered in parts and in order.

A few threads compute parts ahead of the consumer; kernels release the GIL. The number of answers in
a part depends on how long the previous ones took, so that the first part comes soon and no part
blocks others for long. The answers do not depend on it, except for the cost counters of a part.
"""

import math
from collections import deque
from collections.abc import Callable, Generator
from concurrent.futures import Executor, Future
from typing import Any

from ...schemas.errors import SolidcloudError
from ...schemas.wire.answers import Cost, Part
from ...schemas.wire.arrays import Poses
from ...schemas.wire.path_messages import answers_to_part, check_path_parameters, split_answers
from ...schemas.wire.question_table import QUESTIONS
from ..avatars.avatar_model import AvatarModel
from ..runtime.stop_flag import NO_STOP, StopFlag, stop_at
from .engine_table import ENGINES
from .load_and_search import ask_until_stopped, unknown_answers
from .query_inputs import SceneData, check_avatar, kernel_poses, make_budget, to_units, with_stop

# Default number of parts computed at a time.
PATH_THREADS = 2
# Answers in a part. The first part is small, so that it comes soon; later ones take about
# PART_SECONDS. At 1,024 answers the overhead of a part, a few tenths of a millisecond with zenoh,
# is a few per cent of the fastest query.
FIRST_PART = 64
LARGEST_PART = 1024
PART_SECONDS = 0.01
# Size of a part's answer, below the largest message even as JSON. There may be more clusters than
# contacts listed, so the size of a computed part is checked again.
_PART_BYTES = 8 << 20

Ask = Callable[[int, int], Cost]
# Function that computes answers [start, end) of a path, which form a part that begins at a time on
# time.perf_counter()'s clock [s].
AskPart = Callable[[int, int, float], Cost]


def path_question(
    data: SceneData,
    avatar: AvatarModel,
    poses: Poses,
    op: str,
    parameters: dict[str, Any],
    stop: StopFlag = NO_STOP,
) -> tuple[AskPart, int]:
    """Return the function that answers a range of a path, and the total number of answers.

    The budget's time begins with this call.
    poses: (k, 4, 4) float64.  parameters: of `op`, including tolerance and budgets.
    stop: ends the path early. A part that takes longer than `stop.part_seconds` is stopped without
    the rest of the path.
    All poses are checked here, so that an error names a pose by its position on the path. Raise
    BadRequestError, BadTransformError, TooLargeError.
    """
    given = {name: value for name, value in parameters.items() if value is not None}
    check_path_parameters(op, given)
    budgets = {name: given.pop(name) for name in ("relative_tolerance", "budget_ms") if name in given}
    question, engine = QUESTIONS[op], ENGINES[op]
    tolerance = given.pop("tolerance", question.other_defaults.get("tolerance", 0.0))
    # The voxels along a path are used once.
    budget = make_budget(tolerance, **budgets, stop=stop)._replace(scan=True)
    poses = kernel_poses(poses)  # copied here at most once, so that no part copies its poses
    around = next(name for name in question.parameters if name in ("margin", "reach"))
    other = to_units(given.setdefault(around, question.defaults[around]), around)
    check_avatar(with_stop(data, budget.request), avatar, poses, data.radius_units + other)

    def ask(start: int, end: int, begun: float) -> Cost:
        if budget.stop:
            return unknown_answers(question, end - start, budget)
        what = [poses[start:end], poses[start + 1 : end + 1]] if question.moving else [poses[start:end]]
        own = budget._replace(stop=part_stop(budget.stop, stop.part_seconds, begun))
        return ask_until_stopped(
            question,
            end - start,
            own,
            lambda: engine(with_stop(data, own.request), avatar, *what, **given, budget=own),
        )

    return ask, question.items_along(len(poses))


def part_stop(stop: StopFlag, seconds: float, begun: float) -> StopFlag:
    """Return the stop flag of a part that began at `begun`: set after `seconds` or with the path's."""
    if seconds == math.inf:
        return stop
    part = stop.part()
    reason = f"a part took longer than {seconds:g} s, the most that this server spends on one"
    stop_at(part, begun + seconds, reason)
    return part


def largest_part(op: str, parameters: dict[str, Any]) -> int:
    """Return how many answers of `op` a part may hold to fit in a message."""
    return QUESTIONS[op].most_items(LARGEST_PART, _PART_BYTES, parameters)


def path_parts(
    ask: Ask, total: int, most: int = LARGEST_PART, pool: Executor | None = None, ahead: int = 1
) -> Generator[Part, None, None]:
    """Yield the parts of a path in order; one empty part if the path is empty.

    most: limit of answers in a part.  pool: executor that computes up to `ahead` parts before they
    are consumed; None: each part is computed on demand, with `ahead` 1. Closing the generator cancels waiting
    parts; running ones complete.
    """
    waiting: deque[tuple[int, Future[Cost]]] = deque()
    size, start, submit = min(FIRST_PART, most), 0, _call_now if pool is None else pool.submit
    try:
        while waiting or start < max(1, total):
            while start < max(1, total) and len(waiting) < ahead:
                stop = min(start + size, total)
                waiting.append((start, submit(_ask_part, ask, start, stop)))
                start = max(1, stop)
            first, future = waiting.popleft()
            answers = future.result()
            for piece in split_answers(answers, _PART_BYTES):
                yield answers_to_part(piece, first, total)
                first += len(piece)  # type: ignore[arg-type]
            size = _next_size(size, answers, most)
    finally:
        for _, future in waiting:
            future.cancel()


def _call_now(call: Callable[..., Cost], *arguments: Any) -> Future[Cost]:
    """Call a function in this thread, and return its result as an executor does."""
    done: Future[Cost] = Future()
    done.set_result(call(*arguments))
    return done


def _ask_part(ask: Ask, start: int, stop: int) -> Cost:
    """Compute the answers for [start, stop); an error names the position on the path."""
    try:
        return ask(start, stop)
    except SolidcloudError as error:
        if start == 0:
            raise
        raise type(error)(f"in the part of the path that begins at {start}: {error}") from None


def _next_size(size: int, answers: Any, most: int) -> int:
    """Return the size of the next part from the time these answers took; at most 4 times `size`."""
    each = answers.engine_seconds / max(1, len(answers))
    fitting = most if each <= 0 else int(PART_SECONDS / each)
    return max(1, min(fitting, 4 * size, most))
