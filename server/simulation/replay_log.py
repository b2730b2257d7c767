"""Log of a scene's frames: motion commands, everything else that decides results, and the results.

A log is a text. Its first line is MAGIC. Each further line is a record: the CRC-32 of its JSON in
eight hexadecimal digits, a space, and the JSON. The first record is a `LogHead`, the others are
`LoggedFrame`s. JSON holds numbers in the shortest digits that give the same float64 again.

Each line is written by one unbuffered call. After a server was killed, all lines but the last are
therefore complete.

A frame that lacked voxels and did not wait for them depends on what was in memory, which no replay can
repeat. The log therefore holds the state of the body after it, and a replay takes it from there.
"""

import logging
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, cast

import msgspec
import numpy as np

from ...schemas.errors import BadRequestError, CorruptError, FormatError, SolidcloudError
from ...schemas.runtime.os_errors import write_error_words
from ...schemas.wire.answers import Verdict
from ...schemas.wire.encoding import JSON, avatar_digest, encode
from ...schemas.wire.key_expressions import User
from ...schemas.wire.motion_messages import Moved, State
from ...schemas.wire.requests import AddAvatarRequest
from ..avatars.avatar_model import AvatarModel
from ..runtime.stop_flag import NO_STOP
from ..scene_interface import FrameCommand
from .world.frame import GROUND_PLANE, RAISED, Body, Pose

if TYPE_CHECKING:  # only scenes whose users can collide import it
    from .world.bodies import Bodies

log = logging.getLogger(__name__)

MAGIC = b"solidcloud frames 1\n"
# Entries of `Body.effect_state` on which later poses depend and which no frame computes anew.
_KEPT = (GROUND_PLANE, RAISED)

Rows = list[list[float]]  # (4, 4), a pose


class LogHead(msgspec.Struct, frozen=True):
    """First record of a log: the simulated scene.

    scene: its name.  path: of the archive or scene file.  file: bytes of the scene file; empty for
    an archive.  archives: id, hexadecimal, and generation of each.
    motion: version of the rules of motion (schemas/scene/effect_table.py).
    """

    scene: str
    path: str
    file: bytes
    archives: list[tuple[str, int]]
    motion: int


class BodyRecord(msgspec.Struct, frozen=True):
    """State of a body between frames besides its pose, and of the objects that users push.

    fall_speed, on_ground, clear: as in `Body`.  kept: its arrays of `effect_state`.
    pushed: poses of the objects that users push, by name.
    """

    fall_speed: float
    on_ground: bool
    clear: bool
    kept: dict[str, list[float]]
    pushed: dict[str, Rows]


class LoggedTurn(msgspec.Struct, frozen=True, omit_defaults=True):
    """Motion command of one user in a frame, and its result.

    wish: the motion command as in WIRE.md.  pose: the result; None if it was refused.  error: code.
    opened: number of reloads of each archive when the user last moved; empty if it never moved.
    body: the body after a frame that lacked voxels and did not wait for them; None for all others.
    """

    user: User
    wish: msgspec.Raw
    pose: Rows | None = None
    error: str = ""
    opened: list[int] = []
    body: BodyRecord | None = None


class LoggedFrame(msgspec.Struct, omit_defaults=True):
    """One frame, and what happened since the frame before it.

    ended: users that left.  dropped: clients whose avatars were dropped.
    entered: users that enter in this frame, with the digest of their avatar.
    avatars: each avatar by its digest, hexadecimal, where it occurs first: an encoded `AddAvatarRequest`.
    turns: the motion commands, in order.
    """

    number: int = 0
    ended: list[User] = []
    dropped: list[str] = []
    entered: list[tuple[User, str]] = []
    avatars: dict[str, bytes] = {}
    turns: list[LoggedTurn] = []


def result_of(state: State | SolidcloudError) -> tuple[Rows | None, str]:
    """Return the pose and the error of a turn, as in `LoggedTurn`."""
    if isinstance(state, SolidcloudError):
        return None, str(state.code)
    return cast(Rows, state.pose[0].tolist()), ""


def _record_of(body: Body, bodies: "Bodies | None") -> BodyRecord:
    """Return the record of a body. bodies: of the scene; None if users cannot collide."""
    pushed = {}
    if bodies is not None:
        from .world.bodies import PUSHED

        rows = np.flatnonzero(bodies.kinds == PUSHED).tolist()
        pushed = {bodies.names[row]: bodies.poses[row].tolist() for row in rows}
    kept = {name: body.effect_state[name].tolist() for name in _KEPT if name in body.effect_state}
    return BodyRecord(body.fall_speed, body.on_ground, body.clear, kept, pushed)


