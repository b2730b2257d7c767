"""Queues of received motion commands, not yet decoded: round-robin, bounded in bytes."""

from collections import OrderedDict, deque
from collections.abc import Callable
from typing import Any

from ...schemas.wire.key_expressions import User

# Limits of one turn and of all turns [bytes]. Beyond them, the oldest motion commands of a turn are
# dropped, except its last one.
_MOST_BYTES_A_TURN, _MOST_BYTES = 1 << 20, 16 << 20
# Size of a motion command without its payload [bytes].
_OVERHEAD = 256

_Wish = tuple[User, Any, int]


class WaitingCommands:
    """Queue of motion commands for each turn. Not thread-safe.

    If a turn exceeds its bytes, its oldest motion commands are dropped: newer ones replace them
    anyway.
    """

    def __init__(self, turn: Callable[[str], str]) -> None:
        """Begin empty. turn: returns the turn of a client (fair_queues.py)."""
        self._turn = turn
        self._queues: OrderedDict[str, deque[_Wish]] = OrderedDict()  # the next turn first
        self._sizes: dict[str, int] = {}
        self._size = 0

    def put(self, user: User, wish: Any, size: int) -> None:
        """Add a motion command. size: of its payload [bytes]."""
        turn = self._turn(user.client)
        self._queues.setdefault(turn, deque()).append((user, wish, size + _OVERHEAD))
        self._count(turn, size + _OVERHEAD)
        queue = self._queues[turn]
        while len(queue) > 1 and (self._sizes[turn] > _MOST_BYTES_A_TURN or self._size > _MOST_BYTES):
            self._count(turn, -queue.popleft()[2])

    def take(self) -> tuple[User, Any] | None:
        """Remove and return the next motion command with its user; None if there is none."""
        if not self._queues:
            return None
        turn, queue = self._queues.popitem(last=False)
        user, wish, size = queue.popleft()
        self._count(turn, -size)
        if queue:
            self._queues[turn] = queue
        else:
            del self._sizes[turn]
        return user, wish

    def _count(self, turn: str, size: int) -> None:
        """Add `size` bytes to the counts."""
        self._sizes[turn] = self._sizes.get(turn, 0) + size
        self._size += size
