"""The two encodings of a message: bytes to types and back.

An array is a little-endian, C-ordered bin in MessagePack and nested lists in JSON; its dtype and shape are those of
the field's type, so neither travels. Requests hold finite numbers only. Answers may hold infinities and NaN: as they
are in MessagePack, as null in JSON, read back by what the field is (`_of_null`).
"""

import inspect
import math
import re
import sys
from collections.abc import Iterator
from functools import cache
from typing import Any, TypeVar, get_type_hints

import msgspec
import numpy as np
from msgspec.structs import asdict

from .arrays import ArrayType, array_fields
from .errors import BadRequestError, InternalError
from .requests import Request, check_finite

MSGPACK = "application/msgpack"
JSON = "application/json"

# What is larger is read and written in pieces, between which other threads may take the interpreter: a whole message in
# JSON would keep it for half a second. Bytes of a bin; bytes of a message in JSON, and of a piece; numbers of a piece.
_LARGE_BIN = 1 << 18
_LARGE_JSON, _JSON_PIECE = 1 << 17, 1 << 16
_LISTED = 1 << 13

# Raised, a peer of version 1 would drop the larger messages unread.
MAX_MESSAGE_BYTES = 32 << 20

_M = TypeVar("_M")


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


def _of_null(name: str, tail: tuple[int, ...]) -> float:
    """What null stands for in an answer's field: NaN in vectors, else the bound that says least."""
    if tail:
        return math.nan
    return -math.inf if name == "lower" else math.inf


def _array_from_bin(name: str, value: bytes, of: ArrayType, request: bool) -> np.ndarray:
    """An array from its bytes; ValueError says what is wrong with them."""
    dtype, tail, row_bytes = of
    rows, rest = divmod(len(value), row_bytes)
    if rest:
        raise ValueError(f"{len(value)} bytes, expected a multiple of {row_bytes}")
    if dtype.kind == "b" and value.translate(None, b"\0\1"):
        raise ValueError("a byte that is neither 0 nor 1, expected truth values")
    # A request's of a copy: bytes are read-only, and numba compiles another kernel for a read-only array.
    if request and len(value) > _LARGE_BIN:
        array = np.empty((rows, *tail), dtype)
        np.copyto(array, np.ndarray(array.shape, dtype, value))  # lets other threads have the interpreter
    else:
        array = np.ndarray((rows,) + tail, dtype, bytearray(value) if request else value)  # noqa: RUF005
    if request and dtype.kind == "f":
        check_finite(name, array)
    return array


def _array_from_lists(name: str, value: list[Any], of: ArrayType, request: bool) -> np.ndarray:
    """An array from the nested lists it is in JSON; ValueError says what is wrong with them."""
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
        raise ValueError(f"expected nested lists of {dtype.name}, found something else among them")
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
    """An array from the text of its nested lists in JSON, piece by piece; ValueError says what is wrong with them."""
    text = bytes(raw).strip()
    if not text.startswith(b"["):
        raise ValueError("expected nested lists")
    pieces = [_array_from_lists(name, piece, of, request) for piece in _pieces(text, len(of[1]))]
    return pieces[0] if len(pieces) == 1 else np.concatenate(pieces)


def _pieces(text: bytes, depth: int) -> Iterator[list[Any]]:
    """Yield a list in JSON, some of its elements at a time. depth: of the lists that its elements are; 0: numbers.

    ValueError where an element is longer than a piece: nothing else could run while it is decoded.
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
    """An array of numbers and None with the None replaced; as it was where it holds anything else."""
    values = found.ravel().tolist()
    if not all(value is None or type(value) in (int, float) for value in values):
        return found
    return np.array([of_null if value is None else value for value in values], np.float64).reshape(
        found.shape
    )


def _array_to_bin(value: Any) -> Any:
    """The bytes of an array, for MessagePack; a number of numpy's as one of Python's."""
    if isinstance(value, np.generic):
        return value.item()
    if not isinstance(value, np.ndarray):
        raise NotImplementedError(f"a message cannot hold {type(value).__name__}")
    if not value.dtype.isnative or sys.byteorder == "big":
        value = value.astype(value.dtype.newbyteorder("<"))
    # Not its `data`: exporting a buffer takes longer than copying one of this size.
    return value.tobytes()


def _array_to_lists(value: Any) -> Any:
    """The nested lists of an array, or a number of numpy's, for JSON; msgspec writes what is not finite as null."""
    if not isinstance(value, np.ndarray | np.generic):
        raise NotImplementedError(f"a message cannot hold {type(value).__name__}")
    if isinstance(value, np.generic) or value.size <= _LISTED:
        return value.tolist()
    rows = max(1, _LISTED * len(value) // value.size)
    pieces = (value[begin : begin + rows].tolist() for begin in range(0, len(value), rows))
    return msgspec.Raw(b"[" + b",".join(_JSON_ENCODER.encode(piece)[1:-1] for piece in pieces) + b"]")


# Encoders and decoders are made once: making one costs more than a whole message does.
_MSGPACK_ENCODER = msgspec.msgpack.Encoder(enc_hook=_array_to_bin)
_JSON_ENCODER = msgspec.json.Encoder(enc_hook=_array_to_lists)
_LIST_DECODER = msgspec.json.Decoder(list)


@cache
def _decoder(kind: type, encoding: str) -> "_Decoder":
    """The decoder of one type in one encoding."""
    return _Decoder(kind, encoding)


class _Decoder:
    """Decodes one type: msgspec reads bins or lists into a twin of it, which become arrays here in one loop.

    Not in msgspec's `dec_hook`: called for each array of an answer, in the middle of the decoding, it made decoding one
    three times as slow, and it is not told which field it is called for.
    """

    def __init__(self, kind: type, encoding: str) -> None:
        self._kind = kind
        self._arrays = tuple(array_fields(kind).items())
        self._request = issubclass(kind, Request)
        self._convert: Any = _array_from_lists if encoding == JSON else _array_from_bin
        module = msgspec.json if encoding == JSON else msgspec.msgpack
        self._decoder: Any = module.Decoder(self._twin(encoding) if self._arrays else kind)
        # Of a large message in JSON the arrays stay text at first.
        in_pieces = encoding == JSON and self._arrays
        self._raw_decoder: Any = module.Decoder(self._twin(encoding, raw=True)) if in_pieces else None

    def _twin(self, encoding: str, raw: bool = False) -> type:
        """The same fields, with bytes or lists for arrays; raw: with the text of lists."""
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
        refuse = self._request  # fields that are not known
        return msgspec.defstruct(
            self._kind.__name__, fields, kw_only=True, forbid_unknown_fields=refuse, gc=False
        )

    def decode(self, payload: bytes) -> Any:
        """The message. msgspec.DecodeError, with what it names, where the payload is not one."""
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
    """An error in one field, worded as msgspec words its own."""
    return msgspec.ValidationError(f"{text} - at `$.{name}`")


def _default(kind: type, name: str) -> tuple[Any, ...]:
    """The default of a field of a message, if it has one."""
    default = inspect.signature(kind).parameters[name].default
    return () if default is inspect.Parameter.empty else (default,)
