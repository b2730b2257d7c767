"""Query for the states of one user: one long query with many replies, sent again when it ends."""

import logging
import queue
from collections.abc import Callable
from time import monotonic
from typing import Any, TypeVar

import zenoh

from ...schemas.errors import SolidcloudError, error_from_code
from ...schemas.wire.encoding import MSGPACK, decode_answer
from ...schemas.wire.scene_messages import ErrorReply
from ..zenoh_common.sealed_replies import OtherAvatarError, SealedQuery, TrustAnchor

log = logging.getLogger(__name__)

# Content of a reply: (True, payload) of a state, (False, payload) of an error.
Reply = tuple[bool, bytes] | OtherAvatarError
Answer = TypeVar("Answer")

# If motion commands are sent and no reply arrives for this long, the query is sent again [s].
_SILENCE = 1.0
# First and longest pause before a query that ended without replies is sent again [s].
_PAUSE, _MAX_PAUSE = 0.01, 0.2
# How long one query is kept open [s].
_QUERY_SECONDS = 3600.0


class StateQuery:
    """The query for one user's states. One thread calls `take`; another may call `end`.

    sent: when it was sent last, on the monotonic clock [s].
    """

    def __init__(
        self, session: zenoh.Session, key: str, anchor: TrustAnchor, about: Callable[[], bytes | None]
    ) -> None:
        """Make a query that is not sent yet.

        key: key expression of the user's states.  about: as in `SealedQuery`.
        """
        self._session, self._key, self._anchor, self._about = session, key, anchor, about
        # Unbounded: replies are taken at once, except while an avatar is added again.
        self._arrived: queue.SimpleQueue[tuple[SealedQuery, Any] | None] = queue.SimpleQueue()
        self._query: SealedQuery | None = None  # the open one, or the last one
        self._open = self._over = False
        self.sent = self._received = 0.0
        self._pause = _PAUSE
        self._cancel = zenoh.CancellationToken()

    def open(self) -> None:
        """Send the query for the first time."""
        self._declare()
        self._send()

    def move(self, key: str) -> None:
        """Query for the states of another user from now on. key: of these states."""
        # The old querier is not undeclared explicitly, because that raises "Already borrowed" while
        # another thread uses it. zenoh undeclares it when its last reference is dropped.
        self._key, self._pause = key, _PAUSE
        self._declare()
        self._send()

    def _declare(self) -> None:
        self._querier = self._session.declare_querier(
            self._key,
            consolidation=zenoh.ConsolidationMode.NONE,
            timeout=_QUERY_SECONDS,
            # The priority of motion commands, so that the first of them does not overtake the
            # query.
            priority=zenoh.Priority.INTERACTIVE_HIGH,
            express=True,
        )

    def end(self) -> None:
        """Make `take` return None after the replies that have arrived."""
        self._arrived.put(None)

    def close(self) -> None:
        """End the query."""
        try:
            self._cancel.cancel()
            self._querier.undeclare()
        except zenoh.ZError as error:  # the zenoh session was closed before
            log.debug("closing %s: %s", self._key, error)

    def tell(self, payload: bytes) -> None:
        """Send a message under the key that has no reply."""
        handler: Any = zenoh.handlers.Callback(lambda _: None)
        try:
            self._querier.get(handler, payload=payload, encoding=MSGPACK)
        except zenoh.ZError as error:  # the zenoh session was closed before
            log.debug("telling %s: %s", self._key, error)

    def take(self, published: Callable[[], float]) -> list[Reply] | None:
        """Wait a while for replies and return them; return None after the end.

        A state of another avatar is an OtherAvatarError.
        published: returns the time of the last motion command, on the monotonic clock [s].
        """
        if self._over:
            return None
        try:
            arrived = [self._arrived.get(timeout=self._patience())]
        except queue.Empty:
            silent = monotonic() - max(self._received, self.sent) > _SILENCE
            if not self._open or (silent and published() > self._received):
                self._send()
            return []
        while not self._arrived.empty():
            arrived.append(self._arrived.get())
        found: list[Reply] = []
        for item in arrived:
            if item is None:
                self._over = True
                break
            query, reply = item
            if query is not self._query:
                continue  # of an earlier query
            if reply is None:
                self._open = False
            elif (state := _read(query, reply)) is not None:
                found.append(state)
                self._received = monotonic()
                # An error such as `busy` does not reset the pause.
                if not isinstance(state, OtherAvatarError) and state[0]:
                    self._pause = _PAUSE
        return found

    def _patience(self) -> float:
        """Return how long to wait for a reply [s]."""
        return _SILENCE / 2 if self._open else max(0.0, self.sent + self._pause - monotonic())

    def _send(self) -> None:
        """Send the query in place of an earlier one."""
        self._query = query = SealedQuery(self._anchor, self._key, about=self._about)
        self._pause = min(2 * self._pause, _MAX_PAUSE)
        self.sent, self._open = monotonic(), True
        # zenoh calls these functions: they must neither block nor use zenoh.
        handler: Any = zenoh.handlers.Callback(
            lambda reply: self._arrived.put((query, reply)), lambda: self._arrived.put((query, None))
        )
        try:
            self._cancel.cancel()
            self._cancel = zenoh.CancellationToken()
            self._querier.get(
                handler, encoding=MSGPACK, attachment=query.nonce, cancellation_token=self._cancel
            )
        except zenoh.ZError as error:  # the zenoh session is closed
            self._open = False
            log.debug("querying %s: %s", self._key, error)


def _read(query: SealedQuery, reply: Any) -> Reply | None:
    """Return the content of a reply; None if the server did not send it."""
    try:
        return query.read(reply)
    except OtherAvatarError as error:
        return error


def decode_reply(answer: type[Answer], reply: Reply) -> Answer | SolidcloudError:
    """Return the answer or error of a reply; an InternalError if it cannot be decoded."""
    if isinstance(reply, OtherAvatarError):
        return reply
    ok, payload = reply
    try:
        if ok:
            return decode_answer(answer, payload)
        refusal = decode_answer(ErrorReply, payload)
        return error_from_code(refusal.code, refusal.message)
    except SolidcloudError as error:
        return error
