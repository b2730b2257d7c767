"""Text lines and JSON values for the answers of all queries."""

import math
from collections.abc import Callable, Iterator
from itertools import groupby
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ....schemas.wire.answer_forms import VERDICT_NAMES, verdict_counts
from ....schemas.wire.answers import (
    CollideAnswers,
    ContactsAnswers,
    Cost,
    DistanceAnswers,
    ObjectsAnswers,
    RaycastAnswers,
    SweepAnswers,
    Verdict,
    WithinAnswers,
)
from ....schemas.wire.motion_messages import Moved
from ....schemas.wire.question_rules import COMMON, Question, Rows
from ....schemas.wire.question_table import question_of


def answer_lines(labels: list[str], times: list[float], answers: Any) -> Iterator[str]:
    """Yield one line per answer: label, verdict and result.

    For `collide`, there is one line per run of equal verdicts.
    labels: (k,), what each answer is about.  times: (k,) [s], for `collide` only.
    """
    if isinstance(answers, CollideAnswers):
        yield from _verdict_runs(times, answers)
        return
    for i, label in enumerate(labels):
        yield f"{label}  {VERDICT_NAMES[int(answers.verdict[i])]:<8}{_result_text(answers, i)}".rstrip()
    if isinstance(answers, ObjectsAnswers):
        for (first, second), verdict in zip(
            answers.pairs.tolist(), answers.pair_verdict.tolist(), strict=True
        ):
            yield f"objects {first} and {second}  {VERDICT_NAMES[verdict]}"


def word_of(answers: Any) -> str:
    """Return the plural noun for the items that the answers are about, such as "poses"."""
    return question_of(type(answers)).items


def summary_line(answers: Any, outside: NDArray[np.bool_] | None = None) -> str:
    """Return the count of each verdict, the count outside the scan if any, and the engine time."""
    counts = verdict_counts(answers.verdict)
    if outside is not None and outside.any():
        counts += f", {outside.sum()} outside the scan"
    return f"{len(answers)} {word_of(answers)}: {counts}; {answers.engine_seconds * 1e3:.2f} ms in the engine"


def unknown_line(answers: Any, unanswered: int) -> str:
    """Return a sentence with the number of answers that the server called unknown and the reason.

    unanswered: the number of unknown answers that never arrived; they are not counted.
    Returns "" if there are no others.
    """
    count = int((answers.verdict == Verdict.UNKNOWN).sum()) - unanswered
    if count <= 0:
        return ""
    if answers.faults:
        more = len(answers.faults) - 1
        why = answers.faults[0] + (f" (and {more} more)" if more else "")
    elif answers.stopped:
        why = answers.stopped
    elif answers.late:
        why = f"{len(answers.late)} voxels were not loaded in time"
    else:
        why = "the budget was spent, or a scan that the build left out is in reach"
    return f"{count} of {len(answers)} {word_of(answers)} are unknown: {why}"


def move_line(label: str, moved: Moved) -> str:
    """Format the result of a frame.

    The line has the verdict, final position, remaining motion and first obstacle.
    """
    line = f"{label}  {VERDICT_NAMES[moved.verdict]:<8}at {_point_text(moved.pose[0, :3, 3])}"
    if moved.left:
        line += f", {moved.left:.4f} m left"
    if moved.touched:
        line += f", touching {_point_text(np.array(moved.touched[0].place))}"
    return line


def answers_json(
    times: list[float], answers: Cost, outside: NDArray[np.bool_] | None = None
) -> dict[str, Any]:
    """Convert answers to the object that --json prints. Infinite and NaN values become null.

    times: (k,) [s], or empty.  outside: (k,), mask of the items outside the scan; None if not
    known.
    """
    values: dict[str, Any] = answers.to_dict()
    lies = (
        [{}] * len(values["answers"]) if outside is None else [{"outside_scan": x} for x in outside.tolist()]
    )
    when = [{"t": t} for t in times] or [{}] * len(lies)
    values["answers"] = [
        {**at, **row, **lie} for at, row, lie in zip(when, values["answers"], lies, strict=True)
    ]
    return {**values, "outside_scan": None if outside is None else int(outside.sum())}


