"""Replay of a log: the same motion commands must give the same poses, bit for bit.

This also holds on another machine: kernels round as NUMERICS.md states, and effects add and
multiply in a fixed order (vectors.py). Only the probability of `uncertainty` depends on the
machine's own error function, and no pose depends on it.
"""

from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ...schemas.errors import BadRequestError, ErrorCode, SolidcloudError
from ...schemas.scene.effect_table import MOTION_VERSION
from ...schemas.wire.answers import Verdict
from ...schemas.wire.encoding import decode_request
from ...schemas.wire.key_expressions import User
from ...schemas.wire.motion_messages import Wish
from ..runtime.stop_flag import NO_STOP, StopFlag
from ..scene_interface import AvatarShape, FrameCommand, ServedScene
from .replay_log import (
    AvatarPoints,
    Begin,
    Dropped,
    Ended,
    Entered,
    FrameLog,
    FrameRecord,
    Record,
    TurnResult,
    turn_result,
)
from .simulation import Simulation


class TurnDifference(NamedTuple):
    """Motion command whose replay differs from the log. logged, found: its results."""

    frame: int
    user: User
    logged: TurnResult
    found: TurnResult

    def __str__(self) -> str:
        """Return a description of one line."""
        where = f"frame {self.frame}, avatar {self.user.avatar} of client {self.user.client}"
        if self.logged.error or self.found.error:
            return f"{where}: logged {_describe(self.logged)}, replayed {_describe(self.found)}"
        logged, found = np.frombuffer(self.logged.pose), np.frombuffer(self.found.pose)
        if self.logged.pose == self.found.pose:
            return f"{where}: the pose, logged as clear with voxels not in memory, touches the scan"
        at = int(np.flatnonzero(logged.view(np.int64) != found.view(np.int64))[0])
        return (
            f"{where}: pose[{at // 4}, {at % 4}] logged {float(logged[at])!r}, replayed {float(found[at])!r}"
        )


class Replayed(NamedTuple):
    """Result of a replay.

    frames, turns: numbers of simulated frames and turns (motion commands of one user).
    different: number of turns whose result differs.  first: the first such turn.
    reloaded: the frame before which the replay ended, because the log's scene was reloaded there;
    None if it was not.
    taken: number of turns whose result was taken from the log, because it depended on voxels that
    were not in memory. Such a turn is different if its pose was logged as clear and touches the
    scan.
    """

    frames: int
    turns: int
    different: int
    first: TurnDifference | None
    reloaded: int | None
    taken: int = 0


def replay(simulation: Simulation, records: Iterable[Record]) -> Replayed:
    """Simulate the frames of a log, with a new simulation of the same scene.

    A result that depended on voxels not in memory is taken from the log (`BodyRecord`). The
    replay ends where the log's scene was reloaded. Raises the errors of reading the records, and
    BadRequestError for a log of other rules of motion, or whose avatars are not those of the scene.
    """
    avatars = _LoggedAvatars(simulation)
    opened: list[int] | None = None
    frames = turns = different = taken = 0
    first: TurnDifference | None = None
    for record in records:
        if isinstance(record, Begin):
            check_motion(record)
        elif isinstance(record, AvatarPoints):
            avatars.known[record.digest] = record
        elif isinstance(record, Entered):
            avatars.enter(record)
        elif isinstance(record, Dropped):
            avatars.drop(record.client)
        elif isinstance(record, Ended):
            for user in record.users:
                simulation.end(user)
        elif isinstance(record, FrameRecord):
            for logged in record.said:
                opened = opened or logged.opened
                if logged.opened not in ([], opened):
                    return Replayed(frames, turns, different, first, record.number, taken)
            taken += sum(logged.kept is not None for logged in record.said)
            frames, turns = frames + 1, turns + len(record.turns)
            for difference in _differences(simulation, record):
                different, first = different + 1, first or difference
    return Replayed(frames, turns, different, first, None, taken)


