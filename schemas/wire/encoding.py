"""Encoding and decoding of messages: MessagePack and JSON.

An array is a little-endian, C-ordered bin in MessagePack and nested lists in JSON. Its dtype and
shape come from the field's type and are not transmitted. Requests contain finite numbers only.
Answers may contain infinities and NaN. MessagePack represents them, JSON has null instead. A reader
of JSON restores them by the field (`_of_null`).
"""

import hashlib
import inspect
import math
import re
import struct
import sys
from collections.abc import Iterator
from functools import cache
from typing import Any, TypeVar, get_type_hints

import msgspec
import numpy as np
from msgspec import structs
from msgspec.structs import asdict
from numpy.typing import NDArray

from ..errors import BadRequestError, InternalError
from .arrays import ArrayType, array_fields
from .requests import Request, check_finite

MSGPACK = "application/msgpack"
JSON = "application/json"

# Larger data is read and written in pieces, between which other threads can take the interpreter's
# lock: a whole message in JSON would hold it for half a second. The limits are bytes of a bin,
# bytes of a message in JSON, bytes of a piece, and numbers in a piece.
_LARGE_BIN = 1 << 18
_LARGE_JSON, _JSON_PIECE = 1 << 17, 1 << 16
_LISTED = 1 << 13

_RADIUS_AND_COUNT = struct.Struct("<2d")

_M = TypeVar("_M")


def wire_encoding(stated: str | None) -> str:
    """Return the encoding for a stated encoding: `MSGPACK` if none is stated, or `JSON`.

    zenoh states `zenoh/bytes` if the sender stated nothing. Raises BadRequestError for any other
    encoding.
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
    r"""Encode one message. Arrays must already have the dtype of their field.

    A byte of a file's name that is not UTF-8 is written as an escape such as `\udcff`.
    """
    encoder = _JSON_ENCODER if encoding == JSON else _MSGPACK_ENCODER
    try:
        return encoder.encode(message)
    except UnicodeEncodeError:
        return encoder.encode(_valid_text(message))


def _valid_text(value: Any) -> Any:
    """Return a message, or a part of one, in which every text can be encoded."""
    if isinstance(value, str):
        return value.encode(errors="backslashreplace").decode()
    if isinstance(value, msgspec.Struct):
        fields = value.__struct_fields__
        return structs.replace(value, **{name: _valid_text(getattr(value, name)) for name in fields})
    if isinstance(value, dict):
        return {_valid_text(name): _valid_text(each) for name, each in value.items()}
    if isinstance(value, list | tuple):
        # A tuple with names is encoded as its items.
        return [_valid_text(each) for each in value]
    return value


def decode_request(kind: type[_M], payload: bytes, encoding: str = MSGPACK) -> _M:
    """Decode a request.

    Raises BadRequestError with the wrong field, what was found and what was expected.
    """
    try:
        return _decoder(kind, encoding).decode(payload)  # type: ignore[arg-type, no-any-return]
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise BadRequestError(f"{kind.__name__}: {error}: see WIRE.md for its fields") from None


def decode_answer(kind: type[_M], payload: bytes, encoding: str = MSGPACK) -> _M:
    """Decode an answer. Unknown fields are ignored.

    Raises InternalError if the payload differs from what WIRE.md specifies.
    """
    try:
        return _decoder(kind, encoding).decode(payload)  # type: ignore[arg-type, no-any-return]
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise InternalError(
            f"{kind.__name__}: {error}: client and server may have different versions"
        ) from None


def avatar_digest(points: NDArray[np.float64], radius: float, inner_points: int = 0) -> bytes:
    """Return the SHA-256 that identifies an avatar by its content.

    points: (n, 3) [m].  radius: of each point's sphere [m].  inner_points: number of inner ones.
    The hash covers the points, row by row, the radius, and the number of inner points, each number
    as a little-endian float64; -0.0 counts as 0.0.
    """
    found = hashlib.sha256(np.asarray(points + 0.0, "<f8").tobytes())
    found.update(_RADIUS_AND_COUNT.pack(radius + 0.0, inner_points))
    return found.digest()


def _of_null(name: str, tail: tuple[int, ...]) -> float:
    """Return the value that null stands for in an answer's field.

    NaN in vectors, otherwise the weakest bound: -inf for `lower`, +inf for all others.
    """
    if tail:
        return math.nan
    return -math.inf if name == "lower" else math.inf


def _array_from_bin(name: str, value: bytes, of: ArrayType, request: bool) -> np.ndarray:
    """Make an array from its bytes. Raises ValueError saying what is wrong with them."""
    dtype, tail, row_bytes = of
    rows, rest = divmod(len(value), row_bytes)
    if rest:
        raise ValueError(f"{len(value)} bytes, expected a multiple of {row_bytes}")
    if dtype.kind == "b" and value.translate(None, b"\0\1"):
        raise ValueError("a byte that is neither 0 nor 1, expected booleans")
    # A request's array is a copy: bytes are read-only, and numba compiles another kernel for a
    # read-only array.
    if request and len(value) > _LARGE_BIN:
        array = np.empty((rows, *tail), dtype)
        np.copyto(array, np.ndarray(array.shape, dtype, value))  # lets other threads take the interpreter
    else:
        array = np.ndarray((rows,) + tail, dtype, bytearray(value) if request else value)  # noqa: RUF005
    if request and dtype.kind == "f":
        check_finite(name, array)
    return array


def _array_from_lists(name: str, value: list[Any], of: ArrayType, request: bool) -> np.ndarray:
    """Make an array from JSON's nested lists. Raises ValueError saying what is wrong with them."""
    dtype, tail, _ = of
    if not value:
        return np.zeros((0, *tail), dtype)
    try:
        found = np.array(value)  # ValueError where the lists are ragged
    except OverflowError as error:
        raise ValueError(str(error)) from None
    if found.dtype == object and dtype.kind == "f" and not request:
        found = _filled(found, _of_null(name, tail))
    if found.dtype.kind not in {"f": "iuf", "u": "iu", "i": "iu", "b": "b"}[dtype.kind]:
        raise ValueError(f"expected nested lists of {dtype.name}, found other values in them")
    if found.ndim != 1 + len(tail) or found.shape[1:] != tail:
        expected = ", ".join(["n", *map(str, tail)])
        raise ValueError(f"lists of shape {found.shape}, expected ({expected})")
    if dtype.kind in "ui":
        low, high = np.iinfo(dtype).min, np.iinfo(dtype).max
        if found.min() < low or found.max() > high:
            raise ValueError(f"integers from {found.min()} to {found.max()} do not fit {dtype.name}")
    array = found.astype(dtype)
    if dtype.kind == "f" and request:
        check_finite("number", array)
    return array


