"""Declarations of the questions: the types of each, and the rules of each column of its answers.

question_rules.py defines the rules. All generic code reads `QUESTIONS`, so a new question is a new
declaration there.
"""

from collections.abc import Sequence
from math import inf
from typing import Any, TypeVar

from .answer_facts import Fact, Summary
from .answer_forms import answer_line, answer_values
from .answers import (
    AnswerForms,
    CollideAnswers,
    CollidePart,
    ContactsAnswers,
    ContactsPart,
    Cost,
    DistanceAnswers,
    DistancePart,
    ObjectsAnswers,
    RaycastAnswers,
    SweepAnswers,
    SweepPart,
    Verdict,
    WithinAnswers,
    use_forms,
)
from .question_rules import ColumnFrame, ColumnRules, Merge, Question, Rows
from .requests import (
    CollideRequest,
    ContactsRequest,
    DistanceRequest,
    ObjectsRequest,
    RaycastRequest,
    SweepRequest,
    WithinRequest,
)

A = TypeVar("A", bound=Cost)

_POINT = ColumnRules(Merge.NEAREST, ColumnFrame.POINT)
_DIRECTION = ColumnRules(Merge.NEAREST, ColumnFrame.DIRECTION)
# Columns that `raycast` and `within` share.
_NEAREST = {
    "distance": ColumnRules(Merge.NEAREST, unknown=inf),
    "lower": ColumnRules(Merge.LEAST),
    "upper": ColumnRules(Merge.LEAST, unknown=inf),
    "exact": ColumnRules(Merge.EXACT_NEAREST),
    "cloud_point": _POINT,
}
_PAIR = ColumnRules(Merge.LISTED, rows=Rows.LISTED, of="pair_starts")
_CLUSTER = ColumnRules(Merge.LISTED, rows=Rows.LISTED, of="cluster_starts")

use_forms(AnswerForms(answer_line, answer_values))

