"""What is said on the wire: requests and answers as types, and their JSON Schemas.

WIRE.md is this file, requests.py, answers.py, moves.py, stats.py and encoding.py in prose. No zenoh here.
"""

import inspect
from typing import Annotated, Any

import msgspec
import numpy as np

from .answers import (
    CollideAnswers,
    CollidePart,
    ContactsAnswers,
    ContactsPart,
    DistanceAnswers,
    DistancePart,
    ObjectsAnswers,
    RaycastAnswers,
    SweepAnswers,
    SweepPart,
    WithinAnswers,
)
from .arrays import ArrayType, Poses, Positions, array_fields
from .columns import check_answers
from .encoding import (
    JSON,
    MAX_MESSAGE_BYTES,
    MSGPACK,
    decode_answer,
    decode_request,
    encode,
    wire_encoding,
)
from .errors import ErrorCode
from .moves import Moved, MoveRequest, State, Wish
from .requests import (
    MAX_AVATAR_POINTS,
    MAX_POSES,
    AddAvatarRequest,
    CollideRequest,
    ContactsRequest,
    DistanceRequest,
    ObjectsRequest,
    PathRequest,
    RaycastRequest,
    Request,
    SweepRequest,
    WithinRequest,
    make_poses,
    make_positions,
)
from .stats import StatsAnswer, StatsRequest, UserStats

# What a reader of messages needs, wherever it is defined.
__all__ = [
    "JSON",
    "MAX_AVATAR_POINTS",
    "MAX_MESSAGE_BYTES",
    "MAX_POSES",
    "MESSAGES",
    "MSGPACK",
    "WIRE_VERSION",
    "AddAvatarRequest",
    "AvatarInfo",
    "CollideRequest",
    "ContactsRequest",
    "DistanceRequest",
    "ErrorReply",
    "MoveRequest",
    "Moved",
    "ObjectInfo",
    "ObjectsRequest",
    "PathRequest",
    "Poses",
    "Positions",
    "RaycastRequest",
    "ReloadAnswer",
    "SceneInfo",
    "ScenesAnswer",
    "SourceInfo",
    "SpawnInfo",
    "State",
    "StatsAnswer",
    "StatsRequest",
    "SweepRequest",
    "UserStats",
    "Wish",
    "WithinRequest",
    "check_answers",
    "decode_answer",
    "decode_request",
    "encode",
    "json_schemas",
    "make_poses",
    "make_positions",
    "wire_encoding",
]

WIRE_VERSION = 1


class ScenesAnswer(msgspec.Struct, frozen=True):
    """What one server serves."""

    scenes: list[str]
    wire_version: int = WIRE_VERSION
    format_version: int = 0


class AvatarInfo(msgspec.Struct, frozen=True):
    """An avatar as the server holds it.

    points: how many.  radius: of every point [m].  bounding_radius: of a sphere around the avatar's points
    and their radii [m].  Both null in what a `Client` returns while no server has answered yet.
    """

    name: str
    points: int
    radius: float | None = None
    bounding_radius: float | None = None


class SourceInfo(msgspec.Struct, frozen=True):
    """One scan that was built into the archive.

    index: which scan inside the file.  sha256: of the file, hexadecimal.  count: points taken.
    pose: 4x4 row-major, scan to world.  skipped: points left out, by reason.  fault: why none of it is in the archive
    (any more), or "".
    """

    path: str
    index: int
    sha256: str
    count: int
    format: str
    pose: list[list[float]]
    skipped: dict[str, int]
    fault: str = ""


class SpawnInfo(msgspec.Struct, frozen=True):
    """Where users of a scene begin. position: of the avatar's origin, world [m].  heading: about `up` [degrees]."""

    position: tuple[float, float, float]
    heading: float = 0.0


class ObjectInfo(msgspec.Struct, frozen=True):
    """A dynamic object of a scene. avatar: its shape, of the scene's avatars.  pose: 4x4 row-major, where it begins.

    kind: `kinematic`: where it is told to be; `pushed`: users push it. A reader takes others for kinematic.
    """

    name: str
    avatar: str
    pose: list[list[float]]
    kind: str = "kinematic"