def take_record(turn: LoggedTurn, body: Body, world: Any, bodies: "Bodies | None") -> Moved:
    """Set a body, and the objects that users push, as a turn with a record left them; return its result.

    The verdict is CONTACT if the record states that the pose is clear and it touches the scan.
    """
    record = turn.body
    assert record is not None
    world.begin(NO_STOP)
    body.pose, body.generations = np.array(turn.pose), world.generations()
    body.fall_speed, body.on_ground, body.clear = record.fall_speed, record.on_ground, record.clear
    for name in _KEPT:
        body.effect_state.pop(name, None)
    body.effect_state.update({name: np.array(value) for name, value in record.kept.items()})
    if bodies is not None:
        for name, pose in record.pushed.items():
            if (row := bodies.row_of(name, user=False)) >= 0:
                bodies.put(row, cast(Pose, np.array(pose)))
    verdict = world.collide(body.avatar, body.pose) if record.clear else Verdict.UNKNOWN
    return Moved(pose=body.pose[None].copy(), verdict=int(verdict), unknown=True)


class FrameLog:
    """Writer of a log; a context manager. Not thread-safe: a simulation calls it during a frame.

    After a failed write nothing more is written, and an error is logged. The scene is still served.
    frame: the frame that is written next.
    """

    def __init__(self, path: str | Path, head: LogHead) -> None:
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
        self._known: set[str] = set()
        self._clients: set[str] = set()  # whose users entered
        self.frame = LoggedFrame()
        self._write(MAGIC + _line(head))

    def __enter__(self) -> "FrameLog":
        """Return the log itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close the file."""
        self.close()

    def close(self) -> None:
        """Close the file. Later frames are not written."""
        file, self._file = self._file, None
        if file is not None:
            file.close()

    def entered(self, user: User, avatar: AvatarModel) -> None:
        """Record that a user enters with its next turn."""
        digest = avatar_digest(avatar.points, avatar.radius, avatar.inner_points).hex()
        if digest not in self._known:
            self._known.add(digest)
            added = AddAvatarRequest(user.avatar, avatar.points, avatar.radius, avatar.inner_points)
            self.frame.avatars[digest] = encode(added)
        self.frame.entered.append((user, digest))
        self._clients.add(user.client)

    def dropped(self, client: str) -> None:
        """Record that a client's avatars were dropped. A client none of whose users entered has none in a replay."""
        if client in self._clients:
            self._clients.remove(client)
            self.frame.dropped.append(client)

    def turn(
        self,
        turn: FrameCommand,
        state: State | SolidcloudError,
        body: Body | None,
        bodies: "Bodies | None",
        *,
        lacked: bool,
    ) -> None:
        """Record a turn and its result.

        body: of the user; None if it is not in the scene.  bodies: as for `take_record`.
        lacked: whether the frame lacked voxels.
        """
        record = (
            _record_of(body, bodies) if lacked and body is not None and isinstance(state, State) else None
        )
        opened = [] if body is None else list(body.generations)
        wish = msgspec.Raw(encode(turn.wish, JSON))
        self.frame.turns.append(LoggedTurn(turn.user, wish, *result_of(state), opened, record))

    def write(self, number: int) -> None:
        """Write the frame with what was recorded since the last one."""
        self.frame.number = number
        self._write(_line(self.frame))
        self.frame = LoggedFrame()

    def _write(self, data: bytes) -> None:
        """Append bytes."""
        if self._file is None:
            return
        try:
            while data:
                data = data[self._file.write(data) :]
        except OSError as error:
            log.error("%s: %s: later frames are not in the log", self._path, error.strerror)
            self.close()


def _line(record: LogHead | LoggedFrame) -> bytes:
    """Return the line of a record."""
    body = encode(record, JSON)
    return b"%08x %s\n" % (zlib.crc32(body), body)


def read_log(path: str | Path) -> tuple[LogHead, Iterator[LoggedFrame]]:
    """Return the head of a log, and its frames, which are read one by one.

    A frame that is cut off at the end is left out, with a warning. Raise FormatError if the file is not a
    log, CorruptError with the line that was altered.
    """
    records = _read_records(path)
    return next(records), records


def _read_records(path: str | Path) -> Iterator[Any]:
    """Yield the complete records of a log."""
    try:
        file = open(path, "rb")  # noqa: SIM115
    except OSError as error:
        raise FormatError(f"{path}: {error.strerror}: expected a log written by serve --log") from None
    with file:
        if file.readline(len(MAGIC)) != MAGIC:
            raise FormatError(f"{path}: does not begin with {MAGIC!r}: expected a log written by serve --log")
        kind: type = LogHead
        for number, line in enumerate(file, 2):
            if not line.endswith(b"\n"):
                log.warning("%s: line %d is cut off: only the frames before it are read", path, number)
                break
            stated, _, body = line[:-1].partition(b" ")
            found = b"%08x" % zlib.crc32(body)
            if found != stated:
                raise CorruptError(
                    f"{path}: line {number}: its checksum is {found!r}: expected {stated!r} as in an unaltered file"
                )
            try:
                record: Any = msgspec.json.decode(body, type=kind)
            except msgspec.DecodeError as error:
                raise CorruptError(f"{path}: line {number}: {error}: written by another version?") from None
            yield record
            kind = LoggedFrame
        if kind is LogHead:
            raise FormatError(f"{path}: cut off: expected a complete first record")
