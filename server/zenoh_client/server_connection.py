"""Connection of a client to its server: requests and replies of one scene, under the client's id.

A server that does not know the client's avatars, because it was restarted or has dropped them,
receives them again. A query without any reply returns None: it may have reached no server, the
server may have died, or a message may have been dropped (WIRE.md, "Empty replies").
"""

import logging
import queue
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import zenoh

from ...schemas.errors import (
    BadRequestError,
    BusyError,
    InternalError,
    TooLargeError,
    UnknownAvatarError,
    UnknownSceneError,
    error_from_code,
)
from ...schemas.runtime.own_command import own_command
from ...schemas.wire import key_expressions
from ...schemas.wire.encoding import MSGPACK, decode_answer
from ...schemas.wire.scene_messages import WIRE_VERSION, ErrorReply, ScenesAnswer
from ..zenoh_common.endpoints import DEFAULT_ENDPOINT, check_endpoint, zenoh_words
from ..zenoh_common.sealed_replies import OtherAvatarError, SealedQuery, TrustAnchor
from ..zenoh_common.zenoh_settings import session_config
from .client_identity import OPEN_SECONDS, AddedAvatar, AddedAvatars, ClientIdentity

log = logging.getLogger(__name__)

# If a query ends without a reply after this share of the time for which it was kept open, or later,
# the server is assumed to be slow and not absent. The share is below 1, because clocks differ.
_NEARLY = 0.9
# Attempts to ask about avatars that the server does not know.
_MAX_ATTEMPTS = 3

_ENCODING = zenoh.Encoding(MSGPACK)


