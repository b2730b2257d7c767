"""What is said on the wire: requests and answers as types, and their two encodings.

WIRE.md is this file in prose. No zenoh here. An array is a little-endian, C-ordered bin in MessagePack and
nested lists in JSON; its dtype and shape are those of the field's type, so neither travels.
"""

import math
from functools import cache
from typing import Annotated, Any, Literal, TypeVar, get_args, get_origin, get_type_hints

import msgspec
import numpy as np

from .answers import CollideAnswers, Verdict
from .errors import BadRequestError, ErrorCode, InternalError, TooLargeError

WIRE_VERSION = 1
MSGPACK = "application/msgpack"
JSON = "application/json"

# Caps of the protocol. They bound what one request can cost a server: 24 MB of points, 12.8 MB of poses,
# both under MAX_MESSAGE_BYTES. Raised, a server of version 1 would drop the larger messages unanswered.
MAX_AVATAR_POINTS = 1_000_000
MAX_POSES = 100_000
MAX_MESSAGE_BYTES = 32 << 20

# The shape is part of the type: an int is any length, a Literal is that length.
Poses = np.ndarray[tuple[int, Literal[4], Literal[4]], np.dtype[np.float64]]
Positions = np.ndarray[tuple[int, Literal[3]], np.dtype[np.float64]]

Name = Annotated[str, msgspec.Meta(min_length=1, max_length=64)]
_Length = Annotated[float, msgspec.Meta(ge=0)]
_M = TypeVar("_M")


