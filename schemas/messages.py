"""What is said on the wire: requests and answers as types, and their two encodings.

WIRE.md is this file in prose. No zenoh here. An array is a little-endian, C-ordered bin in MessagePack and
nested lists in JSON; its dtype and shape are those of the field's type, so neither travels.
"""

import inspect
import math
import sys
from functools import cache
from typing import Annotated, Any, Literal, NamedTuple, TypeVar, get_args, get_origin, get_type_hints

import msgspec
import numpy as np
from msgspec.structs import force_setattr

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
_FLOAT64 = np.dtype("<f8")
_LAST_VERDICT = int(max(Verdict))
_M = TypeVar("_M")


class _Request(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A request refuses fields it does not know: one that was ignored could have changed the answer.

    Values are checked when one is made, so a client is refused before it sends what a server would refuse.
    """


class AddAvatarRequest(_Request, frozen=True):
    """Give this client an avatar.

    name: 1 to 64 characters.  points: (n, 3) float64, the avatar's frame [m].
    radius: of every point [m], finite and >= 0; null: half the mean closest-point distance of `points`.
    """

    name: Name
    points: Positions
    radius: _Length | None = None

    def __post_init__(self) -> None:
        _check_name(self.name)
        if self.radius is not None:
            _check_length("radius", self.radius)


class CollideRequest(_Request, frozen=True):
    """Ask, for each pose, whether an avatar touches the scene.

    avatar: the name it was added under.  poses: (k, 4, 4) float64, avatar to world, row-major, metres.
    margin: distance below which two spheres are called in contact [m], finite and >= 0.
    """

    avatar: Name
    poses: Poses
    margin: _Length = 0.0

    def __post_init__(self) -> None:
        _check_name(self.avatar)
        _check_length("margin", self.margin)


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
    unknown: boxes like `bounds` of scans left out, where nothing is called clear; unknown_everywhere: of one of
    them not even the bounds are known.
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
    if stated == MSGPACK:
        return MSGPACK
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
        return _decoder(kind, encoding).decode(payload)  # type: ignore[arg-type, no-any-return]
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise BadRequestError(f"{kind.__name__}: {error}: see WIRE.md for its fields") from None


def decode_answer(kind: type[_M], payload: bytes, encoding: str = MSGPACK) -> _M:
    """An answer from its bytes; unknown fields are left out. InternalError: not what WIRE.md says."""
    try:
        return _decoder(kind, encoding).decode(payload)  # type: ignore[arg-type, no-any-return]
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
    if k and max(answers.verdict.tobytes()) > _LAST_VERDICT:
        raise InternalError(
            f"CollideAnswers: verdict {answers.verdict.max()}, expected at most {_LAST_VERDICT}: "
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
        _check_finite("points", array)
    except ValueError as error:
        raise BadRequestError(str(error)) from None
    return array  # type: ignore[return-value]


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
        for definition in components["$defs"].values():
            # Python 3.13 strips a docstring's indentation, earlier ones do not: the same text from all.
            definition["description"] = inspect.cleandoc(definition["description"])
        properties = components["$defs"][kind.__name__]["properties"]
        for name, hint in get_type_hints(kind).items():
            if get_origin(hint) is np.ndarray:
                properties[name].update(_array_schema(hint))
        text = msgspec.json.format(msgspec.json.encode(components, order="sorted"), indent=2)
        texts[kind.__name__] = text.decode() + "\n"
    return texts


def _check_name(name: str) -> None:
    """BadRequestError for an avatar's name that is empty or too long."""
    if not 1 <= len(name) <= 64:
        raise BadRequestError(f"avatar {name[:64]!r} of {len(name)} characters: expected 1 to 64")


def _check_length(what: str, value: float) -> None:
    """BadRequestError for a length no answer exists for (NUMERICS.md N7, cases 14 and 15)."""
    if not 0 <= value < math.inf:
        raise BadRequestError(f"{what} is {value}: expected a finite number of metres, 0 or more")


def _check_finite(name: str, array: np.ndarray) -> None:
    """ValueError for a number no answer exists for (NUMERICS.md N7)."""
    # Of one pose this takes a third of the time that `np.isfinite(array).all()` does.
    if 0 in np.isfinite(array).tobytes():
        where = [int(i) for i in np.argwhere(~np.isfinite(array))[0]]
        raise ValueError(f"{name}{where} is {array[tuple(where)]}, expected finite numbers")


def _as_float64(name: str, values: Any) -> np.ndarray:
    """Numbers as a C-ordered little-endian float64 array; BadRequestError for what is not numbers."""
    try:
        return np.ascontiguousarray(values, _FLOAT64)
    except (TypeError, ValueError) as error:
        raise BadRequestError(f"{name}: {error}: expected an array of numbers") from None


class _ArrayType(NamedTuple):
    """What an array's type says: its dtype, little-endian, and the lengths of all axes but the first."""

    dtype: np.dtype
    tail: tuple[int, ...]
    row_bytes: int


@cache
def _array_type(hint: Any) -> _ArrayType:
    """What an array's type says."""
    shape, of = get_args(hint)
    tail = tuple(get_args(axis)[0] for axis in get_args(shape)[1:] if get_origin(axis) is Literal)
    dtype = np.dtype(get_args(of)[0]).newbyteorder("<")
    return _ArrayType(dtype, tail, dtype.itemsize * math.prod(tail))


def _array_from_lists(hint: Any, value: Any) -> np.ndarray:
    """An array from the nested lists it is in JSON; ValueError says what is wrong with it."""
    if not isinstance(value, list):
        raise ValueError(f"expected nested lists of numbers, found {type(value).__name__}")
    dtype, tail, _ = _array_type(hint)
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
    array = found.astype(dtype)
    if dtype.kind == "f":
        _check_finite("number", array)
    return array


def _array_schema(hint: Any) -> dict[str, Any]:
    """The JSON Schema of an array: nested lists, and how many bytes a row has in MessagePack."""
    dtype, tail, row_bytes = _array_type(hint)
    schema: dict[str, Any] = {"type": {"f": "number", "u": "integer", "b": "boolean"}[dtype.kind]}
    if dtype.kind == "u":
        schema |= {"minimum": 0, "maximum": int(np.iinfo(dtype).max)}
    for length in reversed(tail):
        schema = {"type": "array", "items": schema, "minItems": length, "maxItems": length}
    note = f"{dtype.name}; in MessagePack a bin, {row_bytes} bytes an item"
    return {"type": "array", "items": schema, "description": note}


def _array_to_bin(value: Any) -> bytes:
    """The bytes of an array, for MessagePack."""
    if not isinstance(value, np.ndarray):
        raise NotImplementedError(f"a message cannot hold {type(value).__name__}")
    if not value.dtype.isnative or sys.byteorder == "big":
        value = value.astype(value.dtype.newbyteorder("<"))
    # Not its `data`: exporting a buffer takes longer than copying one of this size.
    return value.tobytes()


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
    return _BinDecoder(kind)


class _BinDecoder:
    """Decodes one type from MessagePack: msgspec reads the bins, which become arrays here in one loop.

    Not in msgspec's `dec_hook`: called for each array of an answer, in the middle of the decoding, it made
    decoding one three times as slow. The twin is a
    subclass whose arrays are bytes at first, so the message is not built twice.
    """

    def __init__(self, kind: type) -> None:
        self._arrays: list[tuple[Any, ...]] = []
        fields: list[Any] = []
        for name, hint in get_type_hints(kind, include_extras=True).items():
            if get_origin(hint) is np.ndarray:
                of = _array_type(hint)
                self._arrays.append((name, of.dtype, of.tail, of.row_bytes, of.dtype.kind))
                fields.append((name, bytes, b"") if _default(kind, name) else (name, bytes))
            else:
                fields.append((name, hint, *_default(kind, name)))
        self._writeable = issubclass(kind, _Request)
        if self._arrays:
            kind = msgspec.defstruct(kind.__name__, fields, bases=(kind,), frozen=True, eq=False)
        self._decoder: Any = msgspec.msgpack.Decoder(kind)

    def decode(self, payload: bytes) -> Any:
        """The message. msgspec.DecodeError, with what it names, where the payload is not one."""
        message = self._decoder.decode(payload)
        for name, dtype, tail, row_bytes, kind in self._arrays:
            value = getattr(message, name)
            rows, rest = divmod(len(value), row_bytes)
            if rest:
                raise _wrong(name, f"{len(value)} bytes, expected a multiple of {row_bytes}")
            if kind == "b" and value.translate(None, b"\0\1"):
                raise _wrong(name, "a byte that is neither 0 nor 1, expected truth values")
            # A request's of a copy: bytes are read-only, and numba compiles another kernel for a read-only array.
            buffer = bytearray(value) if self._writeable else value
            array = np.ndarray((rows,) + tail, dtype, buffer)  # noqa: RUF005
            if kind == "f":
                try:
                    _check_finite(name, array)
                except ValueError as error:
                    raise _wrong(name, str(error)) from None
            force_setattr(message, name, array)
        return message


def _wrong(name: str, text: str) -> msgspec.ValidationError:
    """An error in one field, worded as msgspec words its own."""
    return msgspec.ValidationError(f"{text} - at `$.{name}`")


def _default(kind: type, name: str) -> tuple[Any, ...]:
    """The default of a field of a message, if it has one."""
    default = inspect.signature(kind).parameters[name].default
    return () if default is inspect.Parameter.empty else (default,)
