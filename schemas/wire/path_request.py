"""The request that asks one question along a path, and the check of its parameters."""

from typing import Annotated, Any, Literal

import msgspec

from ..errors import BadRequestError
from .arrays import Poses
from .questions import path_questions
from .requests import MAX_CONTACTS, Count, Duration, Length, ModelName, Name, QuestionRequest, Request

PathOperation = Literal["collide", "distance", "contacts", "sweep"]


class PathRequest(Request, frozen=True):
    """Run one query along a path; the answers arrive in parts.

    avatar: the name under which it was added.  poses: (k, 4, 4) float64, at most 100,000.
    op: "collide", "distance", "contacts" or "sweep"; a sweep has k - 1 motions, each from one pose
    to the next.
    The other parameters are null where `op` does not take them, or for their default. "distance"
    requires `reach`. `budget_ms` is for the whole path.
    """

    avatar: Name
    poses: Poses
    op: PathOperation = "collide"
    margin: Length | None = None
    reach: Length | None = None
    limit: Annotated[int, msgspec.Meta(ge=0, le=MAX_CONTACTS)] | None = None
    cluster_distance: Length | None = None
    tolerance: Length | None = None
    budget_ms: Duration | None = None
    budget_visits: Count | None = None
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
    taken = (*own.parameters, *QuestionRequest.__struct_fields__)
    for name in parameters:
        if name not in taken:
            raise BadRequestError(
                f"{name} is not a parameter of {op} along a path: it takes {', '.join(taken)}"
            )
    for name in own.required:
        if name in own.parameters and parameters.get(name) is None:
            raise BadRequestError(f"{op} along a path needs {name}: see {own.request.__name__} in WIRE.md")
