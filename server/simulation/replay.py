"""Replay of a log: the same motion commands must give the same poses, bit for bit.

This also holds on another machine: kernels round as NUMERICS.md states, and effects add and
multiply in a fixed order (world/frame.py). Only the probability of `uncertainty` depends on the
machine's own error function, and no pose depends on it.
"""

from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ...schemas.errors import BadRequestError, SolidcloudError
from ...schemas.scene.effect_table import MOTION_VERSION
from ...schemas.wire.answers import Verdict
from ...schemas.wire.encoding import JSON, decode_request
from ...schemas.wire.key_expressions import User
from ...schemas.wire.motion_messages import Wish
from ...schemas.wire.requests import AddAvatarRequest
from ..scene_interface import AvatarShape, FrameCommand, FrameResult, ServedScene
from .replay_log import FrameLog, LoggedFrame, LoggedTurn, LogHead, Rows, result_of
from .simulation import Simulation


@dataclass
class Replayed:
    """Result of a replay.

    frames, turns: numbers of simulated frames and turns (motion commands of one user).
    different: number of turns whose result differs.  first: description of the first such turn.
    reloaded: the frame before which the replay ended, because the log's scene was reloaded there;
    None if it was not.
    taken: number of turns whose result was taken from the log, because it depended on voxels that
    were not in memory. Such a turn is different if its pose was logged as clear and touches the
    scan.
    """

    frames: int = 0
    turns: int = 0
    different: int = 0
    first: str | None = None
    reloaded: int | None = None
    taken: int = 0


def replay(simulation: Simulation, frames: Iterable[LoggedFrame]) -> Replayed:
    """Simulate the frames of a log, with a new simulation of the same scene.

    A result that depended on voxels not in memory is taken from the log (`BodyRecord`). The
    replay ends where the log's scene was reloaded. Raises the errors of reading the frames, and
    BadRequestError for a log whose avatars are not those of the scene.
    """
    avatars, found = _LoggedAvatars(simulation), Replayed()
    opened: list[int] | None = None
    for frame in frames:
        for logged in frame.turns:
            opened = opened or logged.opened
            if logged.opened not in ([], opened):
                found.reloaded = frame.number
                return found
        for user in frame.ended:
            simulation.end(user)
        for client in frame.dropped:
            avatars.drop(client)
        avatars.known.update(frame.avatars)
        for user, digest in frame.entered:
            avatars.enter(user, digest)
        turns = [
            FrameCommand(each.user, decode_request(Wish, bytes(each.wish), JSON)) for each in frame.turns
        ]
        outcomes = simulation.step(turns, logged=frame.turns)
        found.frames, found.turns = found.frames + 1, found.turns + len(turns)
        found.taken += sum(logged.body is not None for logged in frame.turns)
        for logged, outcome in zip(frame.turns, outcomes, strict=True):
            if said := _difference(logged, outcome):
                found.different += 1
                user = logged.user
                where = f"frame {frame.number}, avatar {user.avatar} of client {user.client}"
                found.first = found.first or f"{where}: {said}"
    return found


def _difference(logged: LoggedTurn, outcome: FrameResult) -> str:
    """Return how the result of a turn differs from the log; "" if it does not."""
    pose, error = result_of(outcome.state)
    if error or logged.error:
        same = error == logged.error
        return (
            ""
            if same
            else f"logged {_describe(logged.pose, logged.error)}, replayed {_describe(pose, error)}"
        )
    before, now = np.ravel(np.array(logged.pose)), np.ravel(np.array(pose))
    if (differ := np.flatnonzero(before.view(np.int64) != now.view(np.int64))).size:
        at = int(differ[0])
        return f"pose[{at // 4}, {at % 4}] logged {float(before[at])!r}, replayed {float(now[at])!r}"
    if logged.body is not None and getattr(outcome.state, "verdict", None) == Verdict.CONTACT:
        return "the pose, logged as clear with voxels not in memory, touches the scan"
    return ""


def _describe(pose: Rows | None, error: str) -> str:
    if pose is None:
        return f"error {error}"
    x, y, z = (row[3] for row in pose[:3])
    return f"a pose at {x:g} {y:g} {z:g}"


class _LoggedAvatars:
    """Avatars of a log, added to the scene when their users enter. known: encoded, by digest."""

    def __init__(self, simulation: Simulation) -> None:
        self._simulation = simulation
        self.known: dict[str, bytes] = {}
        self._added: dict[User, str] = {}

    def enter(self, user: User, digest: str) -> None:
        """Add an avatar before its user's first turn."""
        if self._added.get(user, digest) != digest:
            # The client reconnected with another avatar of that name, so its other avatars were
            # dropped too.
            self.drop(user.client)
        if user in self._added:
            return
        if digest not in self.known:
            raise BadRequestError(
                f"avatar {user.avatar!r}: its points are not in the log: record the log anew"
            )
        added = decode_request(AddAvatarRequest, self.known[digest])
        shape = AvatarShape(added.points, added.radius, added.inner_points)
        try:
            self._simulation.scene.add_avatar(user.avatar, shape, client=user.client)
        except SolidcloudError as error:
            raise BadRequestError(f"the log is of another scene: {error}") from None
        self._added[user] = digest

    def drop(self, client: str) -> None:
        """Drop the avatars of a client."""
        self._simulation.drop_client(client)
        self._added = {user: digest for user, digest in self._added.items() if user.client != client}


def _archives_of(simulation: Simulation) -> list[tuple[str, int]]:
    """Return the id, hexadecimal, and the generation of each archive of a scene."""
    found = []
    for archive in simulation.scene.archives:
        with archive.take() as opened:
            header = opened.store.archive.header
            found.append((header.archive_id.hex(), header.generation))
    return found


def _scene_file(path: Path) -> bytes:
    """Return the bytes of a scene file; empty for an archive."""
    return path.read_bytes() if path.is_file() else b""


@contextmanager
def recorded(scene: ServedScene, path: Path, log: Path) -> Iterator[None]:
    """Log the frames of a scene to a new file during the block.

    path: of its archive or scene file. Raises BadRequestError.
    """
    simulation: Any = scene.simulation
    head = LogHead(
        scene.name, str(path.resolve()), _scene_file(path), _archives_of(simulation), MOTION_VERSION
    )
    with FrameLog(log, head) as frames:
        simulation.record(frames)
        try:
            yield
        finally:
            simulation.record(None)


def check_same(head: LogHead, simulation: Simulation, path: Path) -> bool:
    """Return whether a scene's file is that of the log.

    path: of the archive or scene file. Raises BadRequestError for other archives, or other rules of
    motion, which would give other poses.
    """
    if head.motion != MOTION_VERSION:
        raise BadRequestError(
            f"the log was recorded under version {head.motion} of the rules of motion: expected "
            f"{MOTION_VERSION}: replay it with the version of solidcloud that recorded it"
        )
    found = _archives_of(simulation)
    if head.archives != found:
        raise BadRequestError(
            f"{path}: has {_describe_archives(found)}: expected {_describe_archives(head.archives)}, of which "
            f"the log is ({head.path})"
        )
    return head.file == _scene_file(path)


def _describe_archives(archives: Sequence[tuple[str, int]]) -> str:
    return " and ".join(f"archive {name[:8]} of generation {generation}" for name, generation in archives)
