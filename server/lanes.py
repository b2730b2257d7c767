"""The way of one scene's questions from a channel to the service and back: threads, turns, deadlines. No zenoh here.

A fixed number of worker threads take queries from the channel and answer them. A request that is at work for long, or
whose answer its client does not take, keeps its thread and its client's turn but is no worker any more: a fresh thread
takes the worker's place, and the slow one ends after its request.
"""

import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Collection, Iterable, Iterator
from typing import Any, NamedTuple, Protocol

from ..schemas import keys
from ..schemas.encoding import JSON
from ..schemas.errors import BadRequestError
from .config import ServerConfig
from .fair_queues import Bounds, FairQueues, Offer, State, Ticket
from .served import Answer
from .stop import Stop
from .watchdog import Watchdog, lower_priority

log = logging.getLogger(__name__)

# How long a request may hold a worker [s]. More than nearly all take, and what others may have to wait for it.
SLOW_SECONDS = 0.01
# Payloads that are slow for sure [bytes]: building an avatar of 5,000 points takes 20 ms, reading JSON 50 ns a byte.
_SLOW_BYTES, _SLOW_AVATAR_BYTES, _SLOW_JSON_BYTES = 1 << 20, 1 << 17, 1 << 17
# Threads that wait for a client to take a reply; zenoh closes the client's link after `wait_before_close`.
_MOST_SENDING = 64
# How often avatars that nobody uses are looked for [s].
_DROP_SECONDS = 5.0
# The turn of all clients without a liveliness token; no client's name. zenoh does not tell which session a query comes
# from: `Query.source_info` holds what the asker put there, by default nothing.
_ANONYMOUS = ""


class Questions(Protocol):
    """What answers the questions of a lane. No method raises: an error is an answer too."""

    def answer(
        self, key: str, payload: bytes, encoding: str | None, stop: Stop
    ) -> Answer | Iterator[Answer]: ...
    def busy(self, encoding: str | None, own: bool = False) -> Answer: ...
    def client_gone(self, scene: str, client: str) -> None: ...
    def drop_unused(self, scene: str, alive: Collection[str]) -> None: ...


class Wire(NamedTuple):
    """How a lane reads and answers queries.

    sealer: returns what seals the replies to a query, of its key expression and payload.  reply: sends an answer under
    a key, sealed, with its number among the replies; False where that fails.
    """

    encoding: Callable[[Any], str | None]
    sealer: Callable[[Any, str, bytes], Any]
    reply: Callable[[Any, Any, Answer, Any, int], bool]


class _Gone(NamedTuple):
    """Takes a request's place in a client's queue: the client went, after all it had asked before."""

    client: str


class _Request:
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


class _Job:
    """What one thread does at present.

    ticket: of the request it carries out; None: it refuses one.  takes: whether the thread takes queries from the
    channel, so that another must take its place.  begun: when it began, or began to send [s].  again: the request is
    to be carried out again.  ended: nobody wants the answer.  left: of a refusal, whether its thread was replaced.
    """

    __slots__ = ("again", "begun", "ended", "left", "sending", "stop", "takes", "thread_id", "ticket")

    def __init__(self, ticket: Ticket | None, takes: bool, *, sending: bool = False) -> None:
        """Begin."""
        self.ticket, self.takes, self.sending = ticket, takes, sending
        self.begun = time.monotonic()
        self.thread_id = threading.get_native_id()
        self.stop = Stop()
        self.again = self.ended = self.left = False

    @property
    def client(self) -> str:
        """The client whose request it is."""
        return "" if self.ticket is None else self.ticket.client

    def end(self, reason: str) -> None:
        """Stop the request for good."""
        self.ended = True
        self.stop.set(reason)


