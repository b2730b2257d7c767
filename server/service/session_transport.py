"""Sessions over zenoh, the server's side: wishes that clients publish, states that they ask for with one long query.

zenoh hands wishes and queries to bounded channels. One thread empties wishes into mailboxes, one opens streams of
states, and another simulates frames and sends their states (command_mailboxes.py).
"""

import logging
from collections.abc import Callable
from typing import Any, Protocol

import zenoh

from ...schemas.errors import BadRequestError
from ...schemas.wire import keys
from ...schemas.wire.seals import Sealer
from ..network.channels import take_at_hand
from ..network.replies import send_reply
from ..served.served_scene import Answer, Full
from .command_mailboxes import Frames
from .liveliness_tokens import Tokens
from .state_streams import StateStreams
from .waiting_commands import WaitingWishes

log = logging.getLogger(__name__)

# Wishes that zenoh may hand over before the thread takes them: of a thousand users one each.
_CHANNEL = 1024
# Queries for states that may be open for each user that a scene has room for.
_STREAMS_A_USER = 2


class Sessions(Protocol):
    """What has the frames of a scene simulated."""

    def frames(
        self, scene: str, publish: Callable[[keys.User, Answer], None], turn: Callable[[str], str]
    ) -> Frames | None: ...
    def busy(self, encoding: str | None, full: Full) -> Answer: ...


class SceneSessions:
    """The sessions of one scene. declared: what is to be undeclared at the end; then its threads end too."""

    def __init__(
        self,
        session: zenoh.Session,
        scene: str,
        service: Sessions,
        start: Callable[..., None],
        sealer: Callable[[zenoh.Query, str, bytes], Sealer | None],
        tokens: Tokens,
    ) -> None:
        """Declare them.

        start: starts a thread of a name that runs a function with arguments.  sealer: as in `Wire`.  tokens: those of
        the scene's clients.
        """
        self.declared: list[Any] = []
        self._service, self._sealer, self._tokens = service, sealer, tokens
        self._frames = frames = service.frames(scene, self._send, tokens.turn)
        self._streams = StateStreams(
            0 if frames is None else _STREAMS_A_USER * frames.most_users, tokens.turn
        )
        if frames is None:
            return
        queryable = session.declare_queryable(
            keys.states_key(scene), zenoh.handlers.FifoChannel(_CHANNEL), complete=True
        )
        wishes = session.declare_subscriber(keys.wishes_key(scene), zenoh.handlers.FifoChannel(_CHANNEL))
        self.declared += [queryable, wishes]
        start(f"{scene}-states", self._open_streams, queryable.handler)
        start(f"{scene}-wishes", self._take_wishes, wishes.handler, frames)
        start(f"{scene}-frames", self._run_frames, frames)

    def give_up(self) -> None:
        """Stop the frame at work, and those of the wishes that wait."""
        if self._frames is not None:
            self._frames.give_up()

    def client_gone(self, client: str) -> None:
        """End what a client that is gone has asked for."""
        self._streams.end_client(client)

    def _send(self, user: keys.User, answer: Answer) -> None:
        self._streams.send(user, answer)

    def _run_frames(self, frames: Frames) -> None:
        """Simulate until there are no more wishes, then end the streams. A thread's work."""
        try:
            frames.run()
        finally:
            self._streams.close()

    def _open_streams(self, queries: Any) -> None:
        """Take the queries for states. A thread's work."""
        for query in queries:
            try:
                self._open_stream(query)
            except Exception:  # of this query alone
                log.exception("a query for states")

    def _open_stream(self, query: zenoh.Query) -> None:
        """Open a stream, or say that there is no room; a query for the states of several users ends without a reply."""
        try:
            key = str(query.key_expr)
            user = keys.parse_state(key)
        except BadRequestError as error:
            log.debug("a query for nobody's states: %s", error)
            query.drop()
            return
        payload = query.payload
        sealer = self._sealer(query, key, b"" if payload is None else payload.to_bytes())
        if not self._streams.open(user, query, sealer):
            with query:
                encoding = None if query.encoding is None else str(query.encoding)
                send_reply(query, query.key_expr, self._service.busy(encoding, Full.STATES), sealer)

    def _take_wishes(self, samples: Any, frames: Frames) -> None:
        """Take wishes in until there are no more, then end the frames. A thread's work.

        What has come is sorted by turns before a wish is read: reading a large one takes milliseconds.
        """
        waiting = WaitingWishes(self._tokens.turn)
        try:
            for sample in samples:
                self._sort(sample, waiting, frames)
                while (following := waiting.take()) is not None:
                    self._take_wish(*following, frames)
                    for _ in range(_CHANNEL):
                        if (more := take_at_hand(samples)) is None:
                            break
                        self._sort(more, waiting, frames)
        finally:
            frames.close()

    def _sort(self, sample: zenoh.Sample, waiting: WaitingWishes, frames: Frames) -> None:
        """Have a wish wait for its client's turn; refuse one that is too large, unread."""
        try:
            user = keys.parse_wish(str(sample.key_expr))
        except BadRequestError as error:
            log.debug("a wish of nobody: %s", error)
            return
        try:
            size = len(sample.payload)
            if sample.kind == zenoh.SampleKind.DELETE or frames.fits(user, size, str(sample.encoding)):
                waiting.put(user, sample, size)
        except Exception:  # of this wish alone
            log.exception("a wish")

    def _take_wish(self, user: keys.User, sample: zenoh.Sample, frames: Frames) -> None:
        """Take in one wish, or that a user leaves."""
        try:
            if sample.kind == zenoh.SampleKind.DELETE:
                frames.leave(user)
                self._streams.forget(user)
            elif frames.wish(user, sample.payload.to_bytes(), str(sample.encoding)):
                self._streams.send_again(user)
        except Exception:  # of this wish alone
            log.exception("a wish")
