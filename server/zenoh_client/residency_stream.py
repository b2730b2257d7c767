"""Changes of what is resident of a scene, received as replies to one long query."""

import logging
import math
import threading
from collections import deque
from collections.abc import Iterator
from typing import Self

import zenoh
from msgspec import structs

from ...schemas.errors import BadRequestError, SolidcloudError
from ...schemas.wire import key_expressions
from ...schemas.wire.encoding import encode
from ...schemas.wire.residency_messages import ResidencyChanges, ResidencyRequest
from ..runtime.threads import start_loop
from ..zenoh_common.endpoints import zenoh_words
from .server_connection import ServerConnection
from .state_query import StateQuery, decode_reply

log = logging.getLogger(__name__)

# Messages stored for `changes`: some minutes of few changes. Beyond it all are dropped, and the next
# one is `lost`.
_MAX_MESSAGES = 1024


class ResidencyStream:
    """Changes of a served scene; a context manager, thread-safe. Made by `Client.residency_changes`.

    Iterating over it yields the messages of `changes`.
    """

    def __init__(self, connection: ServerConnection, scene: str) -> None:
        """Make a stream; entering it begins it."""
        self._connection, self._scene = connection, scene
        self._client = connection.client_id
        self._query = StateQuery(connection.session, self._key(), connection.anchor, lambda: b"")
        self._changed = threading.Condition()
        self._kept: deque[ResidencyChanges | SolidcloudError] = deque()
        self._last: int | None = None  # seq of the last message
        self._lost = False
        self._thread: threading.Thread | None = None

    def _key(self) -> str:
        """Return the key expression under the client's present id."""
        return key_expressions.residency_key(self._scene, self._client)

    def __enter__(self) -> Self:
        try:
            self._query.open()
        except zenoh.ZError as error:
            raise BadRequestError(
                f"changes of scene {self._scene!r}: {zenoh_words(error)}: expected an open client: begin them inside "
                "`with Client(...) as scene`"
            ) from None
        self._thread = start_loop("residency", self._receive)
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End the query; `changes` ends. Closing twice is allowed."""
        with self._changed:
            thread, self._thread = self._thread, None
            self._changed.notify_all()
        if thread is not None:
            self._query.end()
            self._query.tell(encode(ResidencyRequest(follow=False)))
            thread.join()
            self._query.close()

    def __iter__(self) -> Iterator[ResidencyChanges]:
        """Yield the messages of `changes`."""
        return self.changes()

    def changes(self, timeout: float = 5.0) -> Iterator[ResidencyChanges]:
        """Yield messages in order, until none arrives for `timeout` [s] or this is closed.

        A server sends one at least every half second. `lost` is also set where messages were lost
        on the way, after another server answers, and where more than 1,024 were not taken in time.
        Raise an error of the server at its place among the messages.
        """
        while True:
            with self._changed:
                self._changed.wait_for(lambda: bool(self._kept) or self._thread is None, timeout)
                if not self._kept or self._thread is None:
                    return
                found = self._kept.popleft()
            if isinstance(found, SolidcloudError):
                raise found
            yield found

    def _receive(self) -> None:
        """Take messages until the end. Runs in a thread."""
        # The server sends without being asked again: silence alone is a reason to query again.
        while (replies := self._query.take(lambda: math.inf)) is not None:
            for reply in replies:
                self._keep(decode_reply(ResidencyChanges, reply))
            self._follow_client()

    def _follow_client(self) -> None:
        """Continue under the client's new id if it has taken one."""
        if (client := self._connection.client_id) != self._client:
            self._client = client
            try:
                self._query.move(self._key())
            except zenoh.ZError as error:  # the client is being closed
                log.debug("following: %s", error)

    def _keep(self, found: ResidencyChanges | SolidcloudError) -> None:
        """Store a message or an error for `changes`."""
        with self._changed:
            if len(self._kept) >= _MAX_MESSAGES:
                self._kept.clear()
                self._lost = True
            if isinstance(found, ResidencyChanges):
                lost = self._lost or self._last is None or found.seq != self._last + 1
                self._last, self._lost = found.seq, False
                found = structs.replace(found, lost=found.lost or lost)
            else:
                self._lost = True
            self._kept.append(found)
            self._changed.notify_all()
