"""A log's frames once more: the same wishes must give the same poses, bit for bit.

On another machine, too: kernels round as NUMERICS.md has it, and between them effects add and multiply in one order
(vectors.py). Only the probability of `uncertainty` is by the machine's own error function; no pose depends on it.
"""

from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ...schemas.errors import BadRequestError, ErrorCode, SolidcloudError
from ...schemas.wire.encoding import decode_request
from ...schemas.wire.key_expressions import User
from ...schemas.wire.motion_messages import Wish
from ..runtime.stop_flag import NO_STOP, StopFlag
from ..scene_interface import FrameCommand, ServedScene
from .replay_log import Begin, Dropped, Ended, Entered, Frame, FrameLog, Points, Record, Said, said
from .simulation import Simulation


class Difference(NamedTuple):
    """Where a replay differs from its log. logged, found: what came of the turn."""

    frame: int
    user: User
    logged: Said
    found: Said

    def __str__(self) -> str:
        """One line."""
        where = f"frame {self.frame}, avatar {self.user.avatar} of client {self.user.client}"
        if self.logged.error or self.found.error:
            return f"{where}: logged {_words(self.logged)}, replayed {_words(self.found)}"
        logged, found = np.frombuffer(self.logged.pose), np.frombuffer(self.found.pose)
        at = int(np.flatnonzero(logged.view(np.int64) != found.view(np.int64))[0])
        return (
            f"{where}: pose[{at // 4}, {at % 4}] logged {float(logged[at])!r}, replayed {float(found[at])!r}"
        )


class Replayed(NamedTuple):
    """What a replay found. frames, turns: run again.  different: turns that came out otherwise; first: of them.

    reloaded: the frame that the replay ends before, since the log's scene had been reloaded; None: it was not.
    """

    frames: int
    turns: int
    different: int
    first: Difference | None
    reloaded: int | None


def replay(simulation: Simulation, records: Iterable[Record]) -> Replayed:
    """Run the frames of a log, on a simulation of the same scene that nobody walked yet.

    Each frame skips the effects that the log says it skipped: why it did was a matter of time. The replay ends where
    the log's scene was reloaded. Raises what reading the records raises, and BadRequestError for a log whose avatars
    are not those of the scene.
    """
    bodies = _Bodies(simulation)
    opened: list[int] | None = None
    frames = turns = different = 0
    first: Difference | None = None
    for record in records:
        if isinstance(record, Points):
            bodies.known[record.digest] = record
        elif isinstance(record, Entered):
            bodies.enter(record)
        elif isinstance(record, Dropped):
            bodies.drop(record.client)
        elif isinstance(record, Ended):
            for user in record.users:
                simulation.end(user)
        elif isinstance(record, Frame):
            for logged in record.said:
                opened = opened or logged.opened
                if logged.opened not in ([], opened):
                    return Replayed(frames, turns, different, first, record.number)
            frames, turns = frames + 1, turns + len(record.turns)
            for difference in _differences(simulation, record):
                different, first = different + 1, first or difference
    return Replayed(frames, turns, different, first, None)


def _differences(simulation: Simulation, record: Frame) -> list[Difference]:
    """Run one frame; what comes out otherwise."""
    wished = [FrameCommand(User(*user), decode_request(Wish, wish)) for user, wish in record.turns]
    # A turn that the server ended early depended on a clock: it is ended again, and moves nobody.
    ended = StopFlag()
    ended.set("ended early when it was logged")
    stops = [ended if logged.error == ErrorCode.EXPIRED else NO_STOP for logged in record.said]
    outcomes = simulation.step(wished, skips=[logged.skipped for logged in record.said], stops=stops)
    return [
        Difference(record.number, outcome.user, logged, found)
        for outcome, logged in zip(outcomes, record.said, strict=True)
        if ((found := said(outcome)).pose, found.error) != (logged.pose, logged.error)
    ]


class _Bodies:
    """The avatars of a log, put into a scene as users come in with them."""

    def __init__(self, simulation: Simulation) -> None:
        self._simulation = simulation
        self.known: dict[bytes, Points] = {}
        self._added: dict[User, bytes] = {}

    def enter(self, entered: Entered) -> None:
        """Have an avatar known before its user's first turn."""
        user = User(*entered.user)
        if self._added.get(user, entered.digest) != entered.digest:
            # The client went and came again with another avatar of that name, all others of it too.
            self.drop(user.client)
        if user not in self._added:
            record = self.known.get(entered.digest)
            if record is None:
                raise BadRequestError(f"avatar {user.avatar!r} of the log: its points are not in it")
            points = np.frombuffer(record.points, "<f8").reshape(-1, 3)
            try:
                self._simulation.scene.add_avatar(user.avatar, points, record.radius, client=user.client)
            except SolidcloudError as error:
                raise BadRequestError(f"the log is of another scene: {error}") from None
            self._added[user] = entered.digest

    def drop(self, client: str) -> None:
        """Forget the avatars of a client."""
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
    """What a log of a scene begins with. path: of its archive or scene file."""
    file = path.read_bytes() if path.is_file() else b""
    return Begin(simulation.scene.name, str(path.resolve()), file, archives_of(simulation))


@contextmanager
def recorded(scene: ServedScene, path: Path, log: Path) -> Iterator[None]:
    """Log the frames of a scene to a new file while inside. path: of its archive or scene file. BadRequestError."""
    simulation: Any = scene.simulation
    with FrameLog(log, begin_of(simulation, path)) as frames:
        simulation.record(frames)
        try:
            yield
        finally:
            simulation.record(None)


def check_same(begin: Begin, simulation: Simulation, path: Path) -> bool:
    """Whether a scene's file is that which the log began with. BadRequestError unless its archives are.

    path: of the archive or scene file.
    """
    found = archives_of(simulation)
    if [tuple(each) for each in begin.archives] != found:
        raise BadRequestError(
            f"{path}: holds {_archives(found)}: expected {_archives(begin.archives)}, which the log is of "
            f"({begin.path})"
        )
    return begin.file == (path.read_bytes() if path.is_file() else b"")


def _archives(archives: Sequence[tuple[str, int]]) -> str:
    """Archives in words."""
    return " and ".join(f"archive {name[:8]} of generation {generation}" for name, generation in archives)


def _words(said: Said) -> str:
    """What came of a turn, for people."""
    if said.error:
        return f"error {said.error}"
    x, y, z = np.frombuffer(said.pose, "<f8").reshape(4, 4)[:3, 3].tolist()
    return f"a pose at {x:g} {y:g} {z:g}"