class ServerConnection:
    """Connection to the server of one scene, from `open` until `close`. Thread-safe.

    avatars: avatars that the client added.  anchor: holds the key that the server's replies need.
    timeout: time limit of one request [s].
    """

    def __init__(self, endpoint: str, scene: str, timeout: float, key_file: Path | str | None) -> None:
        """Make a connection that is not open. The parameters are those of `Client`."""
        self._endpoint, self._scene, self.timeout = endpoint, scene, timeout
        self.anchor = TrustAnchor(endpoint, key_file)
        self.avatars = AddedAvatars()
        self._renewing = threading.Lock()
        self._answered = False  # whether a server of this scene ever replied
        self._stack: ExitStack | None = None

    def open(self) -> None:
        """Connect. Raise UnknownSceneError if servers answer and none of them serves the scene."""
        with ExitStack() as stack:
            self.session = stack.enter_context(_open_session(self._endpoint))
            self._identity = ClientIdentity(self.session, self._scene, self.timeout)
            stack.callback(self._close_identity)
            self._check_served()
            self._stack = stack.pop_all()

    def close(self) -> None:
        """Disconnect; the server then drops the client's avatars. Closing twice is allowed."""
        stack, self._stack = self._stack, None
        if stack is not None:
            stack.close()

    def _close_identity(self) -> None:
        with self._renewing:
            self._identity.close()

    def check_open(self) -> None:
        """Raise BadRequestError if the connection is closed."""
        if self._stack is None:
            raise BadRequestError("this client is closed: send requests inside `with Client(...) as scene`")

    def __repr__(self) -> str:
        """Return the endpoint, and whether the connection is open."""
        return f"{self._endpoint}: {'closed' if self._stack is None else 'open'}"

    @property
    def client_id(self) -> str:
        """Return the client's present id."""
        return self._identity.id

    # --- one request -----------------------------------------------------------------------------

    def ask(self, operation: str, request: bytes, names: Sequence[str] = ()) -> bytes | None:
        """Send a request and return the bytes of the answer; None if none arrives in time.

        names: the avatars that the answer is about, in the request's order. Raise the error of an
        error reply.
        """
        querier, query = self._query(operation, request, names)
        replies = querier.get(payload=request, encoding=_ENCODING, attachment=query.nonce)
        query.sent()
        for reply in replies:
            payload = _payload_of(reply, query)
            if payload is not None:
                self._answered = True
                return payload
        if not self._answered:
            self._check_served()
        return None

    def send(
        self, operation: str, request: bytes, names: Sequence[str], came: Callable[[bytes | Exception], None]
    ) -> None:
        """Send a request without waiting.

        came: receives the bytes of the answer, or the error of an error reply, in the thread that
        receives it; it is not called without a reply.
        """
        querier, query = self._query(operation, request, names)

        def received(reply: zenoh.Reply) -> None:
            try:
                payload = _payload_of(reply, query)
            except Exception as error:
                came(error)
                return
            if payload is not None:
                came(payload)

        # In the receiving thread: by default zenoh starts a thread for each request.
        handler = zenoh.handlers.Callback(received, indirect=False)
        querier.get(handler, payload=request, encoding=_ENCODING, attachment=query.nonce)

    def require(self, operation: str, request: bytes = b"") -> bytes:
        """Return the answer to a request about the scene itself; raise BusyError without one."""
        seconds = max(self.timeout, OPEN_SECONDS["reload"]) if operation == "reload" else self.timeout
        begin = time.monotonic()
        payload = self.ask(operation, request)
        if payload is None:
            raise BusyError(self._explain_silence(operation, seconds, time.monotonic() - begin))
        return payload

    def stream(self, operation: str, request: bytes, names: Sequence[str]) -> Iterator[bytes]:
        """Send a request and yield its answers; end if none arrives for `timeout`."""
        # Unbounded: a full channel would block everything that arrives over this session.
        arrived: queue.SimpleQueue[Any] = queue.SimpleQueue()
        handler = zenoh.handlers.Callback(arrived.put, lambda: arrived.put(None))
        querier, query = self._query(operation, request, names)
        cancel = zenoh.CancellationToken()
        querier.get(
            handler, payload=request, encoding=_ENCODING, attachment=query.nonce, cancellation_token=cancel
        )
        answered = False
        until = time.monotonic() + self.timeout
        try:
            while (reply := _next(arrived, until)) is not None:
                payload = _payload_of(reply, query)
                if payload is not None:
                    self._answered = answered = True
                    yield payload
                    until = time.monotonic() + self.timeout
        finally:
            cancel.cancel()
        if not answered and not self._answered:
            self._check_served()

    def _query(
        self, operation: str, request: bytes, names: Sequence[str]
    ) -> tuple[zenoh.Querier, SealedQuery]:
        """Return an operation's querier under the present id, and the reader of its replies."""
        self.check_open()
        identity = self._identity
        query = SealedQuery(
            self.anchor, identity.keys[operation], request, partial(self.avatars.digests, names)
        )
        return identity.queriers[operation], query

    # --- requests about avatars ------------------------------------------------------------------

    def ask_about(self, operation: str, request: bytes, names: Sequence[str]) -> bytes | None:
        """Ask about avatars, as `ask` does; add them again if the server does not know them."""
        for attempt in range(1, _MAX_ATTEMPTS + 1):
            try:
                return self.ask(operation, request, names)
            except UnknownAvatarError as unknown:
                if not self._retry(names, unknown, attempt):
                    break
        return None

    def stream_about(self, operation: str, request: bytes, names: Sequence[str]) -> Iterator[bytes]:
        """Ask about avatars, as `stream` does; add them again if the server does not know them."""
        for attempt in range(1, _MAX_ATTEMPTS + 1):
            received = False
            try:
                for payload in self.stream(operation, request, names):
                    received = True
                    yield payload
                return
            except UnknownAvatarError as unknown:
                # This error arrives before the first answer, if at all.
                if received or not self._retry(names, unknown, attempt):
                    return

    def _retry(self, names: Sequence[str], unknown: UnknownAvatarError, attempt: int) -> bool:
        """Add avatars again; return whether the request should be repeated.

        unknown: the server's error; raised after the last attempt.  attempt: number of attempts so
        far.
        """
        if attempt < _MAX_ATTEMPTS:
            return self.add_again(names, unknown)
        if isinstance(unknown, OtherAvatarError):
            return False
        raise unknown

    def add_again(self, names: Sequence[str], unknown: UnknownAvatarError) -> bool:
        """Add avatars to a server that does not know them; return False if it does not answer.

        unknown: the server's error; raised again if the client has not added one of the avatars
        either. If the server has other avatars under these names, the client takes a new id.
        """
        added = self.avatars.known(names)
        if isinstance(unknown, OtherAvatarError):
            # Without a digest the server's avatars may be those of this client, which learns their
            # radius, and thus the digest, only from the answer to adding them.
            if self.avatars.digests(names) is not None:
                self._take_new_id(unknown.key_expression)
        elif len(added) < len(set(names)):
            raise unknown
        identity = self._identity
        try:
            return self._add(added)
        except TooLargeError:
            raise
        except BadRequestError:  # another program may have added an avatar under this name first
            self._take_new_id(identity.keys["add_avatar"])
            return self._add(added)

    def _add(self, added: dict[str, AddedAvatar]) -> bool:
        """Add avatars to the server; return whether it answered."""
        for name, avatar in added.items():
            payload = self.ask("add_avatar", avatar.request(name))
            if payload is None:
                return False
            self.avatars.accepted(name, payload)
        return True

    def _take_new_id(self, key_expression: str) -> None:
        """Take a new id if a key expression contains the present id: another program knows it."""
        with self._renewing:
            self.check_open()
            before = self._identity
            if not before.is_in(key_expression):
                return
            log.warning(
                "scene %s at %s: the server's avatars under this client's id differ from those it added, so another "
                "program knows the id: continuing with a new id",
                self._scene,
                self._endpoint,
            )
            self._identity = ClientIdentity(self.session, self._scene, self.timeout)
            before.close()

    # --- missing replies -------------------------------------------------------------------------

    def explain_silence(self, operation: str) -> str:
        """Return a message on why no server answered an operation, and what to do."""
        if not self._answered:
            return self._explain_silence(operation, self.timeout, 0.0)
        return (
            f"the server of scene {self._scene!r} at {self._endpoint} is gone, or has not answered {operation!r} "
            f"within {self.timeout:g} s: try again, or start one with: {self._start_command()}"
        )

    def _start_command(self) -> str:
        """Return the command that starts a server of this scene."""
        return f"{own_command()} serve ARCHIVE --name {self._scene} --listen {self._endpoint}"

    def _explain_silence(self, operation: str, seconds: float, waited: float) -> str:
        """Return a message on why no server answered a request.

        seconds: how long the query was kept open.  waited: how long it took to end.
        """
        where = f"scene {self._scene!r} at {self._endpoint}"
        # A query that reaches no server ends at once, and one whose server dies soon after.
        if self._answered and waited > _NEARLY * seconds:
            then = ", and its log says when it is done" if operation == "reload" else ""
            return (
                f"the server of {where} has not answered {operation!r} within {seconds:g} s: it may still be at work"
                f"{then}: try again, or restart it"
            )
        start = self._start_command()
        if self._answered:
            return f"the server of {where} is gone, expected its answer to {operation!r}: start one with: {start}"
        return f"no server of {where}, expected one that answers {operation!r}: start one with: {start}"

    def _check_served(self) -> None:
        """Raise UnknownSceneError if servers answer and none of them serves this scene."""
        served, versions = _ask_scenes(self.session, self.timeout, self.anchor)
        if versions - {WIRE_VERSION}:
            raise InternalError(
                f"a server at {self._endpoint} speaks wire version {max(versions)}, this client "
                f"{WIRE_VERSION}: upgrade the older one"
            )
        if self._scene in served:
            self._answered = True
        elif versions:
            names = ", ".join(sorted(served)) or "none"
            raise UnknownSceneError(
                f"scene {self._scene!r} is not served at {self._endpoint}; served: {names}"
            )