def _verdict_runs(times: list[float], answers: CollideAnswers) -> Iterator[str]:
    """Yield one line per run of equal verdicts."""
    found = zip(times, answers.verdict.tolist(), strict=True)
    for verdict, group in groupby(found, key=lambda pair: pair[1]):
        stretch = [t for t, _ in group]
        span = f"{stretch[0]:10.3f} .. {stretch[-1]:10.3f} s"
        yield f"{span}  {VERDICT_NAMES[verdict]}, {len(stretch)} poses"


def _result_text(answers: Cost, i: int) -> str:
    """Format the result of one answer, without its verdict."""
    question = question_of(type(answers))
    form = _FORMS.get(question.name)
    return _own_columns(question, answers, i) if form is None else form(answers, i)


def _own_columns(question: Question[Any], answers: Cost, i: int) -> str:
    """Format the columns that only this question has."""
    own = [name for name, rule in question.columns.items() if rule.rows is Rows.ITEMS and name not in COMMON]
    return ", ".join(f"{name} {getattr(answers, name)[i]}" for name in own)


def _distance(answers: DistanceAnswers, i: int) -> str:
    if not math.isfinite(answers.signed_distance[i]):
        return _nothing_in_reach(answers, i)
    bounds = "" if answers.exact[i] else f", at least {answers.lower[i]:.6f} m"
    where = f"from {_point_text(answers.witness_avatar[i])} to {_point_text(answers.witness_cloud[i])}"
    return f"{answers.signed_distance[i]:.6f} m {where}{bounds}"


def _nearest(answers: RaycastAnswers | WithinAnswers, i: int) -> str:
    if not math.isfinite(answers.distance[i]):
        return _nothing_in_reach(answers, i)
    where = answers.hit[i] if isinstance(answers, RaycastAnswers) else answers.cloud_point[i]
    bounds = "" if answers.exact[i] else f", at least {answers.lower[i]:.6f} m"
    return f"{answers.distance[i]:.6f} m at {_point_text(where)}{bounds}"


def _sweep(answers: SweepAnswers, i: int) -> str:
    if not math.isfinite(answers.upper[i]):
        return "" if answers.lower[i] >= 1 else f"clear up to {answers.lower[i]:.9f} of the motion"
    span = f"from {answers.lower[i]:.9f} to {answers.upper[i]:.9f} of the motion"
    return f"{span}, at {_point_text(answers.witness_cloud[i])}"


def _contacts(answers: ContactsAnswers, i: int) -> str:
    if not answers.pairs_found[i]:
        return ""
    clusters = _rows_of_pose(answers.cluster_starts, i)
    text = f"{answers.pairs_found[i]} pairs in {clusters.stop - clusters.start} clusters"
    if clusters.start < clusters.stop:
        deepest = clusters.start
        text += f", {answers.cluster_deepest[deepest]:.6f} m at {_point_text(answers.cluster_cloud[deepest])}"
    return text


# Texts of results by question; any other question has its own columns by name.
_FORMS: dict[str, Callable[[Any, int], str]] = {
    "distance": _distance,
    "raycast": _nearest,
    "within": _nearest,
    "sweep": _sweep,
    "contacts": _contacts,
}


def _nothing_in_reach(answers: Any, i: int) -> str:
    """Format an answer whose query found nothing within its reach."""
    return f"nothing within {answers.lower[i]:.6f} m" if answers.lower[i] > 0 else ""


def _point_text(point: Any) -> str:
    """Format a point [m]."""
    return " ".join(f"{value:.4f}" for value in point)


def _rows_of_pose(starts: Any, i: int) -> slice:
    """Return the rows of pose i."""
    return slice(int(starts[i]), int(starts[i + 1]))
