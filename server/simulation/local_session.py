"""Session in this process: it takes motion commands for one avatar and returns the states.

It has the methods of the session that `Client.session` returns. Each command is simulated as a
separate frame before `wish` returns, so its state is available at once.
"""

from time import monotonic
from typing import Self

from ...schemas.wire.key_expressions import User
from ...schemas.wire.motion_messages import Late, Wish
from ..scene_interface import FrameCommand, Session
from .simulation import Simulation


class LocalSession(Session):
    """One avatar's session, made by `Scene.session`. A context manager, thread-safe."""

    def __init__(self, simulation: Simulation, user: User, late: Late = "wait") -> None:
        """Create a session; entering it begins it. late: of its motion commands, as in `Wish`."""
        super().__init__(simulation.scene.name, user.avatar, late)
        self._simulation, self._user, self._seq = simulation, user, 0

    def __enter__(self) -> Self:
        """Begin the session."""
        self._open = True
        return self

    def __exit__(self, *_: object) -> None:
        """Leave the scene."""
        self.close()

    def close(self) -> None:
        """Leave the scene: others may walk where the avatar stood. Closing twice is allowed."""
        with self._commands:
            was_open, self._open = self._open, False
            if was_open:
                self._simulation.end(self._user)
        with self._changed:
            self._changed.notify_all()

    def _next_number(self) -> int:
        self._seq += 1
        return self._seq

    def _send(self, wish: Wish) -> None:
        """Simulate a frame with a motion command."""
        (outcome,) = self._simulation.step([FrameCommand(self._user, wish)], monotonic())
        self._keep(outcome.state)
