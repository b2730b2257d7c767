"""Changes of what is resident of a scene, sent to the clients that query for them.

As with states, each client sends one long query, and all messages are replies to it. One thread
takes the queries. A second one reads the changes some times a second and sends them: it has nothing
to do, and nothing is collected, while no query is open.
"""

import logging
import threading
from collections.abc import Callable
from typing import Any

import zenoh
from msgspec import structs

from ...schemas.errors import BadRequestError, SolidcloudError
from ...schemas.wire import key_expressions
from ...schemas.wire.encoding import decode_request, encode, wire_encoding
from ...schemas.wire.residency_messages import CHANGES_SECONDS, ResidencyChanges, ResidencyRequest
from ..scene_interface import EncodedReply, LimitReached, ServedWatch
from ..zenoh_common.sealed_replies import encoding_of
from .request_dispatcher import RequestDispatcher
from .state_streams import StateStreams
from .stream_queries import content_and_sealer, refuse, take_queries

log = logging.getLogger(__name__)

# Queries that wait to be opened, and queries that are open. With MAX_CHANGED_VOXELS, all open ones
# take at most 10 MB/s.
_CHANNEL, _STREAMS = 256, 64
# A query with a larger payload is ended unread [bytes].
_MAX_REQUEST_BYTES = 4096


class ResidencyStreams:
    """Open queries for the changes of one scene.

    declared: zenoh objects to undeclare at the end, which also ends the threads.
    """

    def __init__(
        self,
        session: zenoh.Session,
        scene: str,
        dispatcher: RequestDispatcher,
        start: Callable[..., None],
        server_key: bytes,
        turn: Callable[[str], str],
    ) -> None:
        """Declare the queryable and start the threads; the parameters are those of `SceneSessions`."""
        self._scene, self._dispatcher, self._server_key = scene, dispatcher, server_key
        self._streams = StateStreams(_STREAMS, turn)
        self._lock = threading.Lock()
        self._new: dict[key_expressions.User, str] = {}  # queries without a message so far: encodings
        self._wake = threading.Event()
        self._closed = threading.Event()
        queryable = session.declare_queryable(
            key_expressions.all_residency_key(scene), zenoh.handlers.FifoChannel(_CHANNEL), complete=True
        )
        self.declared: list[Any] = [queryable]
        start(f"{scene}-residency", self._take_queries, queryable.handler)
        start(f"{scene}-changes", self._run)

    def client_gone(self, client: str) -> None:
        """End the query of a disconnected client."""
        self._streams.end_client(client)

    def _take_queries(self, queries: Any) -> None:
        """Open streams until queries end, then end the streams. Runs in a thread."""
        try:
            take_queries(queries, "changes", key_expressions.parse_residency_key, self._open)
        finally:
            self._closed.set()
            self._wake.set()
            self._streams.close()

    def _open(self, client: str, query: zenoh.Query) -> None:
        """Open a stream or answer with an error."""
        if query.payload is not None and len(query.payload) > _MAX_REQUEST_BYTES:
            query.drop()
            return
        content, sealer = content_and_sealer(query, self._server_key)
        encoding, refusal, request = encoding_of(query), None, ResidencyRequest()
        try:
            stated = wire_encoding(encoding)
            if content:
                request = decode_request(ResidencyRequest, content, stated)
        except SolidcloudError as error:
            refusal = self._dispatcher.refuse(encoding, error)
        user = key_expressions.User(client, "")
        if not request.follow:
            self._streams.end(user)
            query.drop()
            return
        if refusal is None and not self._streams.open(user, query, sealer):
            refusal = self._dispatcher.busy(encoding, LimitReached.STATES)
        if refusal is not None:
            refuse(query, refusal, sealer)
            return
        with self._lock:
            self._new[user] = stated
        self._wake.set()

    def _run(self) -> None:
        """Send changes while queries are open. Runs in a thread."""
        watch: ServedWatch | None = None
        open_queries: dict[key_expressions.User, str] = {}
        try:
            while not self._closed.is_set():
                if not open_queries:
                    if watch is not None:
                        watch.close()
                        watch = None
                    self._wake.wait()
                    self._wake.clear()
                with self._lock:
                    new, self._new = self._new, {}
                open_queries = {
                    user: encoding
                    for user, encoding in (open_queries | new).items()
                    if user in self._streams.users()
                }
                if open_queries:
                    try:
                        watch = self._dispatcher.watch(self._scene) if watch is None else watch
                        self._send(watch, open_queries, new)
                    except BadRequestError:
                        raise
                    except Exception:  # affects these changes only, and the next message says so
                        log.exception("changes of scene %s are lost", self._scene)
                        with self._lock:
                            self._new = open_queries | self._new
                    self._closed.wait(CHANGES_SECONDS)
        except BadRequestError as error:  # the scene is closed
            log.debug("changes end: %s", error)
        finally:
            self._streams.close()
            if watch is not None:
                watch.close()

    def _send(
        self,
        watch: ServedWatch,
        open_queries: dict[key_expressions.User, str],
        new: dict[key_expressions.User, str],
    ) -> None:
        """Send the changes since the last message, which for a new query is the first one."""
        message = watch.take(always=bool(new))
        if message is None:
            return
        encoded: dict[tuple[str, bool], EncodedReply] = {}
        for user, encoding in open_queries.items():
            is_new = user in new
            if (encoding, is_new) not in encoded:
                encoded[encoding, is_new] = _encoded(message, encoding, is_new)
            self._streams.send(user, encoded[encoding, is_new])


def _encoded(message: ResidencyChanges, encoding: str, is_first: bool) -> EncodedReply:
    """Encode a message. is_first: of a query, so that the client asks for the voxels."""
    whole = structs.replace(message, lost=True) if is_first else message
    return EncodedReply(encode(whole, encoding), encoding, True)
