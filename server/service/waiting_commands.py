"""Wishes that came and were not read yet: clients in turn, each bounded in bytes. No zenoh here."""

from collections import OrderedDict, deque
from collections.abc import Callable
from typing import Any

from ...schemas.wire.keys import User

# Of one turn, and of all together [bytes]: beyond it a turn's oldest ones are dropped. A turn may always have one.
_MOST_BYTES_A_TURN, _MOST_BYTES = 1 << 20, 16 << 20
# What a wish takes beside its payload [bytes].
_OVERHEAD = 256

_Wish = tuple[User, Any, int]


class WaitingWishes:
    """A queue for each turn. Not thread-safe.

    Where a turn has more bytes than it may, its oldest wishes are dropped: a newer one replaces them anyway.
    """

    def __init__(self, turn: Callable[[str], str]) -> None:
        """turn: returns the turn of a client (liveliness_tokens.py)."""
        self._turn = turn
        self._queues: OrderedDict[str, deque[_Wish]] = OrderedDict()  # the turn that is next comes first
        self._sizes: dict[str, int] = {}
        self._size = 0

    def put(self, user: User, wish: Any, size: int) -> None:
        """Take a wish in. size: of its payload [bytes]."""
        turn = self._turn(user.client)
        self._queues.setdefault(turn, deque()).append((user, wish, size + _OVERHEAD))
        self._count(turn, size + _OVERHEAD)
        queue = self._queues[turn]
        while len(queue) > 1 and (self._sizes[turn] > _MOST_BYTES_A_TURN or self._size > _MOST_BYTES):
            self._count(turn, -queue.popleft()[2])

    def take(self) -> tuple[User, Any] | None:
        """Return the next wish, and whose it is; None where there is none."""
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
        """Count so many bytes more."""
        self._sizes[turn] = self._sizes.get(turn, 0) + size
        self._size += size
