"""Declarations of the questions: what each asks, and the rules of each column of its answers.

Everything generic reads these: checks, unknown answers, joining, merging over archives, requests in
batches, dispatch, the command line and the tests of WIRE.md. No numba here. The functions that
answer are in server/queries.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum, auto
from functools import cached_property
from math import inf
from typing import Any, Generic, NamedTuple, TypeVar

from msgspec.structs import fields as struct_fields

from .answers import (
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
)
from .arrays import ArrayType, array_fields
from .requests import (
    CollideRequest,
    ContactsRequest,
    DistanceRequest,
    ObjectsRequest,
    QuestionRequest,
    RaycastRequest,
    SweepRequest,
    WithinRequest,
)

A = TypeVar("A", bound=Cost)


class Rows(Enum):
    """Number of rows of a column."""

    ITEMS = auto()  # one per item: pose, motion, ray, point or object
    BOUNDED = auto()  # one per item, or none: if neither a tolerance nor a budget was given
    STARTS = auto()  # one more than items: item i has the rows [starts[i], starts[i + 1])
    LISTED = auto()  # as many as the column of starts `ColumnRules.of` says
    PAIRS = auto()  # one per listed pair of items


class Merge(Enum):
    """How the values of several archives become one. server/archives/merge_answers.py has each."""

    VERDICT = auto()  # contact with any is contact; clear is what is clear of all
    ALL = auto()  # true if it is true of every archive
    SUM = auto()  # at most the largest number of the column's type
    LEAST = auto()
    NEAREST = auto()  # the value of the archive that `Question.nearest` selects
    FIRST = auto()  # the value of the first archive, which alone was asked
    LISTED = auto()  # rows of all archives, deepest first
    EXACT_VERDICT = auto()  # an exact contact with one archive, or exact answers of all
    EXACT_NEAREST = auto()  # the nearest is exact, and no archive may hold a nearer one
    EXACT_INTERVAL = auto()  # an exact contact that begins first, or clear of all


class ColumnFrame(Enum):
    """What the values of an archive at a pose are, and so how they are carried to the world."""

    NONE = auto()  # the same in every frame
    POINT = auto()
    DIRECTION = auto()
    BOX_LOW = auto()  # corners of boxes; the column of BOX_HIGH comes next
    BOX_HIGH = auto()
    SCAN = auto()  # rows of the archive's scans, -1: not known


class ColumnRules(NamedTuple):
    """Rules of one column of answers.

    merge, frame, rows: see there.  of: column of starts of a column with `Rows.LISTED`.
    unknown: value that means that nothing is known; vectors of floats are NaN then.
    """

    merge: Merge
    frame: ColumnFrame = ColumnFrame.NONE
    rows: Rows = Rows.ITEMS
    of: str = ""
    unknown: float = 0


# Columns that every answer has.
COMMON: dict[str, ColumnRules] = {
    "verdict": ColumnRules(Merge.VERDICT, unknown=Verdict.UNKNOWN),
    "outside": ColumnRules(Merge.ALL),
    "voxels_missing": ColumnRules(Merge.SUM),
    "node_visits": ColumnRules(Merge.SUM),
    "point_tests": ColumnRules(Merge.SUM),
}
_POINT = ColumnRules(Merge.NEAREST, ColumnFrame.POINT)
_DIRECTION = ColumnRules(Merge.NEAREST, ColumnFrame.DIRECTION)
# Columns of the nearest thing along a ray or around a point.
_NEAREST = {
    "distance": ColumnRules(Merge.NEAREST, unknown=inf),
    "lower": ColumnRules(Merge.LEAST),
    "upper": ColumnRules(Merge.LEAST, unknown=inf),
    "exact": ColumnRules(Merge.EXACT_NEAREST),
    "cloud_point": _POINT,
}
_PAIR = ColumnRules(Merge.LISTED, rows=Rows.LISTED, of="pair_starts")
_CLUSTER = ColumnRules(Merge.LISTED, rows=Rows.LISTED, of="cluster_starts")


@dataclass(frozen=True, eq=False)
class Question(Generic[A]):
    """One question.

    name: on the wire, of the methods and on the command line.
    request, answers: message types.  part: type of the answers' parts along a path; None: the
    question is not asked along paths.
    items: plural noun for what a request has several of.
    columns: rules of the answers' array fields, besides `COMMON`.
    nearest: the column with whose least value an archive is the nearest, and the columns of points
    that decide among equals; None: no column has `Merge.NEAREST`.
    slow: an item may take milliseconds, and batches are small.
    whole: all items are asked about in one request, because they depend on one another.
    directions: array fields of the request whose vectors are directions, and not points.
    listed: the request's field that limits the rows listed per item, and the bytes of one; None.
    """

    name: str
    request: type[QuestionRequest]
    answers: type[A]
    items: str
    columns: Mapping[str, ColumnRules]
    nearest: tuple[str, tuple[str, ...]] | None = None
    part: Any = None
    slow: bool = False
    whole: bool = False
    directions: tuple[str, ...] = ()
    listed: tuple[str, int] | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "columns", COMMON | dict(self.columns))
        expected = set(array_fields(self.answers))
        if set(self.columns) != expected:
            odd = ", ".join(sorted(expected ^ set(self.columns)))
            raise TypeError(f"{self.name}: {odd}: expected a rule for each array field, and for no other")

    @cached_property
    def arrays(self) -> dict[str, ArrayType]:
        """Return the array fields of the request; each has one element per item."""
        return array_fields(self.request)

    @cached_property
    def counted(self) -> str:
        """Return the request's first array field, whose length is the number of items."""
        return next(iter(self.arrays))

    @cached_property
    def fields(self) -> tuple[str, ...]:
        """Return the fields that only this question's request has."""
        options = QuestionRequest.__struct_fields__
        return tuple(name for name in self.request.__struct_fields__ if name not in options)

    @cached_property
    def arguments(self) -> tuple[str, ...]:
        """Return the arguments of the question's method; `objects` come with their poses."""
        return tuple(name for name in self.fields if not (name == "poses" and "objects" in self.fields))

    @cached_property
    def _defaults(self) -> dict[str, Any]:
        """Return the defaults of the request's fields."""
        return {field.name: field.default for field in struct_fields(self.request) if not field.required}

    @cached_property
    def other_defaults(self) -> dict[str, Any]:
        """Return the defaults that differ from those of `QuestionRequest`."""
        usual = {field.name: field.default for field in struct_fields(QuestionRequest)}
        return {name: self._defaults[name] for name in usual if self._defaults[name] != usual[name]}

    @cached_property
    def required(self) -> tuple[str, ...]:
        """Return those of `fields` that have no default."""
        return tuple(name for name in self.fields if name not in self._defaults)

    @cached_property
    def parameters(self) -> tuple[str, ...]:
        """Return those of `fields` that are the same for all items: neither arrays nor avatars."""
        return tuple(name for name in self.fields if name not in (*self.arrays, "avatar", "objects"))

    @cached_property
    def about_avatars(self) -> bool:
        """Return whether a request names avatars of its client."""
        return "avatar" in self.fields or "objects" in self.fields

    @cached_property
    def moving(self) -> bool:
        """Return whether items are motions of an avatar, each from one pose to another."""
        return self.about_avatars and len(self.arrays) == 2

    def items_along(self, poses: int) -> int:
        """Return the number of items along a path of so many poses."""
        return max(0, poses - 1) if self.moving else poses

    @cached_property
    def with_rows(self) -> dict[Rows, tuple[str, ...]]:
        """Return the columns with each number of rows."""
        return {
            rows: tuple(name for name, column in self.columns.items() if column.rows is rows)
            for rows in {column.rows for column in self.columns.values()}
        }

    def all_arguments(self, given: tuple[Any, ...], named: dict[str, Any]) -> tuple[Any, ...]:
        """Return all arguments of the method: those given, then those by name or their defaults.

        named: arguments and options by name; the arguments are removed. TypeError for too many or
        too few.
        """
        names = self.arguments
        if len(given) == len(names):
            return given
        rest = [named.pop(name, self._defaults.get(name, given)) for name in names[len(given) :]]
        if len(given) > len(names) or any(value is given for value in rest):
            raise TypeError(f"{self.name}: expected the arguments {', '.join(names)}")
        return (*given, *rest)

    @cached_property
    def around(self) -> int | None:
        """Return which argument says how far from an avatar the scene matters; None: no argument."""
        return next((i for i, name in enumerate(self.arguments) if name in ("margin", "reach")), None)

    def rows_of(self, starts: str) -> tuple[str, ...]:
        """Return the columns whose row ranges a column of starts has."""
        return tuple(name for name, column in self.columns.items() if column.of == starts)

    def most_items(self, most: int, most_bytes: int, given: Mapping[str, Any]) -> int:
        """Return how many items, at most `most`, fit into an answer of `most_bytes`.

        given: fields of the request by name; a missing one has its default.
        """
        if self.listed is None:
            return most
        name, row_bytes = self.listed
        rows = given.get(name)
        if rows is None:
            rows = self._defaults[name]
        return min(most, max(1, most_bytes // (row_bytes * max(1, rows))))


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
)
RAYCAST = Question(
    "raycast",
    RaycastRequest,
    RaycastAnswers,
    "rays",
    _NEAREST | {"hit": _POINT, "normal": _DIRECTION},
    nearest=("distance", ("cloud_point",)),
    directions=("directions",),
)
WITHIN = Question(
    "within",
    WithinRequest,
    WithinAnswers,
    "points",
    _NEAREST,
    nearest=("distance", ("cloud_point",)),
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
)

# All questions by name. Adding an entry makes a question known to everything generic.
QUESTIONS: dict[str, Question[Any]] = {
    question.name: question for question in (COLLIDE, DISTANCE, CONTACTS, SWEEP, RAYCAST, WITHIN, OBJECTS)
}


_BY_TYPE: dict[type, Question[Any]] = {}


def question_of(kind: type[Any]) -> Question[Any]:
    """Return the question to which a type of answers, or of their parts along a path, belongs."""
    found = _BY_TYPE.get(kind)
    if found is None:
        found = next(question for question in QUESTIONS.values() if issubclass(kind, question.answers))
        _BY_TYPE[kind] = found
    return found


def path_questions() -> dict[str, Question[Any]]:
    """Return the questions that are asked along paths, by name."""
    return {name: question for name, question in QUESTIONS.items() if question.part is not None}
