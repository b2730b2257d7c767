"""Server side of sessions over zenoh: clients publish motion commands and query for states.

A motion command is a `Wish` on the wire. All states of a user are replies to one long query. zenoh
passes motion commands and queries to bounded channels. One thread moves motion commands into
mailboxes, a second one opens streams of states, and a third one simulates frames and sends their
states (command_mailboxes.py).
"""

import logging
from collections.abc import Callable
from typing import Any

import zenoh

from ...schemas.errors import BadRequestError
from ...schemas.wire import key_expressions
from ..scene_interface import EncodedReply, LimitReached
from ..zenoh_common.sealed_replies import encoding_of
from .command_mailboxes import FrameLoop, WaitingCommands
from .fair_queues import LivelinessTokens
from .request_dispatcher import RequestDispatcher
from .request_lanes import take_waiting
from .state_streams import StateStreams
from .stream_queries import content_and_sealer, refuse, take_queries

log = logging.getLogger(__name__)

# Capacity of the channel in motion commands: one from each of a thousand users.
_CHANNEL = 1024
# Open queries for states, for each user that a scene has room for.
_STREAMS_A_USER = 2


class SceneSessions:
    """Sessions of one scene.

    declared: zenoh objects to undeclare at the end, which also ends the threads.
    """

    def __init__(
        self,
        session: zenoh.Session,
        scene: str,
        dispatcher: RequestDispatcher,
        start: Callable[..., None],
        server_key: bytes,
        tokens: LivelinessTokens,
    ) -> None:
        """Declare the sessions and start their threads, if the scene simulates.

        start: starts a named thread that runs a function with arguments.  server_key: seals
        the replies.  tokens: of the scene's clients.
        """
        self.declared: list[Any] = []
        self._dispatcher, self._server_key, self._tokens = dispatcher, server_key, tokens
        self._frames = frames = dispatcher.frames(scene, self._send, tokens.turn)
        self._streams = StateStreams(
            0 if frames is None else _STREAMS_A_USER * frames.most_users, tokens.turn
        )
        if frames is None:
            return
        queryable = session.declare_queryable(
            key_expressions.all_states_key(scene), zenoh.handlers.FifoChannel(_CHANNEL), complete=True
        )
        wishes = session.declare_subscriber(
            key_expressions.all_commands_key(scene), zenoh.handlers.FifoChannel(_CHANNEL)
        )
        self.declared += [queryable, wishes]
        parse = key_expressions.parse_state_key
        start(f"{scene}-states", take_queries, queryable.handler, "states", parse, self._open_stream)
        start(f"{scene}-wishes", self._take_wishes, wishes.handler, frames)
        start(f"{scene}-frames", self._run_frames, frames)

    def give_up(self) -> None:
        """Stop the running frame, and those of the waiting motion commands."""
        if self._frames is not None:
            self._frames.give_up()

    def client_gone(self, client: str) -> None:
        """End the queries of a disconnected client."""
        self._streams.end_client(client)

    def _send(self, user: key_expressions.User, answer: EncodedReply) -> None:
        self._streams.send(user, answer)

    def _run_frames(self, frames: FrameLoop) -> None:
        """Simulate until motion commands end, then end the streams. Runs in a thread."""
        try:
            frames.run()
        finally:
            self._streams.close()

    def _open_stream(self, user: key_expressions.User, query: zenoh.Query) -> None:
        """Open a stream or answer `busy`."""
        _, sealer = content_and_sealer(query, self._server_key)
        if not self._streams.open(user, query, sealer):
            refuse(query, self._dispatcher.busy(encoding_of(query), LimitReached.STATES), sealer)

    def _take_wishes(self, samples: Any, frames: FrameLoop) -> None:
        """Take motion commands until they end, then end the frames. Runs in a thread.

        Waiting samples are sorted by turns before one is decoded: decoding a large one takes
        milliseconds.
        """
        waiting = WaitingCommands(self._tokens.turn)
        try:
            for sample in samples:
                self._sort(sample, waiting, frames)
                while (following := waiting.take()) is not None:
                    self._take_wish(*following, frames)
                    for _ in range(_CHANNEL):
                        if (more := take_waiting(samples)) is None:
                            break
                        self._sort(more, waiting, frames)
        finally:
            frames.close()

    def _sort(self, sample: zenoh.Sample, waiting: WaitingCommands, frames: FrameLoop) -> None:
        """Queue a motion command for its client's turn; refuse one that is too large, undecoded."""
        try:
            user = key_expressions.parse_command_key(str(sample.key_expr))
        except BadRequestError as error:
            log.debug("a motion command of no user: %s", error)
            return
        try:
            size = len(sample.payload)
            if sample.kind == zenoh.SampleKind.DELETE or frames.fits(user, size, str(sample.encoding)):
                waiting.put(user, sample, size)
        except Exception:  # affects this motion command only
            log.exception("a motion command failed")

    def _take_wish(self, user: key_expressions.User, sample: zenoh.Sample, frames: FrameLoop) -> None:
        """Pass one motion command to the frames; the deletion of a key removes its user."""
        try:
            if sample.kind == zenoh.SampleKind.DELETE:
                frames.leave(user)
                self._streams.forget(user)
            elif frames.wish(user, sample.payload.to_bytes(), str(sample.encoding)):
                self._streams.send_again(user)
        except Exception:  # affects this motion command only
            log.exception("a motion command failed")
