"""The client's side of states: one long query, answered with many replies, asked again whenever it ends."""

import logging
import queue
from collections.abc import Callable
from time import monotonic
from typing import Any

import zenoh

from ...schemas.wire.encoding import MSGPACK
from ..zenoh_common.sealed_replies import OtherAvatarError, SealedQuery, TrustAnchor

log = logging.getLogger(__name__)

# How long the query may be silent while wishes go out before it is asked again [s].
_SILENCE = 1.0
# How long to wait before asking again after a query that brought nothing [s]: the first time, and at most.
_PAUSE, _MOST_PAUSE = 0.01, 0.2
# How long one query is kept open [s].
_QUERY_SECONDS = 3600.0


class StateQuery:
    """The query for one user's states. One thread takes what comes; `end` may be called by another."""

    def __init__(
        self, session: zenoh.Session, key: str, anchor: TrustAnchor, about: Callable[[], bytes | None]
    ) -> None:
        """Ask nothing yet. key: of the user's states.  about: as in `SealedQuery`."""
        self._session, self._key, self._anchor, self._about = session, key, anchor, about
        # Without bound: what is heard is taken at once, but for the moments in which an avatar is added again.
        self._came: queue.SimpleQueue[tuple[SealedQuery, Any] | None] = queue.SimpleQueue()
        self._asked_now: SealedQuery | None = None  # the query that is open, or was last
        self._open = self._over = False
        self._asked = self._heard = 0.0  # when, on the monotonic clock
        self._pause = _PAUSE
        self._cancel = zenoh.CancellationToken()

    def open(self) -> None:
        """Ask for the first time."""
        self._declare()
        self._ask()

    def move(self, key: str) -> None:
        """Ask for the states of another user from now on. key: of them."""
        self.close()
        self._key, self._pause = key, _PAUSE
        self._declare()
        self._ask()

    def _declare(self) -> None:
        self._querier = self._session.declare_querier(
            self._key,
            consolidation=zenoh.ConsolidationMode.NONE,
            timeout=_QUERY_SECONDS,
            # As wishes travel, so that the query is not behind the first of them.
            priority=zenoh.Priority.INTERACTIVE_HIGH,
            express=True,
        )

    def end(self) -> None:
        """Have `take` return None once it has returned what came so far."""
        self._came.put(None)

    def close(self) -> None:
        """Give up the query."""
        try:
            self._cancel.cancel()
            self._querier.undeclare()
        except zenoh.ZError as error:  # the zenoh session was closed before
            log.debug("closing %s: %s", self._key, error)

    def take(self, wished: Callable[[], float]) -> list[tuple[bool, bytes] | OtherAvatarError] | None:
        """Wait a while for replies; return states as (True, payload), errors as (False, payload); None: it is over.

        A state of another avatar is returned as OtherAvatarError.
        wished: returns when the user wished last, on the monotonic clock [s].
        """
        if self._over:
            return None
        try:
            came = [self._came.get(timeout=self._patience())]
        except queue.Empty:
            now = monotonic()
            if not self._open or (now - max(self._heard, self._asked) > _SILENCE and wished() > self._heard):
                self._ask()
            return []
        while not self._came.empty():
            came.append(self._came.get())
        found: list[tuple[bool, bytes] | OtherAvatarError] = []
        for item in came:
            if item is None:
                self._over = True
                break
            asked, reply = item
            if asked is not self._asked_now:
                continue  # of a query before this one
            if reply is None:
                self._open = False
            elif (said := _read(asked, reply)) is not None:
                found.append(said)
                self._heard = monotonic()
                if not isinstance(said, OtherAvatarError) and said[0]:
                    self._pause = (
                        _PAUSE  # after an error, `busy` say, the server is not asked faster than before
                    )
        return found

    def _patience(self) -> float:
        """Return how long to wait for a reply [s]."""
        return _SILENCE if self._open else max(0.0, self._asked + self._pause - monotonic())

    def _ask(self) -> None:
        """Ask, in place of an earlier query."""
        self._asked_now = asked = SealedQuery(self._anchor, self._key, about=self._about)
        self._pause = min(2 * self._pause, _MOST_PAUSE)
        self._asked, self._open = monotonic(), True
        # zenoh calls these: they may not block, nor use zenoh.
        handler: Any = zenoh.handlers.Callback(
            lambda reply: self._came.put((asked, reply)), lambda: self._came.put((asked, None))
        )
        try:
            self._cancel.cancel()
            self._cancel = zenoh.CancellationToken()
            self._querier.get(
                handler, encoding=MSGPACK, attachment=asked.nonce, cancellation_token=self._cancel
            )
        except zenoh.ZError as error:  # the zenoh session is closed
            self._open = False
            log.debug("asking %s: %s", self._key, error)


def _read(asked: SealedQuery, reply: Any) -> tuple[bool, bytes] | OtherAvatarError | None:
    """Return what a reply says; None where the server did not send it."""
    try:
        return asked.read(reply)
    except OtherAvatarError as error:
        return error
