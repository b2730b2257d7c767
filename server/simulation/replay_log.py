"""The log of a scene's frames: all that decides what came of wishes, and what did; written as it happens, read for a
replay.

A file begins with MAGIC. A record is a head of 12 bytes, little-endian uint32: the length of its body, the CRC-32 of
these four bytes, the CRC-32 of the body; then the body, MessagePack. It is written by one call that nothing buffers: a
server that is killed leaves whole records, of which the last may be cut off.
"""

import hashlib
import logging
import struct
import zlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, BinaryIO

import msgspec
import numpy as np

from ...schemas.errors import BadRequestError, CorruptError, FormatError, SolidcloudError
from ...schemas.process.os_errors import write_error_words
from ...schemas.wire.encoding import encode
from ...schemas.wire.key_expressions import User
from ..avatars.avatar_model import AvatarModel
from ..scene_interface import FrameCommand, FrameResult

log = logging.getLogger(__name__)

MAGIC = b"solidcloud frames 1\n"
_HEAD = struct.Struct("<III")
# A frame of a thousand users takes a megabyte; an avatar of a million points 24.
_MOST_BYTES = 1 << 28


class Begin(msgspec.Struct, frozen=True, tag="begin"):
    """What is simulated. scene: its name.  path: of the archive or scene file.  file: the scene file's bytes, or none.

    archives: id, hexadecimal, and generation of each.
    """

    scene: str
    path: str
    file: bytes
    archives: list[tuple[str, int]]


class Points(msgspec.Struct, frozen=True, tag="points"):
    """An avatar, by its content. points: (n, 3) float64, little-endian [m].  radius: of each [m]."""

    digest: bytes
    points: bytes
    radius: float


class Entered(msgspec.Struct, frozen=True, tag="entered"):
    """A user comes in with its next turn, as the avatar of this content."""

    user: User
    digest: bytes


class Ended(msgspec.Struct, frozen=True, tag="ended"):
    """Users left."""

    users: list[User]


class Dropped(msgspec.Struct, frozen=True, tag="dropped"):
    """A client's avatars were forgotten."""

    client: str


class Reloaded(msgspec.Struct, frozen=True, tag="reloaded"):
    """The archives were opened anew."""

    generation: int


class Said(msgspec.Struct, frozen=True, array_like=True):
    """What came of a turn. pose: (4, 4) float64, little-endian; b"": refused.  error: the code.  skipped: effects.

    opened: how often each archive had been reloaded when the user last moved; empty where it never did.
    """

    pose: bytes
    error: str = ""
    skipped: list[str] = []
    opened: list[int] = []


class Frame(msgspec.Struct, frozen=True, tag="frame"):
    """One frame. turns: user and wish (WIRE.md, MessagePack), in order.  said: of each."""

    number: int
    turns: list[tuple[User, bytes]]
    said: list[Said]


Record = Begin | Points | Entered | Ended | Dropped | Reloaded | Frame

_ENCODER = msgspec.msgpack.Encoder()
_DECODER = msgspec.msgpack.Decoder(Record)


def said(outcome: FrameResult, opened: Sequence[int] = ()) -> Said:
    """What a log says of an outcome. opened: how often each archive had been reloaded."""
    if isinstance(outcome.state, SolidcloudError):
        return Said(b"", str(outcome.state.code))
    return Said(pose_bytes(outcome.state.pose), "", list(outcome.state.skipped), list(opened))


def pose_bytes(pose: Any) -> bytes:
    """A pose as it stands in a log."""
    return np.ascontiguousarray(pose, "<f8").tobytes()


