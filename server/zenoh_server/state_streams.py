"""Streams of users' states: one long query a user, answered with many replies.

A state is sent only to the client that queried for it. A subscription could not be restricted to
one client: a wildcard matches every client's key and would reveal the ids in them.
"""

import threading
import time
from collections import OrderedDict
from collections.abc import Callable

import zenoh

from ...schemas.wire.key_expressions import User
from ..scene_interface import EncodedReply
from ..zenoh_common.sealed_replies import Sealer, send_reply

# A query without a reply for this long may be ended to make room for another one [s].
IDLE_SECONDS = 60.0
# How long a state is kept for a query that has not arrived [s]. A user's first motion command may
# overtake its query.
_KEPT_SECONDS = 5.0


class _Stream:
    """One open query.

    used: time of its opening or last reply, on the monotonic clock [s].  number: replies so far.
    last: the last answer sent.
    """

    __slots__ = ("_key", "_sealer", "last", "number", "query", "used")

    def __init__(self, query: zenoh.Query, sealer: Sealer | None) -> None:
        self.query, self._key, self._sealer = query, query.key_expr, sealer
        self.used = time.monotonic()
        self.number = 0
        self.last: EncodedReply | None = None

    def reply(self, answer: EncodedReply) -> bool:
        """Send one reply; return False if the client has disconnected."""
        self.last = answer
        sent = send_reply(self.query, self._key, answer, self._sealer, self.number)
        self.number += 1
        return sent


class StateStreams:
    """Open queries of one scene. Thread-safe; no method blocks: states are dropped, not queued."""

    def __init__(self, most: int, turn: Callable[[str], str] = str) -> None:
        """Begin without open queries.

        most: queries that are open at a time; one turn has at most half of them.
        turn: returns the turn of a client (fair_queues.py); by default each has its own.
        """
        self._most, self._turn = most, turn
        self._streams: OrderedDict[User, _Stream] = OrderedDict()  # the most recently used last
        self._kept: OrderedDict[User, tuple[float, EncodedReply]] = OrderedDict()
        self._closed = False
        self._lock = threading.Lock()

    def open(self, user: User, query: zenoh.Query, sealer: Sealer | None) -> bool:
        """Send the user's states as replies to this query, and end an earlier query of the user.

        Return False if there is no room; the caller must then answer the query.
        """
        with self._lock:
            if self._closed or not self._make_room(user):
                return False
            before = self._end(user)
            self._streams[user] = stream = _Stream(query, sealer)
            stream.last = None if before is None else before.last
            when, answer = self._kept.pop(user, (0.0, None))
            if answer is not None and time.monotonic() - when < _KEPT_SECONDS:
                stream.reply(answer)
        return True

    def send(self, user: User, answer: EncodedReply) -> None:
        """Send an answer to a user; without an open query, keep it for a short time."""
        with self._lock:
            stream = self._streams.get(user)
            if stream is None:
                self._keep(user, answer)
                return
            stream.used = time.monotonic()
            self._streams.move_to_end(user)
            if not stream.reply(answer):
                self._end(user)

    def send_again(self, user: User) -> None:
        """Send the last answer to a user again, because it may have been dropped on the way."""
        with self._lock:
            stream = self._streams.get(user)
            if stream is not None and stream.last is not None and not stream.reply(stream.last):
                self._end(user)

    def forget(self, user: User) -> None:
        """Forget the last answer to a user that left."""
        with self._lock:
            if (stream := self._streams.get(user)) is not None:
                stream.last = None

    def users(self) -> list[User]:
        """Return the users with an open query."""
        with self._lock:
            return list(self._streams)

    def end(self, user: User) -> None:
        """End the query of a user."""
        with self._lock:
            self._end(user)

    def end_client(self, client: str) -> None:
        """End the queries of a disconnected client."""
        with self._lock:
            for user in [user for user in self._streams if user.client == client]:
                self._end(user)

    def close(self) -> None:
        """End all queries; no more are opened."""
        with self._lock:
            self._closed = True
            for user in list(self._streams):
                self._end(user)

    def _make_room(self, user: User) -> bool:
        """Make room for a query: end the oldest of its turn, then an idle one; return success."""
        if user in self._streams:
            return True
        turn = self._turn(user.client)
        own = [other for other in self._streams if self._turn(other.client) == turn]
        if len(own) >= max(1, self._most // 2):
            self._end(own[0])
        if len(self._streams) >= self._most:
            oldest, stream = next(iter(self._streams.items()))
            if time.monotonic() - stream.used < IDLE_SECONDS:
                return False
            self._end(oldest)
        return True

    def _keep(self, user: User, answer: EncodedReply) -> None:
        self._kept.pop(user, None)
        self._kept[user] = (time.monotonic(), answer)
        if len(self._kept) > self._most:
            self._kept.popitem(last=False)

    def _end(self, user: User) -> _Stream | None:
        """Tell a client that no more replies come to its query; return its stream."""
        stream = self._streams.pop(user, None)
        if stream is not None:
            stream.query.drop()
        return stream