class SceneInfo(msgspec.Struct, frozen=True):
    """What a scene is: counts, bounds, lattice, radius, and what went into it.

    bounds: [[x, y, z] low, [x, y, z] high], world [m].  origin: of the lattice, world [m].
    lattice_step, voxel_size, radius, radius_error (standard error of `radius`) [m].
    lattice_source: "sources", "given" or "default".  moved_max: farthest a point moved onto the lattice [m].
    radius_sample: points the mean closest-point distance was taken of.  degree, leaf: of the hierarchies.
    skipped: scans left out with `--skip-bad`.  record_bytes: of all records on disk.
    resident_bytes: of the whole archive, decoded.  effects: what its frames simulate; what is not there is not.
    unknown: boxes like `bounds` of scans left out, where nothing is called clear; unknown_everywhere: of one of
    them not even the bounds are known.  radius_models: stored, so that a question may ask for them.
    generation: how often scans were added or removed since the build.  radius_now: what `radius` would be, were it
    measured of the points of this generation; radius_now_error: its standard error [m]; null: not known.
    avatars: the scene's own, which every client may ask about by their names.  up: unit vector against gravity.
    spawn: where users begin; null: where they say.  objects: that move, and where they begin.  default_radius_model:
    what a question that names none is asked under; null: `radius`.
    """

    scene: str
    format_version: int
    wire_version: int
    points: int
    voxels: int
    bounds: list[list[float]]
    origin: list[float]
    lattice_step: float
    lattice_source: str
    voxel_size: float
    radius: float
    radius_model: str
    radius_error: float
    radius_sample: int
    moved_max: float
    degree: int
    leaf: int
    sources: list[SourceInfo]
    skipped: list[str]
    record_bytes: int
    resident_bytes: int
    effects: list[str] = []
    unknown: list[list[list[float]]] = []
    unknown_everywhere: bool = False
    radius_models: list[str] = []
    generation: int = 0
    radius_now: float | None = None
    radius_now_error: float | None = None
    avatars: list[AvatarInfo] = []
    up: tuple[float, float, float] = (0.0, 0.0, 1.0)
    spawn: SpawnInfo | None = None
    objects: list[ObjectInfo] = []
    default_radius_model: str | None = None


class ReloadAnswer(msgspec.Struct, frozen=True):
    """What a scene serves since it was reloaded.

    generation_before, generation_after: of the archive, the same where nothing was added or removed meanwhile.
    points: in it now.  seconds: from the request until it was swapped in.
    """

    scene: str
    generation_before: int
    generation_after: int
    points: int
    seconds: float = 0.0


class ErrorReply(msgspec.Struct, frozen=True):
    """Why a request was not answered. A code this reader does not know is an `internal` error to it."""

    code: Annotated[str, msgspec.Meta(extra_json_schema={"enum": [str(code) for code in ErrorCode]})]
    message: str


MESSAGES: tuple[type, ...] = (
    ScenesAnswer,
    SceneInfo,
    AddAvatarRequest,
    AvatarInfo,
    CollideRequest,
    CollideAnswers,
    DistanceRequest,
    DistanceAnswers,
    ContactsRequest,
    ContactsAnswers,
    SweepRequest,
    SweepAnswers,
    RaycastRequest,
    RaycastAnswers,
    WithinRequest,
    WithinAnswers,
    ObjectsRequest,
    ObjectsAnswers,
    PathRequest,
    CollidePart,
    DistancePart,
    ContactsPart,
    SweepPart,
    MoveRequest,
    Moved,
    Wish,
    State,
    ReloadAnswer,
    StatsRequest,
    StatsAnswer,
    ErrorReply,
)


def json_schemas() -> dict[str, str]:
    """The JSON Schema of every message, by the name of its type: what `schemas/json/` holds."""
    texts = {}
    for kind in MESSAGES:
        components = msgspec.json.schema(kind, schema_hook=lambda _: {"type": "array"})
        for definition in components["$defs"].values():
            # Python 3.13 strips a docstring's indentation, earlier ones do not: the same text from all.
            definition["description"] = inspect.cleandoc(definition["description"])
        properties = components["$defs"][kind.__name__]["properties"]
        for name, of in array_fields(kind).items():
            default: dict[str, Any] = {"default": []} if "default" in properties[name] else {}
            properties[name] = _array_schema(of, nullable=not issubclass(kind, Request)) | default
        text = msgspec.json.format(msgspec.json.encode(components, order="sorted"), indent=2)
        texts[kind.__name__] = text.decode() + "\n"
    return texts


def _array_schema(of: ArrayType, nullable: bool) -> dict[str, Any]:
    """The JSON Schema of an array: nested lists, and how many bytes a row has in MessagePack."""
    dtype, tail, row_bytes = of
    schema: dict[str, Any] = {
        "type": {"f": "number", "u": "integer", "i": "integer", "b": "boolean"}[dtype.kind]
    }
    if dtype.kind == "f" and nullable:
        schema["type"] = ["number", "null"]
    if dtype.kind in "ui":
        schema |= {"minimum": int(np.iinfo(dtype).min), "maximum": int(np.iinfo(dtype).max)}
    for length in reversed(tail):
        schema = {"type": "array", "items": schema, "minItems": length, "maxItems": length}
    note = f"{dtype.name}; in MessagePack a bin, {row_bytes} bytes an item"
    return {"type": "array", "items": schema, "description": note}
