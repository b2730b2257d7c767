"""Log of a scene's frames: motion commands, everything else that decides results, and the results.

It is written frame by frame and read for a replay.

A file begins with MAGIC. A record is a head of 12 bytes and a body. The head consists of three
little-endian uint32: the length of the body, the CRC-32 of these four bytes, and the CRC-32 of the
body. The body is MessagePack. Each record is written by one unbuffered call. After a server was
killed, all records but the last are therefore complete.

A frame that lacked voxels and did not wait for them depends on what was in memory, which no replay can
repeat. The log therefore holds the state of the body after it, and a replay takes it from there.
"""

import logging
import struct
import zlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import msgspec
import numpy as np

from ...schemas.errors import BadRequestError, CorruptError, FormatError, SolidcloudError
from ...schemas.process.os_errors import write_error_words
from ...schemas.wire.answers import Verdict
from ...schemas.wire.encoding import avatar_digest, encode
from ...schemas.wire.key_expressions import User
from ...schemas.wire.motion_messages import Moved
from ..avatars.avatar_model import AvatarModel
from ..runtime.stop_flag import NO_STOP
from ..scene_interface import FrameCommand, FrameResult
from .world.frame import Body, Pose

if TYPE_CHECKING:  # only scenes whose users can collide import it
    from .world.bodies import Bodies

log = logging.getLogger(__name__)

MAGIC = b"solidcloud frames 1\n"
_HEAD = struct.Struct("<III")
# Limit on a record. A frame of a thousand users takes 1 MB, an avatar of a million points 24 MB.
_MAX_BYTES = 1 << 28
# Name under which the effect `ground` keeps the plane that the avatar stands on.
_GROUND = "ground"
# Name under which it keeps the place where the avatar was raised last.
_RAISED = "ground raised"


class Begin(msgspec.Struct, frozen=True, tag="begin"):
    """First record of a log: the simulated scene.

    scene: its name.  path: of the archive or scene file.  file: bytes of the scene file; empty for
    an archive.  archives: id, hexadecimal, and generation of each.
    motion: version of the rules of motion (schemas/scene/effect_table.py); logs without it are of 1.
    """

    scene: str
    path: str
    file: bytes
    archives: list[tuple[str, int]]
    motion: int = 1


class AvatarPoints(msgspec.Struct, frozen=True, tag="points"):
    """Content of an avatar.

    points: (n, 3) float64, little-endian [m].  radius: of each [m].  inner_points: number of them
    inside, the last ones.
    """

    digest: bytes
    points: bytes
    radius: float
    inner_points: int = 0


class Entered(msgspec.Struct, frozen=True, tag="entered"):
    """A user enters with its next turn, as the avatar with this content."""

    user: User
    digest: bytes


class Ended(msgspec.Struct, frozen=True, tag="ended"):
    """Users that left."""

    users: list[User]


class Dropped(msgspec.Struct, frozen=True, tag="dropped"):
    """A client whose avatars were dropped."""

    client: str


class Reloaded(msgspec.Struct, frozen=True, tag="reloaded"):
    """A hot reload of the archives."""

    generation: int


class BodyRecord(msgspec.Struct, frozen=True, array_like=True):
    """State of a body between frames, as in `Body`, and of the objects that users push.

    pose: as in `TurnResult`.  ground: point and normal of the plane that it stands on, 6 float64,
    little-endian; b"" for none.  pushed: poses of the objects that users push, by name.
    raised: place where `ground` raised it last, 3 float64, little-endian; b"" for none.
    """

    pose: bytes
    fall_speed: float
    on_ground: bool
    clear: bool
    ground: bytes = b""
    pushed: dict[str, bytes] = {}
    raised: bytes = b""


def pose_bytes(pose: Any) -> bytes:
    """Return the logged form of a pose (4, 4): its float64 bytes, little-endian."""
    return np.ascontiguousarray(pose, "<f8").tobytes()


