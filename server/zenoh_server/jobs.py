"""Requests read from the wire, and the jobs of threads that carry them out. Without zenoh."""

import math
import threading
import time
from collections.abc import Callable
from typing import Any, NamedTuple

from ...schemas.errors import BadRequestError
from ...schemas.wire import key_expressions
from ...schemas.wire.encoding import JSON
from ..runtime.stop_flag import StopFlag
from ..runtime.watchdog import cpu_seconds
from ..scene_interface import EncodedReply
from .fair_queues import Ticket

# How long a request may hold a worker, and how long it may compute before it is slow [s]. Nearly
# all requests take less, and others wait at most this long for a slow one.
SLOW_SECONDS = 0.01
# Payloads from this size on are slow [bytes]: building an avatar of 5,000 points takes 20 ms,
# reading JSON 50 ns a byte.
_SLOW_BYTES, _SLOW_AVATAR_BYTES, _SLOW_JSON_BYTES = 1 << 20, 1 << 17, 1 << 17


class Wire(NamedTuple):
    """Functions with which a lane reads and answers queries.

    encoding: returns the encoding of a query.
    sealer: returns the sealer of the replies to a query, given its key expression and payload.
    reply: sends an answer under a key, sealed, with its number among the replies; returns False if
    that fails.
    """

    encoding: Callable[[Any], str | None]
    sealer: Callable[[Any, str, bytes], Any]
    reply: Callable[[Any, Any, EncodedReply, Any, int], bool]


class ReceivedRequest:
    """Query with its properties, read once: each access to a property of a query makes a copy."""

    __slots__ = ("client", "encoding", "key", "key_expr", "operation", "payload", "query", "sealer")

    def __init__(self, query: Any, wire: Wire) -> None:
        """Read a query."""
        self.query, self.encoding = query, wire.encoding(query)
        self.key_expr = query.key_expr
        self.key = str(self.key_expr)
        try:
            route = key_expressions.parse_query_key(self.key)
            self.client, self.operation = route.client, route.operation
        except BadRequestError:
            self.client = self.operation = ""  # no client: the service will refuse it
        payload = query.payload
        self.payload = b"" if payload is None else payload.to_bytes()
        self.sealer = wire.sealer(query, self.key, self.payload)

    @property
    def slow(self) -> bool:
        """Return whether the request is slow because of its size."""
        size = len(self.payload)
        if size < _SLOW_AVATAR_BYTES:
            return False
        return size >= _SLOW_BYTES or self.operation == "add_avatar" or self.encoding == JSON


class RequestJob:
    """Current work of one thread.

    ticket: of the request; None if the thread refuses one.
    takes: whether the thread takes queries from the channel, and must be replaced when it is slow.
    begun: when the work or the sending of the answer began [s].
    again: whether the request is to be carried out again.
    ended: whether the answer is no longer wanted.
    left: of a refusal, whether its thread was replaced.
    cpu: processor time of the thread at the beginning [s].
    low: whether the thread has a lower priority.
    """

    __slots__ = (
        "again",
        "begun",
        "cpu",
        "ended",
        "left",
        "low",
        "sending",
        "stop",
        "takes",
        "thread_id",
        "ticket",
    )

    def __init__(
        self, ticket: Ticket | None, takes: bool, *, sending: bool = False, part_seconds: float = math.inf
    ) -> None:
        """Begin the job in the calling thread. part_seconds: see `StopFlag`."""
        self.ticket, self.takes, self.sending = ticket, takes, sending
        self.begun = time.monotonic()
        self.thread_id = threading.get_native_id()
        self.stop = StopFlag(part_seconds)
        self.cpu = time.thread_time()
        self.again = self.ended = self.left = False
        self.low = ticket is not None and ticket.slow

    @property
    def client(self) -> str:
        """Return the client that sent the request; "" if there is none."""
        return "" if self.ticket is None else self.ticket.client

    @property
    def turn(self) -> str:
        """Return the turn of the request; "" if there is none."""
        return "" if self.ticket is None else self.ticket.turn

    @property
    def works(self) -> bool:
        """Return whether the thread has computed, not waited, for at least SLOW_SECONDS."""
        return cpu_seconds(self.thread_id) - self.cpu >= SLOW_SECONDS

    def end(self, reason: str) -> None:
        """Stop the request permanently."""
        self.ended = True
        self.stop.set(reason)
