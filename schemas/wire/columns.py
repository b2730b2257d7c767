"""Operations on the columns of answers: fill with unknown, join, split into parts of a path, check."""

from collections.abc import Iterator, Sequence
from functools import cache
from typing import Any, TypeVar

import numpy as np
from msgspec.structs import asdict
from numpy.typing import NDArray

from ..errors import InternalError
from .answers import Cost, Verdict
from .arrays import array_fields
from .questions import ColumnRules, Rows, question_of

_LAST_VERDICT = int(max(Verdict))
_A = TypeVar("_A", bound=Cost)


def unknown(kind: type[_A], k: int, *, bounded: bool = True) -> _A:
    """Return answers of one type for k poses (rays, points, motions, objects), all `UNKNOWN`.

    They stand for a request that nobody answered.
    bounded: whether columns with `Rows.BOUNDED` have values, as they do if a tolerance or a budget
    was given.
    """
    rows = {
        Rows.ITEMS: k,
        Rows.BOUNDED: k if bounded else 0,
        Rows.STARTS: k + 1,
        Rows.LISTED: 0,
        Rows.PAIRS: k * (k - 1) // 2,
    }
    columns: dict[str, Any] = {}
    rules = question_of(kind).columns
    for name, (dtype, tail, _) in array_fields(kind).items():
        rule = rules[name]
        if rule.rows is Rows.PAIRS and tail:
            columns[name] = np.column_stack(np.triu_indices(k, 1)).astype(dtype)
            continue
        filling = np.nan if tail and dtype.kind == "f" else rule.unknown
        columns[name] = np.full((rows[rule.rows], *tail), filling, dtype)
    return kind(**columns)


def join(parts: Sequence[_A]) -> _A:
    """Join the answers of several requests, in order, into the answers of one.

    Residency is that after the last answered request.
    """
    if len(parts) == 1:
        return parts[0]
    kind = type(parts[0])
    answered = [part for part in parts if part.resident or part.hits or part.misses] or parts
    fields: dict[str, Any] = {}
    for name, rule in question_of(kind).columns.items():
        columns = [getattr(part, name) for part in parts]
        fields[name] = _joined_starts(columns) if rule.rows is Rows.STARTS else np.concatenate(columns)
    return kind(
        **fields,
        engine_seconds=sum(part.engine_seconds for part in parts),
        hits=sum(part.hits for part in parts),
        misses=sum(part.misses for part in parts),
        resident=answered[-1].resident,
        resident_bytes=answered[-1].resident_bytes,
        faults=tuple(dict.fromkeys(fault for part in parts for fault in part.faults)),
        wait_seconds=sum(part.wait_seconds for part in parts),
        late=tuple(dict.fromkeys(key for part in parts for key in part.late)),
        stopped=next((part.stopped for part in parts if part.stopped), ""),
    )


def in_pieces(answers: _A, most_bytes: int) -> Iterator[_A]:
    """Split answers into pieces of one item, or of at most `most_bytes` of listed rows.

    `join` undoes the split. The first piece carries the cost of the request. Answers that list no
    rows are one piece.
    """
    kind: type[_A] = type(answers)
    question = question_of(kind)
    if Rows.STARTS not in question.with_rows:
        yield answers
        return
    k, fields = _items(answers), array_fields(kind)
    ends = np.zeros(k + 1, np.int64)
    for name, rule in question.columns.items():
        if rule.of:
            ends += getattr(answers, rule.of) * fields[name].row_bytes
    rest = asdict(answers)
    start = 0
    while start < max(1, k):
        stop = int(np.searchsorted(ends, ends[start] + most_bytes, side="right")) - 1
        stop = min(max(stop, start + 1), k)
        piece: dict[str, Any] = {}
        for name, rule in question.columns.items():
            column = getattr(answers, name)
            if rule.of:
                rows = getattr(answers, rule.of)
                piece[name] = column[rows[start] : rows[stop]]
            elif rule.rows is Rows.STARTS:
                piece[name] = column[start : stop + 1] - column[start]
            else:
                piece[name] = column[start:stop]
        yield kind(**(rest | piece))
        rest |= {"engine_seconds": 0.0, "wait_seconds": 0.0, "hits": 0, "misses": 0}
        start = max(stop, 1)


def as_part(answers: Cost, first: int, total: int) -> Any:
    """Return answers as the part [first, first + n) of `total` along a path."""
    return question_of(type(answers)).part(**asdict(answers), first=first, total=total)


def without_part(part: Any) -> Any:
    """Return the answers of a part as an instance of their own type, without `first` and `total`."""
    fields = asdict(part)
    del fields["first"], fields["total"]
    return question_of(type(part)).answers(**fields)


def check_answers(answers: _A, k: int) -> _A:
    """Return the answers if they are valid answers to k poses; raise InternalError otherwise."""
    kind = type(answers)
    for name, verdict, rule in _checks(kind):
        column = getattr(answers, name)
        expected = k if rule is None else _expected_rows(answers, rule, k)
        if len(column) != expected:
            raise InternalError(
                f"{kind.__name__}: {len(column)} values in {name!r}, expected {expected}, for {k} requested"
            )
        if verdict and expected and max(column.tobytes()) > _LAST_VERDICT:
            raise InternalError(
                f"{kind.__name__}: verdict {column.max()}, expected at most {_LAST_VERDICT}: upgrade the client"
            )
        if rule is None:
            continue
        if rule.rows is Rows.STARTS and (column[0] != 0 or (np.diff(column) < 0).any()):
            raise InternalError(f"{kind.__name__}: {name!r} does not rise from 0")
        if rule.rows is Rows.PAIRS and column.ndim == 2 and not ((column >= 0) & (column < k)).all():
            raise InternalError(f"{kind.__name__}: pairs with objects that were not requested, of {k}")
    return answers


@cache
def _checks(kind: type) -> tuple[tuple[str, bool, ColumnRules | None], ...]:
    """Return each column's name, whether it has verdicts, and its rules; None for one row per item."""
    rules = question_of(kind).columns
    return tuple(
        (name, name.endswith("verdict"), None if rules[name].rows is Rows.ITEMS else rules[name])
        for name in array_fields(kind)
    )


def _expected_rows(answers: Cost, rule: ColumnRules, k: int) -> int:
    """Return how many rows a column of answers to k poses has, where they are not one per pose."""
    if rule.rows is Rows.STARTS:
        return k + 1
    if rule.rows is Rows.LISTED:
        starts = getattr(answers, rule.of)
        return int(starts[-1]) if len(starts) else 0
    first = len(getattr(answers, question_of(type(answers)).with_rows[rule.rows][0]))
    return first if rule.rows is Rows.PAIRS else k if first else 0


def _items(answers: Cost) -> int:
    """Return the number of items that answers are about."""
    return len(answers)  # type: ignore[arg-type]  # all answers have a length


def _joined_starts(columns: list[NDArray[np.int64]]) -> NDArray[np.int64]:
    """Join columns of starts, each rising from 0, into one."""
    total, joined = 0, [np.zeros(1, np.int64)]
    for column in columns:
        joined.append(column[1:] + total)
        total += int(column[-1])
    return np.concatenate(joined)
