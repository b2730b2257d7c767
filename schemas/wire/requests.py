"""Request types, which check their fields when they are constructed.

A client therefore fails before it sends a request that a server would refuse.
"""

import math
import operator
from collections.abc import Sequence
from functools import cache
from typing import Annotated, Any, TypedDict, get_type_hints

import msgspec
import numpy as np

from ..archive.pose_arrays import float64_array, one_pose
from ..archive.radius_model import parse_radius_model
from ..errors import BadRequestError, TooLargeError
from .arrays import Poses, Positions
from .request_limits import MAX_AVATAR_POINTS, MAX_CONTACTS, MAX_NAME_LENGTH, MAX_OBJECTS

ALL_GROUPS = 0xFFFFFFFF

Name = Annotated[str, msgspec.Meta(min_length=1, max_length=MAX_NAME_LENGTH)]
Length = Annotated[float, msgspec.Meta(ge=0)]
Share = Annotated[float, msgspec.Meta(ge=0, description="1 is the whole")]
Duration = Annotated[float, msgspec.Meta(ge=0, description="milliseconds")]
Count = Annotated[int, msgspec.Meta(ge=0, le=1 << 62)]
Bits = Annotated[int, msgspec.Meta(ge=0, le=ALL_GROUPS)]
ModelName = Annotated[str, msgspec.Meta(min_length=1, max_length=MAX_NAME_LENGTH)]

# Default of DistanceRequest's `reach` [m]. A constant, and not derived from the scene, so that
# answers do not depend on what is in memory.
DEFAULT_REACH = 1.0