class Lane:
    """The questions about one scene, from the channel to the service and back.

    queries: the channel.  start: starts a thread of a name that runs a function with arguments.
    """

    def __init__(
        self,
        service: Questions,
        scene: str,
        config: ServerConfig,
        queries: Iterable[Any],
        start: Callable[..., None],
        wire: Wire,
    ) -> None:
        """Make a lane that does not take queries yet."""
        self._service, self._scene, self._config = service, scene, config
        self._queries, self._wire = queries, wire
        self._start_thread = start
        self._queues = FairQueues(
            Bounds(
                config.workers,
                config.max_slow,
                _MOST_SENDING,
                config.max_in_flight,
                config.max_in_flight_bytes,
                config.max_in_flight_by_client,
            )
        )
        self._lock = threading.Lock()
        self._alive: set[str] = set()  # clients with a liveliness token
        self._jobs: set[_Job] = set()  # at work now
        self._streaming: dict[_Request, _Job] = {}  # whose answers are on their way in parts
        self._to_start: deque[Ticket] = deque()
        self._given_up = False
        self._dropped = 0.0  # when unused avatars were looked for
        self._watchdog = Watchdog(self._look)

    def start(self) -> None:
        """Start the threads."""
        # Not one of those that a stop waits for: it watches them.
        name = f"solidcloud-{self._scene}-watchdog"
        self._watching = threading.Thread(target=self._watchdog.run, name=name, daemon=True)
        self._watching.start()
        for _ in range(self._config.workers):
            self._start_taker()

    def close(self) -> None:
        """End the watchdog, once all other threads have ended."""
        self._watchdog.close()
        self._watching.join()

    def give_up(self) -> None:
        """Stop what is at work, and drop what waits: its clients take it for unknown."""
        self._given_up = True
        for job in [*self._jobs, *self._streaming.values()]:
            job.end("the server stops")

    def client_here(self, client: str) -> None:
        """Give a client a turn of its own: its liveliness token is there."""
        self._alive.add(client)

    def client_gone(self, client: str) -> None:
        """Stop and drop all requests of a client whose liveliness token went, then have the service forget it."""
        self._alive.discard(client)
        for ticket in self._queues.drop(client):
            if isinstance(ticket.request, _Request):
                self._drop(ticket.request)
        for job in [*self._jobs, *self._streaming.values()]:
            if job.client == client:
                job.end("its client is gone")
        for request in list(self._streaming):
            if request.client == client:
                self._streaming.pop(request, None)
        ticket = Ticket(client, _Gone(client), 0)
        if self._queues.offer(ticket, always=True) is Offer.RUN:
            self._start([ticket])

    # --- threads ---------------------------------------------------------------------------------------------

    def _start_taker(self) -> None:
        self._start_thread(self._scene, self._take_all)

    def _start(self, tickets: Iterable[Ticket]) -> None:
        """Carry out requests, each in a thread of its own."""
        for ticket in tickets:
            self._start_thread(self._scene, self._run, ticket)

    def _hand_over(self, tickets: Iterable[Ticket]) -> None:
        """Have the watchdog start requests: threads that a slow thread starts would have its low priority."""
        self._to_start.extend(tickets)
        self._watchdog.wake()

    def _take_all(self) -> None:
        """Take queries, and answer them or leave them to a thread that is at work. A worker's work."""
        for query in self._queries:
            try:
                if not self._take(query):
                    return
            except Exception:  # of this query alone: the thread goes on with the next
                log.exception("a query of scene %s", self._scene)

    def _run(self, ticket: Ticket) -> None:
        """Carry out a request, and what follows. The work of a thread that takes no queries."""
        if ticket.slow:
            lower_priority(threading.get_native_id())
        self._work(ticket, takes=False)

    def _take(self, query: Any) -> bool:
        """Answer a query, or leave it to a thread that is at work. Returns whether this thread is still a worker."""
        request = _Request(query, self._wire)
        client = request.client
        turn = client if client in self._alive else _ANONYMOUS
        ticket = Ticket(client, request, len(request.payload), turn=turn, slow=request.slow)
        offer = self._queues.offer(ticket)
        if offer is Offer.RUN:
            return self._work(ticket, takes=True)
        if offer is Offer.START:
            self._start([ticket])
        elif offer is not Offer.WAIT:
            return self._refuse(request, offer)
        return True

    def _refuse(self, request: _Request, offer: Offer) -> bool:
        """Answer that there is no room. Returns whether this thread is still a worker."""
        busy = self._service.busy(request.encoding, offer is Offer.FULL_TURN)
        job = _Job(None, takes=True, sending=True)
        self._enter(job)
        try:
            with request.query as query:
                self._wire.reply(query, request.key_expr, busy, request.sealer, 0)
        finally:
            with self._lock:
                self._jobs.discard(job)
        return not job.left

    def _drop(self, request: _Request) -> None:
        """Leave a query without an answer."""
        with request.query:
            pass

    # --- requests --------------------------------------------------------------------------------------------

    def _work(self, ticket: Ticket, takes: bool) -> bool:
        """Carry out a request, and then what waits, until nothing does.

        Returns whether this thread is still a worker.
        """
        following: Ticket | None = ticket
        while following is not None:
            left, started = self._carry_out(following, takes)
            if left:
                self._hand_over(started)
                return False
            following = next((each for each in started if not each.slow), None)
            self._start(each for each in started if each is not following)
        return True

    def _carry_out(self, ticket: Ticket, takes: bool) -> tuple[bool, list[Ticket]]:
        """Carry out one request. Returns whether it gave up its worker, and the tickets to be started."""
        job = _Job(ticket, takes)
        self._enter(job)
        parts = None
        try:
            if isinstance(ticket.request, _Gone):
                self._service.client_gone(self._scene, ticket.client)
            else:
                parts = self._answer(ticket.request, job)
        except Exception:
            log.exception("request of client %s of scene %s", ticket.client, self._scene)
        finally:
            with self._lock:
                self._jobs.discard(job)
            if parts is not None:
                started = self._queues.detach(ticket)
                self._start_thread(f"{self._scene}-parts", self._stream, ticket, parts, job)
            elif job.again:
                return False, self._queues.put_back(ticket)
            else:
                started = self._queues.finished(ticket)
        return ticket.left, started

    def _enter(self, job: _Job) -> None:
        """Have a job watched."""
        with self._lock:
            self._jobs.add(job)
        if self._watchdog.asleep:
            self._watchdog.wake()

    def _answer(self, request: _Request, job: _Job) -> Iterator[Answer] | None:
        """Have one query answered. What comes in parts is returned, to be sent by a thread of its own."""
        if self._given_up:
            self._drop(request)
            return None
        answer = self._service.answer(request.key, request.payload, request.encoding, job.stop)
        with self._lock:
            if job.again and not job.ended:
                return None
            job.again = False
            job.begun, job.sending = time.monotonic(), True
        if not isinstance(answer, Answer):
            # One client may take half of the room, so that there is always some for another.
            most = self._config.max_paths
            own = sum(other.client == request.client for other in list(self._streaming))
            if len(self._streaming) < most and own < max(1, most // 2):
                self._streaming[request] = job
                return answer
            answer = self._service.busy(request.encoding)
        if job.ticket is not None and job.ticket.left:
            self._hand_over(self._queues.sending(job.ticket) or [])
        # Leaving `with query` tells the client that no more will come.
        with request.query as query:
            self._wire.reply(query, request.key_expr, answer, request.sealer, 0)
        return None

    def _stream(self, ticket: Ticket, answers: Iterator[Answer], job: _Job) -> None:
        """Send an answer's parts. A thread's work."""
        request = ticket.request
        try:
            with request.query as query:
                for number, answer in enumerate(answers):
                    left = self._given_up or request not in self._streaming
                    if left or not self._wire.reply(query, request.key_expr, answer, request.sealer, number):
                        break
        except Exception:
            log.exception("parts for client %s of scene %s", request.client, self._scene)
        finally:
            self._streaming.pop(request, None)
            self._queues.release(ticket)

    # --- the watchdog ----------------------------------------------------------------------------------------

    def _look(self, now: float) -> bool:
        """Look at all jobs; returns whether there are any."""
        while self._to_start:
            self._start([self._to_start.popleft()])
        jobs = list(self._jobs)
        for job in jobs:
            if now - job.begun >= SLOW_SECONDS:
                self._look_at(job, now)
        if now - self._dropped >= _DROP_SECONDS:
            self._dropped = now
            self._service.drop_unused(self._scene, frozenset(self._alive))
        return bool(jobs)

    def _look_at(self, job: _Job, now: float) -> None:
        """Take the worker of a job that has been at work for long, and stop one whose time is up."""
        most = self._config.max_request_seconds
        if job.ticket is None:
            with self._lock:
                replace = job in self._jobs and not job.left
                job.left = job.left or replace
            if replace and job.takes:
                self._start_taker()
            return
        if not job.ticket.left:
            self._replace(job, job.ticket)
        if not job.sending and now - job.begun >= most:
            job.stop.set(f"the request took longer than {most:g} s, the most that this server spends on one")

    def _replace(self, job: _Job, ticket: Ticket) -> None:
        """Have a fresh thread go on in the place of a job's."""
        sending = job.sending
        started = self._queues.sending(ticket) if sending else self._queues.slow(ticket)
        if started is not None:
            if not sending:
                lower_priority(job.thread_id)
            if job.takes:
                self._start_taker()
            self._start(started)
        elif not sending and not job.stop and ticket.state is State.WORKING:
            # All slow places are taken: the request waits for one without a worker, and begins anew.
            with self._lock:
                job.again = not job.sending
            if job.again:
                job.stop.set("more slow requests than the server takes at a time")
