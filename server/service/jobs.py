"""A query on its way, and what one thread does with it at present. No zenoh here."""

import math
import threading
import time
from collections.abc import Callable
from typing import Any, NamedTuple

from ...schemas.errors import BadRequestError
from ...schemas.wire import keys
from ...schemas.wire.encoding import JSON
from ..runtime.stop_flag import Stop
from ..runtime.watchdog import cpu_seconds
from ..served.served_scene import Answer
from .fair_queues import Ticket

# How long a request may hold a worker [s], and compute before it is slow. More than nearly all take, and what
# others may have to wait for it.
SLOW_SECONDS = 0.01
# Payloads that are slow for sure [bytes]: building an avatar of 5,000 points takes 20 ms, reading JSON 50 ns a byte.
_SLOW_BYTES, _SLOW_AVATAR_BYTES, _SLOW_JSON_BYTES = 1 << 20, 1 << 17, 1 << 17


class Wire(NamedTuple):
    """How a lane reads and answers queries.

    sealer: returns what seals the replies to a query, of its key expression and payload.  reply: sends an answer under
    a key, sealed, with its number among the replies; False where that fails.
    """

    encoding: Callable[[Any], str | None]
    sealer: Callable[[Any, str, bytes], Any]
    reply: Callable[[Any, Any, Answer, Any, int], bool]


class Request:
    """A query on its way, and what was read of it: each property of a query is a copy that costs."""

    __slots__ = ("client", "encoding", "key", "key_expr", "operation", "payload", "query", "sealer")

    def __init__(self, query: Any, wire: Wire) -> None:
        """Read a query."""
        self.query, self.encoding = query, wire.encoding(query)
        self.key_expr = query.key_expr
        self.key = str(self.key_expr)
        try:
            route = keys.parse_question(self.key)
            self.client, self.operation = route.client, route.operation
        except BadRequestError:
            self.client = self.operation = ""  # nobody's: the service will refuse it
        payload = query.payload
        self.payload = b"" if payload is None else payload.to_bytes()
        self.sealer = wire.sealer(query, self.key, self.payload)

    @property
    def slow(self) -> bool:
        """Whether the request is slow by its size."""
        size = len(self.payload)
        if size < _SLOW_AVATAR_BYTES:
            return False
        return size >= _SLOW_BYTES or self.operation == "add_avatar" or self.encoding == JSON


class Job:
    """What one thread does at present.

    ticket: of the request it carries out; None: it refuses one.  takes: whether the thread takes queries from the
    channel, so that another must take its place.  begun: when it began, or began to send [s].  again: the request is
    to be carried out again.  ended: nobody wants the answer.  left: of a refusal, whether its thread was replaced.
    cpu: processor time of the thread when it began [s].  low: whether the thread has a lower priority.
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
        """Begin. part_seconds: see `Stop`."""
        self.ticket, self.takes, self.sending = ticket, takes, sending
        self.begun = time.monotonic()
        self.thread_id = threading.get_native_id()
        self.stop = Stop(part_seconds)
        self.cpu = time.thread_time()
        self.again = self.ended = self.left = False
        self.low = ticket is not None and ticket.slow

    @property
    def client(self) -> str:
        """The client whose request it is."""
        return "" if self.ticket is None else self.ticket.client

    @property
    def turn(self) -> str:
        """The turn that the request takes."""
        return "" if self.ticket is None else self.ticket.turn

    @property
    def works(self) -> bool:
        """Whether its thread has been computing for long, and not waiting."""
        return cpu_seconds(self.thread_id) - self.cpu >= SLOW_SECONDS

    def end(self, reason: str) -> None:
        """Stop the request for good."""
        self.ended = True
        self.stop.set(reason)