class Request(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Base class of requests.

    Unknown fields are refused, because an ignored field could have changed the answer.
    """

    def __post_init__(self) -> None:
        for name, check in _checks(type(self)):
            value = getattr(self, name)
            if value is not None:
                check(name, value)


class AddAvatarRequest(Request, frozen=True):
    """Add an avatar for this client.

    name: 1 to 64 characters.  points: (n, 3) float64, n >= 1, in the avatar's frame [m].
    radius: of every point [m], finite and >= 0; null: half the mean closest-point distance of
    `points`.
    inner_points: number of points, the last ones, that fill the inside of a mesh, less than n.
    They count for every answer, but are not part of the avatar's surface, from which contact
    normals are estimated.
    """

    name: Name
    points: Positions
    radius: Length | None = None
    inner_points: Count = 0

    def __post_init__(self) -> None:
        Request.__post_init__(self)
        if not len(self.points):
            raise BadRequestError(
                f"avatar {self.name!r} has no points: expected at least one, because an avatar without points touches "
                "nothing: check where its points come from"
            )
        if self.inner_points >= len(self.points):
            raise BadRequestError(
                f"avatar {self.name!r}: {self.inner_points} inner points of {len(self.points)}: expected fewer than "
                "all, because the first ones are its surface"
            )


class QuestionRequest(Request, frozen=True, kw_only=True):
    """Parameters that every query takes.

    budget_ms: time for loading and computing together [ms]; null: no limit.
    radius_model: sizes of the scan's spheres: mean, local, border or local+border, each with an
    optional factor as in local:0.8, or fixed:METRES; null: the scene's default.
    """

    budget_ms: Duration | None = None
    radius_model: ModelName | None = None

    def arguments(self) -> tuple[Any, ...]:
        """Return the fields that are arguments, in the order of the query's method."""
        return tuple([getattr(self, name) for name in self.__struct_fields__ if name not in OPTIONS])

    def options(self) -> dict[str, Any]:
        """Return the fields that are in `OPTIONS`, by name."""
        return {name: getattr(self, name) for name in self.__struct_fields__ if name in OPTIONS}


class TolerantRequest(QuestionRequest, frozen=True, kw_only=True):
    """Parameters of a query that takes a tolerance.

    tolerance: separation up to which contact may be reported, and allowed distance between bounds
    [m]; 0: exact.
    """

    tolerance: Length = 0.0


# Fields that are options of the query methods, and not arguments: of each request those that it has.
OPTIONS = ("relative_tolerance", *TolerantRequest.__struct_fields__)


class QuestionOptions(TypedDict, total=False):
    """Fields of `QuestionRequest` as keyword arguments, for this module and every query method."""

    budget_ms: float | None
    radius_model: str | None


class CollideRequest(TolerantRequest, frozen=True):
    """Test, for each pose, if an avatar touches the scene.

    avatar: the name under which it was added.
    poses: (k, 4, 4) float64, avatar to world, row-major, metres.
    margin: distance below which two spheres count as in contact [m], finite and >= 0.
    """

    avatar: Name
    poses: Poses
    margin: Length = 0.0


class DistanceRequest(TolerantRequest, frozen=True):
    """Measure, for each pose, the distance from an avatar to the scene, and its nearest points.

    avatar, poses: as in CollideRequest.
    reach: farthest distance worth reporting [m], finite and >= 0.
    relative_tolerance: allowed distance between the bounds of a distance, as a share of the distance
    between the centres; if it is above 0, a millimetre is allowed at any distance.
    """

    avatar: Name
    poses: Poses
    reach: Length = DEFAULT_REACH
    relative_tolerance: Share = 0.0


class ContactsRequest(TolerantRequest, frozen=True):
    """List, for each pose, the pairs of points in contact.

    avatar, poses, margin: as in CollideRequest.
    limit: maximum number of pairs listed per pose, deepest first; at most 10,000.
    cluster_distance: scan points at most this far apart belong to one cluster [m]; null: the
    server's default.
    """

    avatar: Name
    poses: Poses
    limit: Annotated[int, msgspec.Meta(ge=0, le=MAX_CONTACTS)] = 100
    margin: Length = 0.0
    cluster_distance: Length | None = None


class SweepRequest(TolerantRequest, frozen=True, kw_only=True):
    """Find, for each motion between two poses, the first contact of an avatar with the scene.

    avatar, margin: as in CollideRequest.
    pose_from, pose_to: (k, 4, 4) float64, avatar to world, equally many.
    tolerance: how far a point of the avatar may move within the reported interval [m].
    """

    avatar: Name
    pose_from: Poses
    pose_to: Poses
    margin: Length = 0.0
    tolerance: Length = 1e-6

    def __post_init__(self) -> None:
        Request.__post_init__(self)
        _same_length(self, "pose_from", "pose_to")


class RaycastRequest(QuestionRequest, frozen=True):
    """Find, for each ray, the first scan point whose sphere it hits.

    origins, directions: (k, 3) float64, world [m], equally many; a direction may have any length
    but 0.
    reach: length of the rays [m], finite and >= 0.
    """

    origins: Positions
    directions: Positions
    reach: Length

    def __post_init__(self) -> None:
        Request.__post_init__(self)
        _same_length(self, "origins", "directions")


class WithinRequest(QuestionRequest, frozen=True):
    """Find, for each given point, the nearest scan point.

    points: (k, 3) float64, world [m].
    reach: farthest distance worth reporting [m], finite and >= 0.
    """

    points: Positions
    reach: Length


class ObjectEntry(Request, frozen=True):
    """One avatar among several in an ObjectsRequest.

    avatar: the name under which it was added.
    group: bits of the groups to which it belongs.  mask: bits of the groups with which it collides.
    """

    avatar: Name
    group: Bits = 1
    mask: Bits = ALL_GROUPS


class ObjectsRequest(QuestionRequest, frozen=True):
    """Test several avatars against the scene and against each other.

    objects: at most 2,048; an avatar may be named more than once.
    poses: (n, 4, 4) float64, one per object.  margin: as in CollideRequest.
    """

    objects: list[ObjectEntry]
    poses: Poses
    margin: Length = 0.0

    def __post_init__(self) -> None:
        Request.__post_init__(self)
        _same_length(self, "objects", "poses")
        _check_count(self.objects)

    def arguments(self) -> tuple[Any, ...]:
        """Return the arguments of the query's method, which takes each object with its pose."""
        items = zip(self.objects, self.poses, strict=True)
        return [(item.avatar, pose, item.group, item.mask) for item, pose in items], self.margin


def make_positions(points: Any, what: str = "points") -> Positions:
    """Convert an avatar's points to the wire's array type: (n, 3) float64, finite [m].

    Raises BadRequestError or TooLargeError.
    """
    array = make_vectors(points, what)
    if len(array) > MAX_AVATAR_POINTS:
        raise TooLargeError(f"avatar of {len(array)} points: at most {MAX_AVATAR_POINTS}: thin it out first")
    return array


def make_vectors(vectors: Any, what: str) -> Positions:
    """Convert vectors to the wire's array type: (n, 3) float64, finite.

    what: name of the vectors, for messages. Raises BadRequestError.
    """
    array = float64_array(vectors, what)
    if array.ndim != 2 or array.shape[1] != 3:
        raise BadRequestError(f"{what} of shape {array.shape}: expected (n, 3)")
    _refuse_infinite(what, array)
    return array  # type: ignore[return-value]


def check_one_pose(what: str, poses: Poses) -> None:
    """Raise BadRequestError unless there is exactly one pose, of finite numbers."""
    if poses.shape != (1, 4, 4):
        raise BadRequestError(f"{what} of shape {poses.shape}: expected one pose, (1, 4, 4), avatar to world")
    _refuse_infinite(what, poses)


def _refuse_infinite(what: str, array: np.ndarray) -> None:
    """Raise BadRequestError for what `check_finite` refuses: in this process, no decoder checks arrays."""
    try:
        check_finite(what, array)
    except ValueError as error:
        raise BadRequestError(str(error)) from None


def make_objects(objects: Sequence[Sequence[Any]]) -> tuple[list[ObjectEntry], Poses]:
    """Convert objects and their poses to the wire's types.

    objects: (name, pose, group = 1, mask = all groups), each pose (4, 4) or (1, 4, 4).
    Raises BadRequestError naming an invalid object, TooLargeError for more than `MAX_OBJECTS`.
    """
    _check_count(objects)
    items = []
    for number, entry in enumerate(objects):
        if not 2 <= len(entry) <= 4:
            raise BadRequestError(
                f"object {number} of {len(entry)} values: expected name, pose and optionally group and mask"
            )
        items.append(ObjectEntry(entry[0], *(_as_bits(number, value) for value in entry[2:])))
    poses = np.empty((len(items), 4, 4))
    for number, entry in enumerate(objects):
        poses[number] = one_pose(entry[1], f"pose of object {number}")
    return items, poses  # type: ignore[return-value]


def _check_count(objects: Sequence[Any]) -> None:
    """Raise TooLargeError for more than MAX_OBJECTS objects."""
    if len(objects) > MAX_OBJECTS:
        raise TooLargeError(f"{len(objects)} objects: at most {MAX_OBJECTS}: send several requests")


def _as_bits(number: int, value: Any) -> int:
    """Return a group or mask as an integer, or raise BadRequestError."""
    try:
        return operator.index(value)
    except TypeError:
        raise BadRequestError(f"object {number}: group or mask {value!r}: expected an integer") from None


def check_finite(name: str, array: np.ndarray) -> None:
    """Raise ValueError for NaN or infinity, for which no answer is defined (NUMERICS.md N7)."""
    # For one pose this takes a third of the time of `np.isfinite(array).all()`.
    if 0 in np.isfinite(array).tobytes():
        where = [int(i) for i in np.argwhere(~np.isfinite(array))[0]]
        raise ValueError(f"{name}{where} is {array[tuple(where)]}, expected finite numbers")


def check_avatar_name(name: Any) -> None:
    """Raise BadRequestError for an avatar name that is no string, empty or too long."""
    if not isinstance(name, str):
        raise BadRequestError(
            f"avatar named by a {type(name).__name__}: expected a string of 1 to {MAX_NAME_LENGTH} characters"
        )
    if not 1 <= len(name) <= MAX_NAME_LENGTH:
        raise BadRequestError(
            f"avatar {name[:64]!r} of {len(name)} characters: expected 1 to {MAX_NAME_LENGTH}"
        )


def _check_model(_: str, text: str) -> None:
    """Raise BadRequestError for an invalid radius model."""
    parse_radius_model(text)


def check_length(what: str, value: float) -> None:
    """Raise BadRequestError for a negative or non-finite length (NUMERICS.md N7, cases 14, 15)."""
    if not 0 <= value < math.inf:
        raise BadRequestError(f"{what} is {value}: expected a finite number of metres, 0 or more")


def check_duration(what: str, value: float) -> None:
    """Raise BadRequestError for a negative or non-finite duration."""
    if not 0 <= value < math.inf:
        raise BadRequestError(f"{what} is {value}: expected milliseconds, 0 or more")


def check_integer(what: str, value: int, most: int, least: int = 0) -> None:
    """Raise BadRequestError for anything but an integer from `least` to `most`."""
    try:
        fits = not isinstance(value, bool) and least <= operator.index(value) <= most
    except TypeError:
        fits = False
    if not fits:
        raise BadRequestError(f"{what} is {value}: expected an integer from {least} to {most}")


def _same_length(request: Request, first: str, second: str) -> None:
    """Raise BadRequestError unless two fields have equally many elements."""
    a, b = len(getattr(request, first)), len(getattr(request, second))
    if a != b:
        raise BadRequestError(f"{a} {first} and {b} {second}: expected equal numbers")


@cache
def _checks(kind: type[Request]) -> tuple[tuple[str, Any], ...]:
    """Return the checks of a request's fields, derived from their types.

    Arrays are checked where they are read.
    """
    found: list[tuple[str, Any]] = []
    for name, hint in get_type_hints(kind, include_extras=True).items():
        kinds = {hint, *getattr(hint, "__args__", ())}
        if Name in kinds:
            found.append((name, lambda _, value: check_avatar_name(value)))
        elif ModelName in kinds:
            found.append((name, _check_model))
        elif Length in kinds:
            found.append((name, check_length))
        elif Duration in kinds:
            found.append((name, check_duration))
        else:
            for one in kinds:
                for meta in getattr(one, "__metadata__", ()):
                    if getattr(meta, "le", None) is not None:
                        least, most = meta.ge or 0, meta.le
                        found.append(
                            (name, lambda what, value, a=least, b=most: check_integer(what, value, b, a))
                        )
    return tuple(found)