def _differences(simulation: Simulation, record: FrameRecord) -> list[TurnDifference]:
    """Simulate one frame; return the turns with another result."""
    turns = [FrameCommand(User(*user), decode_request(Wish, wish)) for user, wish in record.turns]
    # A turn that the server stopped early depended on a clock. It is stopped here too, and moves no
    # user.
    ended = StopFlag()
    ended.set("ended early when it was logged")
    stops = [ended if logged.error == ErrorCode.EXPIRED else NO_STOP for logged in record.said]
    kept = [logged.kept for logged in record.said]
    outcomes = simulation.step(turns, stops=stops, kept=kept)
    return [
        TurnDifference(record.number, outcome.user, logged, found)
        for outcome, logged in zip(outcomes, record.said, strict=True)
        if ((found := turn_result(outcome)).pose, found.error) != (logged.pose, logged.error)
        or (logged.kept is not None and getattr(outcome.state, "verdict", None) == Verdict.CONTACT)
    ]


class _LoggedAvatars:
    """Avatars of a log, added to the scene when their users enter."""

    def __init__(self, simulation: Simulation) -> None:
        self._simulation = simulation
        self.known: dict[bytes, AvatarPoints] = {}
        self._added: dict[User, bytes] = {}

    def enter(self, entered: Entered) -> None:
        """Add an avatar before its user's first turn."""
        user = User(*entered.user)
        if self._added.get(user, entered.digest) != entered.digest:
            # The client reconnected with another avatar of that name, so its other avatars were
            # dropped too.
            self.drop(user.client)
        if user not in self._added:
            record = self.known.get(entered.digest)
            if record is None:
                raise BadRequestError(
                    f"avatar {user.avatar!r}: its points are not in the log: record the log anew"
                )
            points = np.frombuffer(record.points, "<f8").reshape(-1, 3)
            try:
                shape = AvatarShape(points, record.radius, record.inner_points)
                self._simulation.scene.add_avatar(user.avatar, shape, client=user.client)
            except SolidcloudError as error:
                raise BadRequestError(f"the log is of another scene: {error}") from None
            self._added[user] = entered.digest

    def drop(self, client: str) -> None:
        """Drop the avatars of a client."""
        self._simulation.drop_client(client)
        for user in [user for user in self._added if user.client == client]:
            del self._added[user]


def archives_of(simulation: Simulation) -> list[tuple[str, int]]:
    """Return the id, hexadecimal, and the generation of each archive of a scene."""
    found = []
    for archive in simulation.scene.archives:
        with archive.take() as opened:
            header = opened.store.archive.header
            found.append((header.archive_id.hex(), header.generation))
    return found


def begin_of(simulation: Simulation, path: Path) -> Begin:
    """Return the first record of a scene's log. path: of its archive or scene file."""
    file = path.read_bytes() if path.is_file() else b""
    archives = archives_of(simulation)
    return Begin(simulation.scene.name, str(path.resolve()), file, archives, MOTION_VERSION)


@contextmanager
def recorded(scene: ServedScene, path: Path, log: Path) -> Iterator[None]:
    """Log the frames of a scene to a new file during the block.

    path: of its archive or scene file. Raises BadRequestError.
    """
    simulation: Any = scene.simulation
    with FrameLog(log, begin_of(simulation, path)) as frames:
        simulation.record(frames)
        try:
            yield
        finally:
            simulation.record(None)


def check_motion(begin: Begin) -> None:
    """Raise BadRequestError if a log is of other rules of motion: it would give other poses."""
    if begin.motion != MOTION_VERSION:
        raise BadRequestError(
            f"the log was recorded under version {begin.motion} of the rules of motion: expected "
            f"{MOTION_VERSION}: replay it with the version of solidcloud that recorded it"
        )


def check_same(begin: Begin, simulation: Simulation, path: Path) -> bool:
    """Return whether a scene's file is that of the log.

    path: of the archive or scene file. Raises BadRequestError for other archives, or other rules of
    motion.
    """
    check_motion(begin)
    found = archives_of(simulation)
    if [tuple(each) for each in begin.archives] != found:
        raise BadRequestError(
            f"{path}: has {_describe_archives(found)}: expected {_describe_archives(begin.archives)}, of which "
            f"the log is ({begin.path})"
        )
    return begin.file == (path.read_bytes() if path.is_file() else b"")


def _describe_archives(archives: Sequence[tuple[str, int]]) -> str:
    """Describe archives."""
    return " and ".join(f"archive {name[:8]} of generation {generation}" for name, generation in archives)


def _describe(result: TurnResult) -> str:
    """Describe the result of a turn."""
    if result.error:
        return f"error {result.error}"
    x, y, z = np.frombuffer(result.pose, "<f8").reshape(4, 4)[:3, 3].tolist()
    return f"a pose at {x:g} {y:g} {z:g}"