def scenes_at(
    endpoint: str = DEFAULT_ENDPOINT, timeout: float = 5.0, key_file: Path | str | None = None
) -> list[str]:
    """Return the sorted names of the scenes served at an endpoint.

    Raise BusyError if no server answers.
    """
    anchor = TrustAnchor(endpoint, key_file)
    with _open_session(endpoint) as session:
        served, versions = _ask_scenes(session, timeout, anchor)
    if not versions:
        raise BusyError(
            f"no server answered at {endpoint} within {timeout:g} s: "
            f"start one with: {own_command()} serve ARCHIVE --listen {endpoint}"
        )
    return sorted(served)


@contextmanager
def _open_session(endpoint: str) -> Iterator[zenoh.Session]:
    """Open a session connected to an endpoint; raise BadRequestError if it is invalid."""
    check_endpoint(endpoint, "endpoint")
    try:
        session = zenoh.open(session_config(connect=endpoint))
    except zenoh.ZError as error:
        raise BadRequestError(
            f"endpoint {endpoint!r}: {zenoh_words(error)}: expected one such as {DEFAULT_ENDPOINT}"
        ) from None
    try:
        yield session
    finally:
        try:
            session.close()
        except zenoh.ZError as error:
            # A frozen server accepts no farewell, and zenoh gives up. The client has nothing left to do.
            log.warning("%s: %s", endpoint, zenoh_words(error))


def _ask_scenes(session: zenoh.Session, timeout: float, anchor: TrustAnchor) -> tuple[set[str], set[int]]:
    """Return the served scenes, and the wire versions of the servers that answered."""
    served: set[str] = set()
    versions: set[int] = set()
    query = SealedQuery(anchor, key_expressions.scenes_key())
    replies = session.get(
        key_expressions.scenes_key(),
        attachment=query.nonce,
        # Several servers answer under this one key, and all of them count.
        target=zenoh.QueryTarget.ALL,
        consolidation=zenoh.ConsolidationMode.NONE,
        timeout=timeout,
        encoding=_ENCODING,
    )
    for reply in replies:
        ok, payload = query.read(reply) or (False, b"")
        if ok:
            answer = decode_answer(ScenesAnswer, payload)
            served.update(answer.scenes)
            versions.add(answer.wire_version)
    return served, versions


def _next(arrived: "queue.SimpleQueue[Any]", until: float) -> Any:
    """Wait for the next reply; return None after the last, or if none arrives by `until`.

    until: on the monotonic clock [s].
    """
    left = until - time.monotonic()
    try:
        return arrived.get(timeout=left) if left > 0 else None
    except queue.Empty:
        return None


def _payload_of(reply: zenoh.Reply, query: SealedQuery) -> bytes | None:
    """Return the bytes of an answer; None if the server did not send it.

    Raise the error of an error reply.
    """
    found = query.read(reply)
    if found is None:
        return None
    ok, payload = found
    if not ok:
        error = decode_answer(ErrorReply, payload)
        raise error_from_code(error.code, error.message)
    return payload