def _array_from_raw(name: str, raw: msgspec.Raw, of: ArrayType, request: bool) -> np.ndarray:
    """Make an array from the JSON text of its nested lists, piece by piece.

    Raises ValueError saying what is wrong with the text.
    """
    text = bytes(raw).strip()
    if not text.startswith(b"["):
        raise ValueError("expected nested lists")
    pieces = [_array_from_lists(name, piece, of, request) for piece in _pieces(text, len(of[1]))]
    return pieces[0] if len(pieces) == 1 else np.concatenate(pieces)


def _pieces(text: bytes, depth: int) -> Iterator[list[Any]]:
    """Yield a JSON list, some of its elements at a time.

    depth: nesting depth of the elements; 0: numbers.
    Raises ValueError if an element is longer than a piece: no other thread could run while it is
    decoded.
    """
    ends = re.compile(rb"\]\s*" * depth + b",")
    begin, last = 1, len(text) - 1
    while True:
        end = ends.search(text, begin + _JSON_PIECE, min(last, begin + 2 * _JSON_PIECE))
        if end is None and last > begin + 2 * _JSON_PIECE:
            raise ValueError(
                f"no end of an element in {2 * _JSON_PIECE} bytes of JSON from byte {begin} of the array, "
                f"expected elements that are {depth}-fold lists, of less than {_JSON_PIECE} bytes each"
            )
        stop = last if end is None else end.end() - 1
        yield _LIST_DECODER.decode(b"[" + text[begin:stop] + b"]")
        if end is None:
            return
        begin = stop + 1


def _filled(found: np.ndarray, of_null: float) -> np.ndarray:
    """Replace None in an array of numbers and None; return any other array unchanged."""
    values = found.ravel().tolist()
    if not all(value is None or type(value) in (int, float) for value in values):
        return found
    return np.array([of_null if value is None else value for value in values], np.float64).reshape(
        found.shape
    )


