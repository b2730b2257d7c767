"""Arguments of the query methods as fields of requests."""

from collections.abc import Callable
from functools import cache
from itertools import pairwise
from typing import Any, get_type_hints

from ..errors import BadRequestError
from .arrays import Poses
from .questions import Question
from .requests import Length, QuestionRequest, make_objects, make_poses, make_vectors


def request_fields(
    question: Question[Any], arguments: tuple[Any, ...], named: dict[str, Any]
) -> dict[str, Any]:
    """Return the fields of a question's request for the arguments of its method, by name.

    arguments, named: as `Question.all_arguments` takes them. Arrays become what the wire has, with
    equally many elements each.
    Raises BadRequestError for an invalid argument, TypeError for one too many or too few.
    """
    fields = dict(zip(question.arguments, question.all_arguments(arguments, named), strict=True))
    if "objects" in fields:
        fields["objects"], fields["poses"] = make_objects(fields["objects"])
    for name, convert in _conversions(question.request):
        fields[name] = convert(fields[name], name)
    for first, second in pairwise(question.arrays):
        a, b = len(fields[first]), len(fields[second])
        if a != b:
            raise BadRequestError(f"{a} {first} and {b} {second}: expected as many of each")
    return fields


@cache
def _conversions(kind: type[QuestionRequest]) -> tuple[tuple[str, Callable[[Any, str], Any]], ...]:
    """Return how each argument becomes a field, by the field's type; others stay as they are."""
    found: list[tuple[str, Callable[[Any, str], Any]]] = []
    for name, hint in get_type_hints(kind, include_extras=True).items():
        if hint == Poses:
            found.append((name, make_poses))
        elif name in QuestionRequest.__struct_fields__:
            continue
        elif hint == Length:
            found.append((name, lambda value, _: float(value)))
        elif str(hint).startswith("numpy.ndarray"):
            found.append((name, make_vectors))
    return tuple(found)
