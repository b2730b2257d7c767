"""Declaration of a question: request, rules of its answers' columns, and code for all questions.

question_table.py declares the questions. Everything generic reads the declarations: checks, unknown
answers, joining, merging over archives, requests in batches, dispatch, the command line and the
tests of WIRE.md. No numba here. The functions that answer are in server/queries.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from enum import Enum, auto
from functools import cache, cached_property
from itertools import pairwise
from typing import Any, Generic, NamedTuple, TypeVar, get_type_hints

import numpy as np
from msgspec.structs import fields as struct_fields
from numpy.typing import NDArray

from ..archive.pose_arrays import make_poses
from ..errors import BadRequestError, InternalError
from .answer_facts import Fact
from .answers import Cost, Verdict
from .arrays import ArrayType, Poses, array_fields
from .requests import OPTIONS, Length, QuestionRequest, TolerantRequest, make_objects, make_vectors

A = TypeVar("A", bound=Cost)

_LAST_VERDICT = int(max(Verdict))


class Rows(Enum):
    """Number of rows of a column."""

    ITEMS = auto()  # one per item: pose, motion, ray, point or object
    BOUNDED = auto()  # one per item, or none: if neither a tolerance nor a budget was given
    STARTS = auto()  # one more than items: item i has the rows [starts[i], starts[i + 1])
    LISTED = auto()  # as many as the column of starts `ColumnRules.of` says
    PAIRS = auto()  # one per listed pair of items


class Merge(Enum):
    """Rule by which values of several archives become one (server/archives/merge_answers.py)."""

    VERDICT = auto()  # contact with any is contact; clear is what is clear of all
    ALL = auto()  # true if it is true for every archive
    SUM = auto()  # clipped to the largest value of the column's dtype
    LEAST = auto()
    NEAREST = auto()  # the value of the archive that `Question.nearest` selects
    FIRST = auto()  # the value of the first archive, the only one that was queried for it
    LISTED = auto()  # rows of all archives, deepest first
    EXACT_VERDICT = auto()  # an exact contact with one archive, or exact answers of all
    EXACT_NEAREST = auto()  # the nearest is exact, and no archive can contain a nearer one
    EXACT_INTERVAL = auto()  # an exact contact that begins first, or clear of all


class ColumnFrame(Enum):
    """Kind of a column's values, which decides how they are transformed to the world."""

    NONE = auto()  # the same in every frame
    POINT = auto()
    DIRECTION = auto()
    BOX_LOW = auto()  # corners of boxes; the column of BOX_HIGH comes next
    BOX_HIGH = auto()
    SCAN = auto()  # rows of the archive's scans, -1: not known