def _array_to_bin(value: Any) -> Any:
    """Convert an array to bytes for MessagePack, and a numpy number to a Python number."""
    if isinstance(value, np.generic):
        return value.item()
    if not isinstance(value, np.ndarray):
        raise NotImplementedError(f"a message cannot hold {type(value).__name__}")
    if not value.dtype.isnative or sys.byteorder == "big":
        value = value.astype(value.dtype.newbyteorder("<"))
    # Not `value.data`: exporting a buffer takes longer than copying an array of this size.
    return value.tobytes()


def _array_to_lists(value: Any) -> Any:
    """Convert an array to nested lists for JSON, and a numpy number to a Python number.

    msgspec writes non-finite numbers as null.
    """
    if not isinstance(value, np.ndarray | np.generic):
        raise NotImplementedError(f"a message cannot hold {type(value).__name__}")
    if isinstance(value, np.generic) or value.size <= _LISTED:
        return value.tolist()
    rows = max(1, _LISTED * len(value) // value.size)
    pieces = (value[begin : begin + rows].tolist() for begin in range(0, len(value), rows))
    return msgspec.Raw(b"[" + b",".join(_JSON_ENCODER.encode(piece)[1:-1] for piece in pieces) + b"]")


# Encoders and decoders are made once: making one costs more than encoding a whole message.
_MSGPACK_ENCODER = msgspec.msgpack.Encoder(enc_hook=_array_to_bin)
_JSON_ENCODER = msgspec.json.Encoder(enc_hook=_array_to_lists)
_LIST_DECODER = msgspec.json.Decoder(list)


@cache
def _decoder(kind: type, encoding: str) -> "_Decoder":
    """Return the cached decoder of one type in one encoding."""
    return _Decoder(kind, encoding)


class _Decoder:
    """Decoder of one type.

    msgspec decodes bins or lists into a twin type, and one loop here converts them to arrays. A
    `dec_hook` of msgspec is called for each array during decoding, which made decoding an answer
    three times as slow, and the hook does not learn the name of the field.
    """

    def __init__(self, kind: type, encoding: str) -> None:
        self._kind = kind
        self._arrays = tuple(array_fields(kind).items())
        self._request = issubclass(kind, Request)
        self._convert: Any = _array_from_lists if encoding == JSON else _array_from_bin
        module = msgspec.json if encoding == JSON else msgspec.msgpack
        self._decoder: Any = module.Decoder(self._twin(encoding) if self._arrays else kind)
        # In a large message in JSON, msgspec leaves the arrays as text, to be read in pieces.
        in_pieces = encoding == JSON and self._arrays
        self._raw_decoder: Any = module.Decoder(self._twin(encoding, raw=True)) if in_pieces else None

    def _twin(self, encoding: str, raw: bool = False) -> type:
        """Make a type with the same fields, but bytes or lists in place of arrays.

        raw: hold the text of lists instead.
        """
        held: Any
        held, empty = (list, []) if encoding == JSON else (bytes, b"")
        if raw:
            held, empty = msgspec.Raw, msgspec.Raw(b"[]")
        names = {name for name, _ in self._arrays}
        fields: list[Any] = []
        for name, hint in get_type_hints(self._kind, include_extras=True).items():
            default = _default(self._kind, name)
            if name in names:
                fields.append((name, held, *((empty,) if default else ())))
            else:
                fields.append((name, hint, *default))
        refuse = self._request  # refuse unknown fields
        return msgspec.defstruct(
            self._kind.__name__, fields, kw_only=True, forbid_unknown_fields=refuse, gc=False
        )

    def decode(self, payload: bytes) -> Any:
        """Decode a message. Raises msgspec.DecodeError, naming the field, if it is invalid."""
        large = self._raw_decoder is not None and len(payload) > _LARGE_JSON
        message = (self._raw_decoder if large else self._decoder).decode(payload)
        if not self._arrays:
            return message
        fields = asdict(message)
        convert = _array_from_raw if large else self._convert
        for name, of in self._arrays:
            try:
                fields[name] = convert(name, fields[name], of, self._request)
            except ValueError as error:
                raise _wrong(name, str(error)) from None
        return self._kind(**fields)


def _wrong(name: str, text: str) -> msgspec.ValidationError:
    """Return an error about one field, worded like msgspec's own."""
    return msgspec.ValidationError(f"{text} - at `$.{name}`")


def _default(kind: type, name: str) -> tuple[Any, ...]:
    """Return the default of a message's field as a 1-tuple, or () if it has none."""
    default = inspect.signature(kind).parameters[name].default
    return () if default is inspect.Parameter.empty else (default,)