def _pose(data: bytes) -> Pose:
    """Return the pose (4, 4) of its logged form."""
    return np.frombuffer(data, "<f8").reshape(4, 4).astype(np.float64)


class TurnResult(msgspec.Struct, frozen=True, array_like=True):
    """Result of a turn.

    pose: (4, 4) float64, little-endian; b"" if refused.  error: code.
    opened: number of reloads of each archive when the user last moved; empty if it never moved.
    kept: the body after a frame that lacked voxels and did not wait for them; None for all others.
    """

    pose: bytes
    error: str = ""
    opened: list[int] = []
    kept: BodyRecord | None = None


class FrameRecord(msgspec.Struct, frozen=True, tag="frame"):
    """One frame. turns: user and `Wish` (MessagePack, WIRE.md), in order.  said: their results."""

    number: int
    turns: list[tuple[User, bytes]]
    said: list[TurnResult]


Record = Begin | AvatarPoints | Entered | Ended | Dropped | Reloaded | FrameRecord

_ENCODER = msgspec.msgpack.Encoder()
_DECODER = msgspec.msgpack.Decoder(Record)


def record_of(body: Body, bodies: "Bodies | None") -> BodyRecord:
    """Return the record of a body. bodies: of the scene; None if users cannot collide."""
    stood, raised = body.effect_state.get(_GROUND), body.effect_state.get(_RAISED)
    pushed = {}
    if bodies is not None:
        from .world.bodies import PUSHED

        for row in np.flatnonzero(bodies.kinds == PUSHED).tolist():
            pushed[bodies.names[row]] = pose_bytes(bodies.poses[row])
    return BodyRecord(
        pose_bytes(body.pose),
        body.fall_speed,
        body.on_ground,
        body.clear,
        b"" if stood is None else stood.astype("<f8").tobytes(),
        pushed,
        b"" if raised is None else raised.astype("<f8").tobytes(),
    )


def take_record(record: BodyRecord, body: Body, world: Any, bodies: "Bodies | None") -> Moved:
    """Set a body, and the objects that users push, to a record; return the frame's result.

    The verdict is CONTACT if the record states that the pose is clear and it touches the scan.
    """
    world.begin(NO_STOP)
    body.pose, body.generations = _pose(record.pose), world.generations()
    body.fall_speed, body.on_ground, body.clear = record.fall_speed, record.on_ground, record.clear
    body.effect_state.pop(_GROUND, None)
    if record.ground:
        body.effect_state[_GROUND] = np.frombuffer(record.ground, "<f8").astype(np.float64)
    body.effect_state.pop(_RAISED, None)
    if record.raised:
        body.effect_state[_RAISED] = np.frombuffer(record.raised, "<f8").astype(np.float64)
    if bodies is not None:
        bodies.begin()
        for name, pose in record.pushed.items():
            row = bodies.row_of(name, user=False)
            if row >= 0:
                bodies.put(row, _pose(pose))
    verdict = world.collide(body.avatar, body.pose) if record.clear else Verdict.UNKNOWN
    return Moved(pose=body.pose[None].copy(), verdict=int(verdict), unknown=True)


def turn_result(
    outcome: FrameResult, opened: Sequence[int] = (), kept: BodyRecord | None = None
) -> TurnResult:
    """Return the logged form of an outcome. opened, kept: as in `TurnResult`."""
    if isinstance(outcome.state, SolidcloudError):
        return TurnResult(b"", str(outcome.state.code))
    return TurnResult(pose_bytes(outcome.state.pose), "", list(opened), kept)


