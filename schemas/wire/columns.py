"""Operations on the columns of answers: fill with unknown, join, split into parts of a path, check."""

from collections.abc import Iterator, Sequence
from typing import Any, TypeVar

import numpy as np
from msgspec.structs import asdict
from numpy.typing import NDArray

from ..errors import InternalError
from .answers import (
    PARTS,
    CollideAnswers,
    ContactsAnswers,
    Cost,
    ObjectsAnswers,
    RaycastAnswers,
    SweepAnswers,
    Verdict,
    WithinAnswers,
)
from .arrays import array_fields

_LAST_VERDICT = int(max(Verdict))
_A = TypeVar("_A", bound=Cost)

_BOUNDS = frozenset(("lower", "upper", "exact"))
# Columns of ContactsAnswers with one row per pair, and with one row per cluster.
PAIR_COLUMNS = ("avatar_point", "cloud_point", "signed_distance", "avatar_index", "scan_index", "cluster")
CLUSTER_COLUMNS = (
    "cluster_count", "cluster_deepest", "cluster_avatar", "cluster_cloud", "cluster_scan", "cluster_low",
    "cluster_high",
)  # fmt: skip
# Columns that do not have one element per answer -> the column of starts that gives their row
# ranges.
_ROWS = {
    **dict.fromkeys(PAIR_COLUMNS, "pair_starts"),
    **dict.fromkeys(CLUSTER_COLUMNS, "cluster_starts"),
}
# Values that mean "nothing is known" for columns in which 0 does not. `unknown` itself sets
# `lower`: to 0 where it is a fraction or a length along a ray, else to -inf.
_UNKNOWN = {"verdict": float(Verdict.UNKNOWN), "upper": np.inf, "distance": np.inf, "signed_distance": np.inf}


def unknown(kind: type[_A], k: int, *, bounded: bool = True) -> _A:
    """Return answers of one type for k poses (rays, points, motions, objects), all `UNKNOWN`.

    They stand for a request that nobody answered.
    bounded: whether `CollideAnswers` state bounds, as they do if a tolerance or a budget was given.
    """
    columns: dict[str, Any] = {}
    for name, (dtype, tail, _) in array_fields(kind).items():
        rows = k
        if issubclass(kind, ContactsAnswers):
            rows = 0 if name in _ROWS else k + (name in _ROWS.values())
        elif issubclass(kind, CollideAnswers) and name in _BOUNDS and not bounded:
            rows = 0
        filling = np.nan if tail and dtype.kind == "f" else _UNKNOWN.get(name, 0)
        if name == "lower" and not issubclass(kind, SweepAnswers | RaycastAnswers | WithinAnswers):
            filling = -np.inf
        columns[name] = np.full((rows, *tail), filling, dtype)
    if issubclass(kind, ObjectsAnswers):
        columns["pairs"] = np.column_stack(np.triu_indices(k, 1)).astype(np.int32)
        columns["pair_verdict"] = np.full(len(columns["pairs"]), Verdict.UNKNOWN, np.uint8)
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
    for name in array_fields(kind):
        columns = [getattr(part, name) for part in parts]
        fields[name] = _joined_starts(columns) if name in _ROWS.values() else np.concatenate(columns)
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


def in_pieces(answers: ContactsAnswers, most_bytes: int) -> Iterator[ContactsAnswers]:
    """Split answers into pieces of one pose, or of at most `most_bytes` of pairs and clusters.

    `join` undoes the split. The first piece carries the cost of the request.
    """
    fields = array_fields(ContactsAnswers)
    ends = np.zeros(len(answers) + 1, np.int64)
    for name, starts in _ROWS.items():
        ends += getattr(answers, starts) * fields[name].row_bytes
    rest = asdict(answers)
    start = 0
    while start < max(1, len(answers)):
        stop = int(np.searchsorted(ends, ends[start] + most_bytes, side="right")) - 1
        stop = min(max(stop, start + 1), len(answers))
        piece: dict[str, Any] = {}
        for name in fields:
            column = getattr(answers, name)
            if name in _ROWS:
                rows = getattr(answers, _ROWS[name])
                piece[name] = column[rows[start] : rows[stop]]
            elif name in _ROWS.values():
                piece[name] = column[start : stop + 1] - column[start]
            else:
                piece[name] = column[start:stop]
        yield ContactsAnswers(**(rest | piece))
        rest |= {"engine_seconds": 0.0, "wait_seconds": 0.0, "hits": 0, "misses": 0}
        start = max(stop, 1)


def as_part(answers: Cost, first: int, total: int) -> Any:
    """Return answers as the part [first, first + n) of `total` along a path."""
    return PARTS[type(answers)](**asdict(answers), first=first, total=total)


def without_part(kind: type[_A], part: Any) -> _A:
    """Return the answers of a part as an instance of their own type, without `first` and `total`."""
    fields = asdict(part)
    del fields["first"], fields["total"]
    return kind(**fields)


def check_answers(answers: _A, k: int) -> _A:
    """Return the answers if they are valid answers to k poses; raise InternalError otherwise."""
    kind = type(answers)
    contacts = isinstance(answers, ContactsAnswers)
    unbounded = isinstance(answers, CollideAnswers) and len(answers.exact) == 0
    pairs = len(answers.pairs) if isinstance(answers, ObjectsAnswers) else 0
    for name in array_fields(kind):
        column = getattr(answers, name)
        expected = k
        if contacts and name in _ROWS.values():
            expected = k + 1
        elif contacts and name in _ROWS:
            expected = _last(getattr(answers, _ROWS[name]))
        elif name in ("pairs", "pair_verdict"):
            expected = pairs
        elif unbounded and name in _BOUNDS:
            expected = 0
        if len(column) != expected:
            raise InternalError(
                f"{kind.__name__}: {len(column)} values in {name!r}, expected {expected}, for {k} requested"
            )
        if name.endswith("verdict") and expected and max(column.tobytes()) > _LAST_VERDICT:
            raise InternalError(
                f"{kind.__name__}: verdict {column.max()}, expected at most {_LAST_VERDICT}: upgrade the client"
            )
        if contacts and name in _ROWS.values() and (column[0] != 0 or (np.diff(column) < 0).any()):
            raise InternalError(f"{kind.__name__}: {name!r} does not rise from 0")
    if pairs and not 0 <= int(answers.pairs.min()) <= int(answers.pairs.max()) < k:  # type: ignore[attr-defined]
        raise InternalError(f"{kind.__name__}: pairs with objects that were not requested, of {k}")
    return answers


def _last(starts: NDArray[np.int64]) -> int:
    """Return the total number of rows that a column of starts describes."""
    return int(starts[-1]) if len(starts) else 0


def _joined_starts(columns: list[NDArray[np.int64]]) -> NDArray[np.int64]:
    """Join columns of starts, each rising from 0, into one."""
    total, joined = 0, [np.zeros(1, np.int64)]
    for column in columns:
        joined.append(column[1:] + total)
        total += int(column[-1])
    return np.concatenate(joined)
