"""Session in this process: it takes motion commands for one avatar and returns the states.

It has the methods of the session that `Client.session` returns. Each command is simulated as a
separate frame before `wish` returns, so its state is available at once.
"""

import threading
from collections import deque
from collections.abc import Iterator, Mapping
from time import monotonic
from typing import Any, Self

from ...schemas.errors import BadRequestError, BusyError, SolidcloudError
from ...schemas.wire.key_expressions import User
from ...schemas.wire.motion_messages import Late, State, Wish, motion_fields, object_poses
from ..scene_interface import FrameCommand, LatestState
from .simulation import Simulation

# Maximum number of states kept for `states`; of more, the oldest are dropped.
_MAX_STATES = 1024


class LocalSession:
    """One avatar's session, made by `Scene.session`. A context manager, thread-safe."""

    def __init__(self, simulation: Simulation, user: User, late: Late = "wait") -> None:
        """Create a session; entering it begins it. late: of its motion commands, as in `Wish`."""
        self._simulation, self._user, self._late = simulation, user, late
        self._commands = threading.Lock()  # held for a frame, so that states come in the order of commands
        self._changed = threading.Condition()
        self._states: deque[State | SolidcloudError] = deque(maxlen=_MAX_STATES)
        self._latest: State | None = None
        self._error: SolidcloudError | None = None  # newer than `_latest`
        self._when = 0.0
        self._seq = 0
        self._open = False

    def __enter__(self) -> Self:
        """Begin the session."""
        self._open = True
        return self

    def __exit__(self, *_: object) -> None:
        """Leave the scene."""
        self.close()

    def __repr__(self) -> str:
        """Return the avatar, the scene, and whether the session is open, in one line."""
        latest, begun = self._latest, "open" if self._open else "closed"
        state = "no state yet" if latest is None else f"{latest!r}, {monotonic() - self._when:.2g} s ago"
        return f"<Session of {self._user.avatar!r} in {self._simulation.scene.name!r}: {begun}, {state}>"

    def close(self) -> None:
        """Leave the scene: others may walk where the avatar stood. Closing twice is allowed."""
        with self._commands:
            was_open, self._open = self._open, False
            if was_open:
                self._simulation.end(self._user)
        with self._changed:
            self._changed.notify_all()

    def wish(
        self,
        pose: Any = None,
        velocity: Any = None,
        turn: float = 0.0,
        *,
        objects: Mapping[str, Any] | None = None,
        time: float | None = None,
    ) -> int:
        """Simulate one frame with a motion command: either a pose or a velocity.

        pose: (4, 4) or (1, 4, 4) float64.  velocity: (3,) [m/s].  turn: with a velocity, about the
        scene's up axis [rad/s].  objects: poses of the scene's objects that this user moves, by
        name.
        time: of the command, on a clock that does not go backwards [s]; None: this process's clock.
        Return the number of the command, which its state has as `seq`. Raise BadRequestError for an
        invalid command, or if the session is closed. If the frame is refused, `latest`, `wait` and
        `states` raise its error.
        """
        poses, speed = motion_fields(pose, velocity)
        moved = object_poses(objects)
        with self._commands:
            if not self._open:
                raise BadRequestError(
                    "this session is closed: wish inside `with scene.session(...) as session`"
                )
            now = monotonic()
            wish = Wish(
                seq=self._seq + 1,
                time=now if time is None else float(time),
                pose=poses,
                velocity=speed,
                turn=float(turn),
                objects=moved,
                late=self._late,
            )
            self._seq = wish.seq
            (outcome,) = self._simulation.step([FrameCommand(self._user, wish)], now)
            self._keep(outcome.state)
        return wish.seq

    def _keep(self, said: State | SolidcloudError) -> None:
        """Store the result of a frame for `latest`, `wait` and `states`."""
        with self._changed:
            if isinstance(said, SolidcloudError):
                self._error = said
            else:
                self._latest, self._error, self._when = said, None, monotonic()
            self._states.append(said)
            self._changed.notify_all()

    def _raise_error(self) -> None:
        """Raise, once, the error of a frame refused since the last state.

        The caller holds `_changed`.
        """
        error, self._error = self._error, None
        if error is not None:
            raise error

    def latest(self) -> LatestState | None:
        """Return the last state, with its age, or None before the first one.

        Raise, once, the error of a frame refused since then.
        """
        with self._changed:
            self._raise_error()
            return None if self._latest is None else LatestState.of(self._latest, monotonic() - self._when)

    def wait(self, seq: int, timeout: float = 5.0) -> State:
        """Return the state of a command, or of a newer one.

        Raises BusyError if none came within `timeout` [s], and, once, the error of a frame refused
        since the last state.
        """

        def reached() -> bool:
            return self._latest is not None and self._latest.seq >= seq

        with self._changed:
            self._changed.wait_for(lambda: bool(self._error) or not self._open or reached(), timeout)
            self._raise_error()
            if self._latest is None or self._latest.seq < seq:
                raise BusyError(f"no state of wish {seq} of avatar {self._user.avatar!r} in {timeout:g} s")
            return self._latest

    def states(self, timeout: float = 5.0) -> Iterator[State]:
        """Yield each state in order, until none came for `timeout` [s] or the session is closed.

        At most 1,024 states are kept; of more, the oldest are dropped. Raises the error of a
        refused frame at its place among them.
        """
        while True:
            with self._changed:
                self._changed.wait_for(lambda: bool(self._states) or not self._open, timeout)
                if not self._states:
                    return
                said = self._states.popleft()
            if isinstance(said, SolidcloudError):
                raise said
            yield said