class FrameLog:
    """Writer of a log; a context manager. Not thread-safe: a simulation calls it during a frame.

    After a failed write nothing more is written, and an error is logged. The scene is still served.
    """

    def __init__(self, path: str | Path, begin: Begin) -> None:
        """Create a new file. Raises BadRequestError if it exists or cannot be written."""
        self._path = Path(path)
        try:
            self._file: BinaryIO | None = open(path, "xb", buffering=0)  # noqa: SIM115
        except FileExistsError:
            raise BadRequestError(
                f"{path}: exists, and a log is not overwritten: expected a new file: choose another name"
            ) from None
        except OSError as error:
            raise BadRequestError(
                f"{path}: the log cannot be written: {write_error_words(error, self._path)}"
            ) from None
        self._known: set[bytes] = set()
        self._write_all(MAGIC)
        self._write(begin)

    def __enter__(self) -> "FrameLog":
        """Return the log itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close the file."""
        self.close()

    def close(self) -> None:
        """Close the file. Later records are not written."""
        file, self._file = self._file, None
        if file is not None:
            file.close()

    def entered(self, user: User, avatar: AvatarModel) -> None:
        """Record that a user enters with its next turn."""
        points = np.ascontiguousarray(avatar.points, "<f8").tobytes()
        digest = avatar_digest(avatar.points, avatar.radius, avatar.inner_points)
        if digest not in self._known:
            self._known.add(digest)
            self._write(AvatarPoints(digest, points, avatar.radius, avatar.inner_points))
        self._write(Entered(user, digest))

    def ended(self, users: list[User]) -> None:
        """Record that users left."""
        self._write(Ended(users))

    def dropped(self, client: str) -> None:
        """Record that a client's avatars were dropped."""
        self._write(Dropped(client))

    def reloaded(self, generation: int) -> None:
        """Record a hot reload of the archives."""
        self._write(Reloaded(generation))

    def frame(
        self,
        number: int,
        turns: Sequence[FrameCommand],
        outcomes: Sequence[FrameResult],
        opened: Sequence[Sequence[int]],
        kept: Sequence[BodyRecord | None],
    ) -> None:
        """Record one frame. opened, kept: for each turn, as in `TurnResult`."""
        commands = [(turn.user, encode(turn.wish)) for turn in turns]
        results = [turn_result(*each) for each in zip(outcomes, opened, kept, strict=True)]
        self._write(FrameRecord(number, commands, results))

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
            log.error("%s: %s: later frames are not in the log", self._path, error.strerror)
            self.close()


def read_log(path: str | Path) -> Iterator[Record]:
    """Yield the complete records of a log, beginning with a `Begin`; omit one cut off at the end.

    Raise FormatError if the file is not a log, CorruptError with number and position of a record
    that was altered.
    """
    try:
        file = open(path, "rb")  # noqa: SIM115
    except OSError as error:
        raise FormatError(f"{path}: {error.strerror}: expected a log written by serve --log") from None
    with file:
        if file.read(len(MAGIC)) != MAGIC:
            raise FormatError(f"{path}: does not begin with {MAGIC!r}: expected a log written by serve --log")
        for number in _count_from_zero():
            where = f"{path}: record {number} at byte {file.tell()}"
            record = _read_record(file, where)
            if record is None:
                if number == 0:
                    raise FormatError(f"{where}: cut off: expected a complete first record")
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
    """Read the next record; return None at the end, or if the record is cut off."""
    head = file.read(_HEAD.size)
    if len(head) < _HEAD.size:
        return None
    length, of_length, of_body = _HEAD.unpack(head)
    if zlib.crc32(head[:4]) != of_length or length > _MAX_BYTES:
        raise CorruptError(f"{where}: its length {length} has another checksum: expected an unaltered file")
    body = file.read(length)
    if len(body) < length:
        return None
    if zlib.crc32(body) != of_body:
        raise CorruptError(
            f"{where}: its bytes have checksum {zlib.crc32(body):08x}: expected {of_body:08x} as in an unaltered file"
        )
    try:
        return _DECODER.decode(body)
    except msgspec.DecodeError as error:
        raise CorruptError(f"{where}: {error}: written by another version?") from None