class ColumnRules(NamedTuple):
    """Rules of one column of answers.

    merge, frame, rows: see these classes.  of: name of the column of starts, for `Rows.LISTED`.
    unknown: value of the column in unknown answers; vectors of floats are NaN instead.
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


def total_cost(answers: Sequence[Cost]) -> dict[str, Any]:
    """Return the fields of `Cost`: sums, distinct faults and late voxels, the first stop reason."""
    total: dict[str, Any] = {
        name: sum([getattr(each, name) for each in answers])
        for name in ("engine_seconds", "hits", "misses", "resident", "resident_bytes", "wait_seconds")
    }
    for name in ("faults", "late"):
        total[name] = tuple(dict.fromkeys(fact for each in answers for fact in getattr(each, name)))
    total["stopped"] = next((each.stopped for each in answers if each.stopped), "")
    return total


# The question that each type of answers, or of their parts along a path, belongs to.
DECLARED: "dict[type[Cost], Question[Any]]" = {}


@dataclass(frozen=True, eq=False)
class Question(Generic[A]):
    """Declaration of a question: one kind of query with one answer per item.

    name: on the wire, of the methods and on the command line.
    request, answers: message types.  part: type of a part of the answers along a path; None: paths
    do not support the question.
    items: plural noun for the items of a request, such as "poses".
    columns: rules of the answers' array fields, besides `COMMON`.
    nearest: the column whose least value selects the nearest archive, and the columns of points
    that break ties; None: no column has `Merge.NEAREST`.
    slow: whether an item may take milliseconds, so that batches are small.
    whole: whether all items must be in one request, because they depend on one another.
    directions: array fields of the request whose vectors are directions, and not points.
    listed: the request's field that limits the rows listed per item, and the bytes of one row; None
    if no rows are listed.
    facts: facts in the line that describes the answers, besides the number of each verdict.
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
    facts: tuple[Fact, ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "columns", COMMON | dict(self.columns))
        expected = set(array_fields(self.answers))
        if set(self.columns) != expected:
            odd = ", ".join(sorted(expected ^ set(self.columns)))
            raise TypeError(f"{self.name}: {odd}: expected one rule for each array field")
        DECLARED.update({kind: self for kind in (self.answers, self.part) if kind is not None})

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
        """Return the fields of the request that are arguments of the method."""
        return tuple(name for name in self.request.__struct_fields__ if name not in OPTIONS)

    @cached_property
    def options(self) -> frozenset[str]:
        """Return the fields of the request that are options of the method."""
        return frozenset(OPTIONS).intersection(self.request.__struct_fields__)

    @cached_property
    def arguments(self) -> tuple[str, ...]:
        """Return the names of the method's arguments; `objects` contain their poses."""
        return tuple(name for name in self.fields if not (name == "poses" and "objects" in self.fields))

    @cached_property
    def defaults(self) -> dict[str, Any]:
        """Return the defaults of the request's fields."""
        return {field.name: field.default for field in struct_fields(self.request) if not field.required}

    @cached_property
    def other_defaults(self) -> dict[str, Any]:
        """Return the defaults of options that differ from those of `TolerantRequest`."""
        usual = {field.name: field.default for field in struct_fields(TolerantRequest)}
        own = self.options.intersection(usual)
        return {name: self.defaults[name] for name in own if self.defaults[name] != usual[name]}

    @cached_property
    def required(self) -> tuple[str, ...]:
        """Return the names in `fields` that have no default."""
        return tuple(name for name in self.fields if name not in self.defaults)

    @cached_property
    def parameters(self) -> tuple[str, ...]:
        """Return the names in `fields` that apply to all items: neither arrays nor avatars."""
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
        """Return the number of items along a path of `poses` poses."""
        return max(0, poses - 1) if self.moving else poses

    @cached_property
    def with_rows(self) -> dict[Rows, tuple[str, ...]]:
        """Return the names of the columns by their number of rows."""
        return {
            rows: tuple(name for name, column in self.columns.items() if column.rows is rows)
            for rows in {column.rows for column in self.columns.values()}
        }

    def all_arguments(self, given: tuple[Any, ...], named: dict[str, Any]) -> tuple[Any, ...]:
        """Return all arguments of the method in order, with defaults for missing ones.

        given: positional arguments.  named: arguments and options by name; the arguments are
        removed. Raise TypeError for too many or too few arguments.
        """
        names = self.arguments
        if len(given) == len(names):
            return given
        rest = [named.pop(name, self.defaults.get(name, given)) for name in names[len(given) :]]
        if len(given) > len(names) or any(value is given for value in rest):
            raise TypeError(f"{self.name}: expected the arguments {', '.join(names)}")
        return (*given, *rest)

    @cached_property
    def around(self) -> int | None:
        """Return the position of the argument that limits the distance (margin, reach), or None."""
        return next((i for i, name in enumerate(self.arguments) if name in ("margin", "reach")), None)

    def rows_of(self, starts: str) -> tuple[str, ...]:
        """Return the names of the columns whose row ranges are in a column of starts."""
        return tuple(name for name, column in self.columns.items() if column.of == starts)

    def most_items(self, most: int, most_bytes: int, given: Mapping[str, Any]) -> int:
        """Return the number of items, at most `most`, whose answer takes at most `most_bytes`.

        given: fields of the request by name; missing ones have their defaults.
        """
        if self.listed is None:
            return most
        name, row_bytes = self.listed
        rows = given.get(name)
        if rows is None:
            rows = self.defaults[name]
        return min(most, max(1, most_bytes // (row_bytes * max(1, rows))))

    def unknown(self, k: int, *, bounded: bool = True) -> A:
        """Return answers for k items (poses, rays, points, motions, objects), all `UNKNOWN`.

        They stand for a request that was not answered.
        bounded: whether columns with `Rows.BOUNDED` have values, as they do if a tolerance was given.
        """
        rows = {
            Rows.ITEMS: k,
            Rows.BOUNDED: k if bounded else 0,
            Rows.STARTS: k + 1,
            Rows.LISTED: 0,
            Rows.PAIRS: k * (k - 1) // 2,
        }
        columns: dict[str, Any] = {}
        for name, (dtype, tail, _) in array_fields(self.answers).items():
            rule = self.columns[name]
            if rule.rows is Rows.PAIRS and tail:
                columns[name] = np.column_stack(np.triu_indices(k, 1)).astype(dtype)
                continue
            filling = np.nan if tail and dtype.kind == "f" else rule.unknown
            columns[name] = np.full((rows[rule.rows], *tail), filling, dtype)
        return self.answers(**columns)

    def join(self, parts: Sequence[A]) -> A:
        """Concatenate the answers of several requests, in order, and sum their costs.

        `resident` and `resident_bytes` are those of the last answered request.
        """
        if len(parts) == 1:
            return parts[0]
        answered = [part for part in parts if part.resident or part.hits or part.misses] or parts
        fields: dict[str, Any] = {}
        for name, rule in self.columns.items():
            columns = [getattr(part, name) for part in parts]
            fields[name] = _joined_starts(columns) if rule.rows is Rows.STARTS else np.concatenate(columns)
        fields |= total_cost(parts)
        last = answered[-1]
        fields |= {"resident": last.resident, "resident_bytes": last.resident_bytes}
        return self.answers(**fields)

    def check(self, answers: A, k: int) -> A:
        """Return the answers if they are valid for k items. Raise InternalError otherwise."""
        kind = type(answers).__name__
        for name, verdict, rule in self._checks:
            column = getattr(answers, name)
            expected = k if rule is None else self._expected_rows(answers, rule, k)
            if len(column) != expected:
                raise InternalError(
                    f"{kind}: {len(column)} values in {name!r}, expected {expected}, for {k} requested"
                )
            if verdict and expected and max(column.tobytes()) > _LAST_VERDICT:
                raise InternalError(
                    f"{kind}: verdict {column.max()}, expected at most {_LAST_VERDICT}: upgrade the client"
                )
            if rule is None:
                continue
            if rule.rows is Rows.STARTS and (column[0] != 0 or (np.diff(column) < 0).any()):
                raise InternalError(f"{kind}: {name!r} does not ascend from 0")
            if rule.rows is Rows.PAIRS and column.ndim == 2 and not ((column >= 0) & (column < k)).all():
                raise InternalError(f"{kind}: pairs with objects that were not requested, of {k}")
        return answers

    @cached_property
    def _checks(self) -> tuple[tuple[str, bool, ColumnRules | None], ...]:
        """Return for each column its name, whether it has verdicts, and its rules.

        The rules are None for a column with one row per item.
        """
        rules = self.columns
        return tuple(
            (name, name.endswith("verdict"), None if rules[name].rows is Rows.ITEMS else rules[name])
            for name in array_fields(self.answers)
        )

    def _expected_rows(self, answers: A, rule: ColumnRules, k: int) -> int:
        """Return the number of rows of a column that does not have one row per item.

        k: number of items.
        """
        if rule.rows is Rows.STARTS:
            return k + 1
        if rule.rows is Rows.LISTED:
            starts = getattr(answers, rule.of)
            return int(starts[-1]) if len(starts) else 0
        first = len(getattr(answers, self.with_rows[rule.rows][0]))
        return first if rule.rows is Rows.PAIRS else k if first else 0


def request_fields(
    question: Question[Any], arguments: tuple[Any, ...], named: dict[str, Any]
) -> dict[str, Any]:
    """Return the fields of a question's request for the arguments of its method, by name.

    arguments, named: as in `Question.all_arguments`. Arrays are converted to the wire's types, and
    checked to have equal lengths.
    Raises BadRequestError for an invalid argument, TypeError for too many or too few.
    """
    fields = dict(zip(question.arguments, question.all_arguments(arguments, named), strict=True))
    if "objects" in fields:
        fields["objects"], fields["poses"] = make_objects(fields["objects"])
    for name, convert in _conversions(question.request):
        fields[name] = convert(fields[name], name)
    for first, second in pairwise(question.arrays):
        a, b = len(fields[first]), len(fields[second])
        if a != b:
            raise BadRequestError(f"{a} {first} and {b} {second}: expected equal numbers")
    return fields


def suggestion_for(name: str, names: Sequence[str]) -> str:
    """Return a question that suggests the valid name nearest to a wrong one; "" if none is near."""
    close = get_close_matches(name, names, 1)
    return f"did you mean {close[0]!r}? " if close else ""


@cache
def _conversions(kind: type[QuestionRequest]) -> tuple[tuple[str, Callable[[Any, str], Any]], ...]:
    """Return the conversion of each argument that needs one, with its name, by the field's type."""
    found: list[tuple[str, Callable[[Any, str], Any]]] = []
    for name, hint in get_type_hints(kind, include_extras=True).items():
        if hint == Poses:
            found.append((name, make_poses))
        elif name in OPTIONS:
            continue
        elif hint == Length:
            found.append((name, lambda value, _: float(value)))
        elif name in array_fields(kind):
            found.append((name, make_vectors))
    return tuple(found)


def _joined_starts(columns: list[NDArray[np.int64]]) -> NDArray[np.int64]:
    """Join columns of starts, each ascending from 0, into one."""
    total, joined = 0, [np.zeros(1, np.int64)]
    for column in columns:
        joined.append(column[1:] + total)
        total += int(column[-1])
    return np.concatenate(joined)