class FrameLog:
    """Writes a log; a context manager. Not thread-safe: a simulation tells it one thing at a time.

    What cannot be written is logged as an error, and nothing after it is: a scene is served all the same.
    """

    def __init__(self, path: str | Path, begin: Begin) -> None:
        """Begin a new file. BadRequestError: it exists, or cannot be written."""
        self._path = Path(path)
        try:
            self._file: BinaryIO | None = open(path, "xb", buffering=0)  # noqa: SIM115
        except FileExistsError:
            raise BadRequestError(
                f"{path}: exists: expected none, a log is not written over: name another"
            ) from None
        except OSError as error:
            raise BadRequestError(
                f"{path}: the log cannot be written: {write_error_words(error, self._path)}"
            ) from None
        self._known: set[bytes] = set()
        self._write_all(MAGIC)
        self._write(begin)

    def __enter__(self) -> "FrameLog":
        """The log itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close the file."""
        self.close()

    def close(self) -> None:
        """Close the file; nothing more is written."""
        file, self._file = self._file, None
        if file is not None:
            file.close()

    def entered(self, user: User, avatar: AvatarModel) -> None:
        """A user comes in with its next turn."""
        points = np.ascontiguousarray(avatar.points, "<f8").tobytes()
        digest = hashlib.sha256(struct.pack("<d", avatar.radius) + points).digest()
        if digest not in self._known:
            self._known.add(digest)
            self._write(Points(digest, points, avatar.radius))
        self._write(Entered(user, digest))

    def ended(self, users: list[User]) -> None:
        """Users left."""
        self._write(Ended(users))

    def dropped(self, client: str) -> None:
        """A client's avatars were forgotten."""
        self._write(Dropped(client))

    def reloaded(self, generation: int) -> None:
        """The archives were opened anew."""
        self._write(Reloaded(generation))

    def frame(
        self,
        number: int,
        turns: Sequence[FrameCommand],
        outcomes: Sequence[FrameResult],
        opened: Sequence[Sequence[int]],
    ) -> None:
        """One frame. opened: of each turn, how often each archive had been reloaded."""
        wished = [(turn.user, encode(turn.wish)) for turn in turns]
        self._write(Frame(number, wished, [said(*each) for each in zip(outcomes, opened, strict=True)]))

    def _write(self, record: Record) -> None:
        """Append one record."""
        body = _ENCODER.encode(record)
        length = struct.pack("<I", len(body))
        self._write_all(length + struct.pack("<II", zlib.crc32(length), zlib.crc32(body)) + body)

    def _write_all(self, data: bytes) -> None:
        """Append bytes."""
        if self._file is None:
            return
        try:
            while data:
                data = data[self._file.write(data) :]
        except OSError as error:
            log.error("%s: %s: what comes after is not in the log", self._path, error.strerror)
            self.close()


def read_log(path: str | Path) -> Iterator[Record]:
    """The whole records of a log, the first of them a `Begin`; one that is cut off at the end is left out.

    FormatError: no such log. CorruptError: a record is not what was written, with its number and place.
    """
    try:
        file = open(path, "rb")  # noqa: SIM115
    except OSError as error:
        raise FormatError(f"{path}: {error.strerror}: expected a log, as serve --log writes it") from None
    with file:
        if file.read(len(MAGIC)) != MAGIC:
            raise FormatError(
                f"{path}: begins with other bytes than {MAGIC!r}: expected a log of serve --log"
            )
        for number in _count_from_zero():
            where = f"{path}: record {number} at byte {file.tell()}"
            record = _read_record(file, where)
            if record is None:
                if number == 0:
                    raise FormatError(f"{where}: cut off: expected what was simulated")
                return
            if isinstance(record, Begin) != (number == 0):
                raise CorruptError(f"{where}: {type(record).__name__}: expected Begin first, and only there")
            yield record


def _count_from_zero() -> Iterator[int]:
    number = 0
    while True:
        yield number
        number += 1


def _read_record(file: BinaryIO, where: str) -> Record | None:
    """The next record; None: there is none, or it is cut off."""
    head = file.read(_HEAD.size)
    if len(head) < _HEAD.size:
        return None
    length, of_length, of_body = _HEAD.unpack(head)
    if zlib.crc32(head[:4]) != of_length or length > _MOST_BYTES:
        raise CorruptError(f"{where}: its length, {length}, is not what was written: the file was changed")
    body = file.read(length)
    if len(body) < length:
        return None
    if zlib.crc32(body) != of_body:
        raise CorruptError(
            f"{where}: its bytes have checksum {zlib.crc32(body):08x}, expected {of_body:08x}: the file was changed"
        )
    try:
        return _DECODER.decode(body)
    except msgspec.DecodeError as error:
        raise CorruptError(f"{where}: {error}: written by another version?") from None