class _Request(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A request refuses fields it does not know: one that was ignored could have changed the answer."""


class AddAvatarRequest(_Request, frozen=True):
    """Give this client an avatar.

    name: 1 to 64 characters.  points: (n, 3) float64, the avatar's frame [m].
    radius: of every point [m], finite and >= 0; null: half the mean closest-point distance of `points`.
    """

    name: Name
    points: Positions
    radius: _Length | None = None

    def __post_init__(self) -> None:
        _check_finite("radius", self.radius)


class CollideRequest(_Request, frozen=True):
    """Ask, for each pose, whether an avatar touches the scene.

    avatar: the name it was added under.  poses: (k, 4, 4) float64, avatar to world, row-major, metres.
    margin: distance below which two spheres are called in contact [m], finite and >= 0.
    """

    avatar: Name
    poses: Poses
    margin: _Length = 0.0

    def __post_init__(self) -> None:
        _check_finite("margin", self.margin)


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
    pose: 4x4 row-major, scan to world.  skipped: points left out, by reason.
    """

    path: str
    index: int
    sha256: str
    count: int
    format: str
    pose: list[list[float]]
    skipped: dict[str, int]


class SceneInfo(msgspec.Struct, frozen=True):
    """What a scene is: counts, bounds, lattice, radius, and what went into it.

    bounds: [[x, y, z] low, [x, y, z] high], world [m].  origin: of the lattice, world [m].
    lattice_step, voxel_size, radius, radius_error (standard error of `radius`) [m].
    lattice_source: "sources", "given" or "default".  moved_max: farthest a point moved onto the lattice [m].
    radius_sample: points the mean closest-point distance was taken of.  degree, leaf: of the hierarchies.
    skipped: scans left out with `--skip-bad`.  record_bytes: of all records on disk.
    resident_bytes: of the whole archive, decoded.  effects: names a request may use; none in version 1.
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
    ErrorReply,
)


def wire_encoding(stated: str | None) -> str:
    """The encoding that a message's stated one asks for: `MSGPACK` when none is stated, or `JSON`.

    zenoh states `zenoh/bytes` where the sender stated nothing. Anything else: BadRequestError.
    """
    name = (stated or "").split(";", 1)[0].strip().lower()
    if name in ("", "zenoh/bytes", MSGPACK):
        return MSGPACK
    if name == JSON:
        return JSON
    raise BadRequestError(f"request encoded as {stated!r}: expected {MSGPACK} or {JSON}")


def encode(message: Any, encoding: str = MSGPACK) -> bytes:
    """The bytes of one message. Arrays must already have the dtype of their field."""
    return (_JSON_ENCODER if encoding == JSON else _MSGPACK_ENCODER).encode(message)


def decode_request(kind: type[_M], payload: bytes, encoding: str = MSGPACK) -> _M:
    """A request from its bytes; BadRequestError says which field is wrong, what was found and expected."""
    try:
        return _decoder(kind, encoding).decode(payload)  # type: ignore[no-any-return]
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise BadRequestError(f"{kind.__name__}: {error}: see WIRE.md for its fields") from None


def decode_answer(kind: type[_M], payload: bytes, encoding: str = MSGPACK) -> _M:
    """An answer from its bytes; unknown fields are left out. InternalError: not what WIRE.md says."""
    try:
        return _decoder(kind, encoding).decode(payload)  # type: ignore[no-any-return]
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise InternalError(f"{kind.__name__}: {error}: client and server may be of other versions") from None


def check_answers(answers: CollideAnswers, k: int) -> CollideAnswers:
    """The same answers, if they are the answers to k poses; InternalError if not, never a guess."""
    columns = ("verdict", "outside", "voxels_missing", "node_visits", "point_tests")
    for name in columns:
        if len(getattr(answers, name)) != k:
            raise InternalError(
                f"CollideAnswers: {len(getattr(answers, name))} values in {name!r}, expected {k}, one a pose"
            )
    if k and int(answers.verdict.max()) > max(Verdict):
        raise InternalError(
            f"CollideAnswers: verdict {int(answers.verdict.max())}, expected 0 to {int(max(Verdict))}: "
            "upgrade the client"
        )
    return answers


def make_positions(points: Any) -> Positions:
    """An avatar's points as the wire has them: (n, 3) float64, finite [m]. BadRequestError, TooLargeError."""
    array = _as_float64("points", points)
    if array.ndim != 2 or array.shape[1] != 3:
        raise BadRequestError(f"points of shape {array.shape}: expected (n, 3)")
    if len(array) > MAX_AVATAR_POINTS:
        raise TooLargeError(f"avatar of {len(array)} points: at most {MAX_AVATAR_POINTS}: thin it out first")
    try:
        return _admit("points", array)  # type: ignore[return-value]
    except ValueError as error:
        raise BadRequestError(str(error)) from None


def make_poses(poses: Any) -> Poses:
    """Poses as the wire has them: (k, 4, 4) float64. Only the shape is checked: the server judges them."""
    array = _as_float64("poses", poses)
    if array.ndim != 3 or array.shape[1:] != (4, 4):
        raise BadRequestError(f"poses of shape {array.shape}: expected (k, 4, 4), avatar to world")
    return array  # type: ignore[return-value]


def json_schemas() -> dict[str, str]:
    """The JSON Schema of every message, by the name of its type: what `schemas/json/` holds."""
    texts = {}
    for kind in MESSAGES:
        components = msgspec.json.schema(kind, schema_hook=lambda _: {"type": "array"})
        properties = components["$defs"][kind.__name__]["properties"]
        for name, hint in get_type_hints(kind).items():
            if get_origin(hint) is np.ndarray:
                properties[name].update(_array_schema(hint))
        text = msgspec.json.format(msgspec.json.encode(components, order="sorted"), indent=2)
        texts[kind.__name__] = text.decode() + "\n"
    return texts


def _check_finite(name: str, value: float | None) -> None:
    """ValueError for a number no answer exists for (NUMERICS.md N7); the range is checked by the type."""
    if value is not None and not math.isfinite(value):
        raise ValueError(f"{name} is {value}: expected a finite number")


def _admit(name: str, array: np.ndarray) -> np.ndarray:
    """The array, if every number in it is finite; ValueError if not (NUMERICS.md N7)."""
    finite = np.isfinite(array)
    if not finite.all():
        where = [int(i) for i in np.argwhere(~finite)[0]]
        raise ValueError(f"{name}{where} is {array[tuple(where)]}, expected finite numbers")
    return array


def _as_float64(name: str, values: Any) -> np.ndarray:
    """Numbers as a C-ordered little-endian float64 array; BadRequestError for what is not numbers."""
    try:
        return np.ascontiguousarray(values, "<f8")
    except (TypeError, ValueError) as error:
        raise BadRequestError(f"{name}: {error}: expected an array of numbers") from None


@cache
def _array_type(hint: Any) -> tuple[np.dtype, tuple[int, ...]]:
    """The dtype, little-endian, and the lengths of all axes but the first, of an array's type."""
    shape, dtype = get_args(hint)
    tail = tuple(get_args(axis)[0] for axis in get_args(shape)[1:] if get_origin(axis) is Literal)
    return np.dtype(get_args(dtype)[0]).newbyteorder("<"), tail


def _array_from_bin(hint: Any, value: Any) -> np.ndarray:
    """An array from the bin it is in MessagePack; ValueError says what is wrong with it."""
    if not isinstance(value, bytes):
        raise ValueError(f"expected the array's bytes as bin, found {type(value).__name__}")
    dtype, tail = _array_type(hint)
    row_bytes = dtype.itemsize * math.prod(tail)
    if len(value) % row_bytes:
        raise ValueError(f"{len(value)} bytes, expected a multiple of {row_bytes}")
    if dtype.kind == "b":
        return np.frombuffer(value, np.uint8) != 0
    # Copied, because a view of bytes is read-only, and numba compiles another kernel for a read-only array.
    return _admit("number", np.frombuffer(value, dtype).reshape(-1, *tail).copy())


def _array_from_lists(hint: Any, value: Any) -> np.ndarray:
    """An array from the nested lists it is in JSON; ValueError says what is wrong with it."""
    if not isinstance(value, list):
        raise ValueError(f"expected nested lists of numbers, found {type(value).__name__}")
    dtype, tail = _array_type(hint)
    if not value:
        return np.zeros((0, *tail), dtype)
    try:
        found = np.array(value)  # ValueError where the lists are ragged
    except OverflowError as error:
        raise ValueError(str(error)) from None
    if found.dtype.kind not in {"f": "iuf", "u": "iu", "b": "b"}[dtype.kind]:
        raise ValueError(f"expected nested lists of {dtype.name}, found something else among them")
    if found.ndim != 1 + len(tail) or found.shape[1:] != tail:
        expected = ", ".join(["n", *map(str, tail)])
        raise ValueError(f"lists of shape {found.shape}, expected ({expected})")
    if dtype.kind == "u" and (found.min() < 0 or found.max() > np.iinfo(dtype).max):
        raise ValueError(f"integers from {found.min()} to {found.max()} do not fit {dtype.name}")
    return _admit("number", found.astype(dtype))


def _array_schema(hint: Any) -> dict[str, Any]:
    """The JSON Schema of an array: nested lists, and how many bytes a row has in MessagePack."""
    dtype, tail = _array_type(hint)
    schema: dict[str, Any] = {"type": {"f": "number", "u": "integer", "b": "boolean"}[dtype.kind]}
    if dtype.kind == "u":
        schema |= {"minimum": 0, "maximum": int(np.iinfo(dtype).max)}
    for length in reversed(tail):
        schema = {"type": "array", "items": schema, "minItems": length, "maxItems": length}
    note = f"{dtype.name}; in MessagePack a bin, {dtype.itemsize * math.prod(tail)} bytes an item"
    return {"type": "array", "items": schema, "description": note}


def _array_to_bin(value: Any) -> memoryview:
    """The bytes of an array, for MessagePack."""
    if not isinstance(value, np.ndarray):
        raise NotImplementedError(f"a message cannot hold {type(value).__name__}")
    return np.ascontiguousarray(value, value.dtype.newbyteorder("<")).data


def _array_to_lists(value: Any) -> list:
    """The nested lists of an array, for JSON."""
    if not isinstance(value, np.ndarray):
        raise NotImplementedError(f"a message cannot hold {type(value).__name__}")
    return value.tolist()


# Encoders and decoders are made once: making one costs more than a whole message does.
_MSGPACK_ENCODER = msgspec.msgpack.Encoder(enc_hook=_array_to_bin)
_JSON_ENCODER = msgspec.json.Encoder(enc_hook=_array_to_lists)


@cache
def _decoder(kind: type, encoding: str) -> Any:
    """The decoder of one type in one encoding."""
    if encoding == JSON:
        return msgspec.json.Decoder(kind, dec_hook=_array_from_lists)
    return msgspec.msgpack.Decoder(kind, dec_hook=_array_from_bin)