COLLIDE = Question(
    "collide",
    CollideRequest,
    CollideAnswers,
    "poses",
    {
        "lower": ColumnRules(Merge.LEAST, rows=Rows.BOUNDED, unknown=-inf),
        "upper": ColumnRules(Merge.LEAST, rows=Rows.BOUNDED, unknown=inf),
        "exact": ColumnRules(Merge.EXACT_VERDICT, rows=Rows.BOUNDED),
    },
    part=CollidePart,
)
DISTANCE = Question(
    "distance",
    DistanceRequest,
    DistanceAnswers,
    "poses",
    {
        "signed_distance": ColumnRules(Merge.NEAREST, unknown=inf),
        "lower": ColumnRules(Merge.LEAST, unknown=-inf),
        "upper": ColumnRules(Merge.LEAST, unknown=inf),
        "exact": ColumnRules(Merge.EXACT_NEAREST),
        "witness_avatar": _POINT,
        "witness_cloud": _POINT,
        "normal": _DIRECTION,
    },
    nearest=("signed_distance", ("witness_cloud", "witness_avatar")),
    part=DistancePart,
    facts=(Fact("signed_distance", Summary.LEAST, "nearest {:.4g} m"),),
)
CONTACTS = Question(
    "contacts",
    ContactsRequest,
    ContactsAnswers,
    "poses",
    {
        "exact": ColumnRules(Merge.ALL),
        "pairs_found": ColumnRules(Merge.SUM),
        "pair_starts": ColumnRules(Merge.LISTED, rows=Rows.STARTS),
        "avatar_point": _PAIR._replace(frame=ColumnFrame.POINT),
        "cloud_point": _PAIR._replace(frame=ColumnFrame.POINT),
        "signed_distance": _PAIR,
        "avatar_index": _PAIR,
        "scan_index": _PAIR._replace(frame=ColumnFrame.SCAN),
        "cluster": _PAIR,
        "cluster_starts": ColumnRules(Merge.LISTED, rows=Rows.STARTS),
        "cluster_count": _CLUSTER,
        "cluster_deepest": _CLUSTER,
        "cluster_avatar": _CLUSTER._replace(frame=ColumnFrame.POINT),
        "cluster_cloud": _CLUSTER._replace(frame=ColumnFrame.POINT),
        "cluster_scan": _CLUSTER._replace(frame=ColumnFrame.SCAN),
        "cluster_low": _CLUSTER._replace(frame=ColumnFrame.BOX_LOW),
        "cluster_high": _CLUSTER._replace(frame=ColumnFrame.BOX_HIGH),
    },
    part=ContactsPart,
    slow=True,
    # A pair takes 68 bytes, and its cluster up to 116.
    listed=("limit", 184),
    facts=(
        Fact("pairs_found", Summary.SUM, "{} pairs", "1 pair"),
        Fact("cluster_count", Summary.ROWS, "{} clusters", "1 cluster"),
        Fact("cluster_deepest", Summary.LEAST, "deepest {:.4g} m"),
    ),
)
SWEEP = Question(
    "sweep",
    SweepRequest,
    SweepAnswers,
    "motions",
    {
        "lower": ColumnRules(Merge.LEAST),
        "upper": ColumnRules(Merge.NEAREST, unknown=inf),
        "exact": ColumnRules(Merge.EXACT_INTERVAL),
        "witness_avatar": _POINT,
        "witness_cloud": _POINT,
        "steps": ColumnRules(Merge.SUM),
    },
    nearest=("upper", ("witness_cloud", "witness_avatar")),
    part=SweepPart,
    slow=True,
    facts=(Fact("upper", Summary.LEAST, "earliest contact at {:.4g} of a motion"),),
)
RAYCAST = Question(
    "raycast",
    RaycastRequest,
    RaycastAnswers,
    "rays",
    _NEAREST | {"hit": _POINT, "normal": _DIRECTION},
    nearest=("distance", ("cloud_point",)),
    directions=("directions",),
    facts=(Fact("distance", Summary.LEAST, "nearest hit at {:.4g} m"),),
)
WITHIN = Question(
    "within",
    WithinRequest,
    WithinAnswers,
    "points",
    _NEAREST,
    nearest=("distance", ("cloud_point",)),
    facts=(Fact("distance", Summary.LEAST, "nearest scan point at {:.4g} m"),),
)
OBJECTS = Question(
    "objects",
    ObjectsRequest,
    ObjectsAnswers,
    "objects",
    {
        "pairs": ColumnRules(Merge.FIRST, rows=Rows.PAIRS),
        "pair_verdict": ColumnRules(Merge.FIRST, rows=Rows.PAIRS, unknown=Verdict.UNKNOWN),
    },
    whole=True,
    facts=(Fact("pair_verdict", Summary.CONTACTS, "{} pairs touch", "1 pair touches"),),
)

# All questions by name.
QUESTIONS: dict[str, Question[Any]] = {
    question.name: question for question in (COLLIDE, DISTANCE, CONTACTS, SWEEP, RAYCAST, WITHIN, OBJECTS)
}


def path_questions() -> dict[str, Question[Any]]:
    """Return the questions that paths support, by name."""
    return {name: question for name, question in QUESTIONS.items() if question.part is not None}


_BY_TYPE: dict[type, Question[Any]] = {}


def question_of(kind: type[Any]) -> Question[Any]:
    """Return the question to which a type of answers, or of their parts along a path, belongs."""
    found = _BY_TYPE.get(kind)
    if found is None:
        found = next(question for question in QUESTIONS.values() if issubclass(kind, question.answers))
        _BY_TYPE[kind] = found
    return found


def make_unknown(kind: type[A], k: int, *, bounded: bool = True) -> A:
    """Return `Question.unknown` for a type of answers."""
    answers: A = question_of(kind).unknown(k, bounded=bounded)
    return answers


def join_answers(parts: Sequence[A]) -> A:
    """Return `Question.join` of answers of one type."""
    answers: A = question_of(type(parts[0])).join(parts)
    return answers


def check_answers(answers: A, k: int) -> A:
    """Return `Question.check` of answers."""
    checked: A = question_of(type(answers)).check(answers, k)
    return checked
