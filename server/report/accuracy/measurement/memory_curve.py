"""Time of `collide` and `distance` against the error allowed, with the scene in memory, by class of pose."""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from .....schemas.errors import InternalError
from .....schemas.wire.answers import Verdict
from ....scene import Scene
from ...common.paired_times import Floats, mean_ratio, time_in_turn
from .accuracy_results import REPEATS, MemoryRow
from .measured_scene import AVATAR, REACH
from .measurement_plan import MeasurementPlan
from .pose_classes import class_members, timed_poses
from .reference_answers import ReferenceAnswers

PASSES = 2
NEARLY = 1e-9  # of rounding of distances [m]


class _Timed(NamedTuple):
    """One class of poses under one question: a call for each tolerance, and their times.

    poses: (k, 4, 4).  rows: of the class's poses among all.  spent: (rounds, tolerances) of each pass.
    """

    question: str
    kind: str
    poses: Floats
    rows: Any
    calls: list[Callable[[], Any]]
    spent: list[Floats]


def memory_curve(
    scene: Scene, poses: Floats, reference: ReferenceAnswers, plan: MeasurementPlan, tick: Callable[[], None]
) -> list[MemoryRow]:
    """Measure all classes of the judged poses (k, 4, 4) with each tolerance of the plan, and exactly.

    All are timed in two passes, minutes apart on a slow machine: what does not repeat is marked.
    tick: called for each class and question of each pass.
    Raises InternalError if an answer is outside its bounds.
    """
    tolerances = (0.0, *plan.tolerances)
    subjects = []
    for kind, rows in class_members(reference.distance).items():
        own = timed_poses(poses[rows])
        questions: dict[str, Callable[..., Any]] = {"collide": partial(scene.collide, AVATAR, own)}
        if kind != "farther":  # there no pair is in reach
            questions["distance"] = partial(scene.distance, AVATAR, own, REACH)
        for question, ask in questions.items():
            calls: list[Callable[[], Any]] = [partial(ask, tolerance=tolerance) for tolerance in tolerances]
            subjects.append(_Timed(question, kind, own, rows, calls, []))
    for _ in range(PASSES):
        for subject in subjects:
            subject.spent.append(time_in_turn(subject.calls, plan.rounds))
            tick()
    return [row for subject in subjects for row in _rows(scene, subject, tolerances, poses, reference)]


def class_count(reference: ReferenceAnswers) -> int:
    """Return how often `memory_curve` calls `tick`."""
    kinds = class_members(reference.distance)
    return PASSES * (2 * len(kinds) - ("farther" in kinds))


def _rows(
    scene: Scene, subject: _Timed, tolerances: tuple[float, ...], poses: Floats, reference: ReferenceAnswers
) -> list[MemoryRow]:
    """Return the rows of one class and question; checks that their answers hold."""
    own, count = poses[subject.rows], len(subject.poses)
    contact, distance = reference.contact[subject.rows], reference.distance[subject.rows]
    found = []
    for at, tolerance in enumerate(tolerances):
        ratios = [spent[:, at] / spent[:, 0] for spent in subject.spent]
        ratio = mean_ratio(np.concatenate(ratios))
        first, last = (mean_ratio(each).ratio for each in ratios)
        error, early = None, 0.0
        if subject.question == "collide":
            collided = scene.collide(AVATAR, own, tolerance=tolerance)
            said, visits = collided.verdict == Verdict.CONTACT, collided.node_visits
            _check(bool((collided.verdict != Verdict.UNKNOWN).all()), tolerance)
            _check(
                not (contact & ~said).any() and not (said & (distance > tolerance + NEARLY)).any(), tolerance
            )
            early = float((said & ~contact).mean())
        else:
            found_pairs = scene.distance(AVATAR, own, REACH, tolerance=tolerance)
            off, visits = found_pairs.signed_distance - distance, found_pairs.node_visits
            _check(bool((np.abs(off - tolerance / 2) <= tolerance / 2 + NEARLY).all()), tolerance)
            error = float(off.max()) * 1e3
        found.append(
            MemoryRow(
                subject.question, subject.kind, len(subject.rows) / len(poses), tolerance,
                float(np.median(np.concatenate(subject.spent)[:, at])) / count * 1e6,
                *ratio, max(first, last) <= REPEATS * min(first, last), early, error,
                float(visits.mean()),
            )
        )  # fmt: skip
    return found


def _check(holds: bool, tolerance: float) -> None:
    """Raise InternalError unless the answers with a tolerance hold."""
    if not holds:
        raise InternalError(
            f"tolerance {tolerance:g} m: an answer is outside its bounds, expected none: this is a bug of this "
            "software, report it"
        )
