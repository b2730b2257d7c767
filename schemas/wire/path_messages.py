"""Messages of a path: the request of one query along it, and the parts of its answers."""

from collections.abc import Iterator
from typing import Annotated, Any, Literal, TypeVar

import msgspec
import numpy as np
from msgspec.structs import asdict

from ..errors import BadRequestError
from .answers import Cost
from .arrays import Poses, array_fields
from .question_rules import Rows, suggestion_for
from .question_table import path_questions, question_of
from .request_limits import MAX_CONTACTS
from .requests import Duration, Length, ModelName, Name, Request, Share

_A = TypeVar("_A", bound=Cost)

PathOperation = Literal["collide", "distance", "contacts", "sweep"]


class PathRequest(Request, frozen=True):
    """Run one query along a path; the answers arrive in parts.

    avatar: the name under which it was added.  poses: (k, 4, 4) float64, at most 100,000.
    op: "collide", "distance", "contacts" or "sweep"; a sweep has k - 1 motions, each from one pose
    to the next.
    The other parameters are null if `op` does not take them, or for their default. `budget_ms`
    limits the whole path.
    """

    avatar: Name
    poses: Poses
    op: PathOperation = "collide"
    margin: Length | None = None
    reach: Length | None = None
    limit: Annotated[int, msgspec.Meta(ge=0, le=MAX_CONTACTS)] | None = None
    cluster_distance: Length | None = None
    tolerance: Length | None = None
    relative_tolerance: Share | None = None
    budget_ms: Duration | None = None
    radius_model: ModelName | None = None

    def __post_init__(self) -> None:
        Request.__post_init__(self)
        self.parameters()

    def parameters(self) -> dict[str, Any]:
        """Return the parameters given for `op`.

        Raises BadRequestError for a parameter that `op` does not take, or for a missing one.
        """
        names = [name for name in self.__struct_fields__ if name not in ("avatar", "poses", "op")]
        given = {name: value for name in names if (value := getattr(self, name)) is not None}
        check_path_parameters(self.op, given)
        return given


def check_path_parameters(op: str, parameters: dict[str, Any]) -> None:
    """Check that `op` takes these parameters along a path and has all that it requires.

    Raises BadRequestError otherwise.
    """
    questions = path_questions()
    if op not in questions:
        raise BadRequestError(f"op {op!r} along a path: expected one of {', '.join(questions)}")
    own = questions[op]
    taken = (*own.parameters, *sorted(own.options))
    for name in parameters:
        if name not in taken:
            raise BadRequestError(
                f"{name} is not a parameter of {op} along a path: {suggestion_for(name, taken)}it takes "
                f"{', '.join(taken)}"
            )
    for name in own.required:
        if name in own.parameters and parameters.get(name) is None:
            raise BadRequestError(f"{op} along a path needs {name}: see {own.request.__name__} in WIRE.md")


def split_answers(answers: _A, most_bytes: int) -> Iterator[_A]:
    """Split answers into pieces of one item, or of at most `most_bytes` of listed rows.

    `join_answers` undoes the split. The first piece carries the cost of the request. Answers that
    list no rows are one piece.
    """
    kind: type[_A] = type(answers)
    question = question_of(kind)
    if Rows.STARTS not in question.with_rows:
        yield answers
        return
    k: int = len(answers)  # type: ignore[arg-type]  # all answers have a length
    fields = array_fields(kind)
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


def answers_to_part(answers: Cost, first: int, total: int) -> Any:
    """Return answers as the part [first, first + n) of `total` along a path."""
    return question_of(type(answers)).part(**asdict(answers), first=first, total=total)


def part_to_answers(part: Any) -> Any:
    """Return a part as an instance of its question's answer type, without `first` and `total`."""
    fields = asdict(part)
    del fields["first"], fields["total"]
    return question_of(type(part)).answers(**fields)
