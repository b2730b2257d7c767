"""Lanes: each carries the requests for a scene from zenoh to the dispatcher, and the replies back.

A fixed number of worker threads take queries from zenoh's channel and answer them. A request that
runs for long, or whose answer its client does not accept, keeps its thread and its client's turn.
Its thread is then no longer a worker: a new thread replaces it, and the slow one ends after its
request (watchdog.py).
"""

import logging
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from typing import Any, NamedTuple

import zenoh

from ...schemas.errors import BadRequestError
from ...schemas.wire import key_expressions
from ...schemas.wire.encoding import JSON
from ...schemas.wire.request_limits import FIRST_REQUEST_BYTES
from ..runtime.threads import start_thread
from ..scene_interface import EncodedReply, LimitReached
from ..zenoh_common.sealed_replies import encoding_of, sealer_of, send_reply
from .fair_queues import ANONYMOUS, FairQueues, LivelinessTokens, Offer, QueueLimits, Ticket
from .request_dispatcher import RequestDispatcher
from .server_config import ServerConfig
from .watchdog import JobSupervisor, RequestJob, Watchdog, lower_priority

log = logging.getLogger(__name__)

# Limit on the threads that are not workers and wait: for a voxel, or for a client to accept a reply
# (zenoh closes its link after `wait_before_close`).
_MAX_WAITING = 64
# Interval at which unused avatars are dropped [s].
_DROP_SECONDS = 5.0
# Interval at which a busy worker queues all queries in the channel [s], and how many at a time. If
# it took them one by one, the query of a new client would wait behind all earlier ones.
_EMPTY_SECONDS = 0.002
_MAX_TAKEN = 256
# Size from which on a request is slow [bytes]: of most payloads, and of avatars and JSON. Building
# an avatar of 5,000 points takes 20 ms, reading JSON 50 ns a byte.
_SLOW_BYTES, _SLOW_AVATAR_BYTES = 1 << 20, 1 << 17


def take_waiting(channel: Any) -> Any:
    """Take a query or sample from a zenoh channel without waiting.

    Return None when the channel is empty or has ended.
    """
    try:
        return channel.try_recv()
    except zenoh.ZError:
        return None


class ReceivedRequest:
    """Query with its properties, read once: each access to a property of a query makes a copy."""

    __slots__ = ("_key_expr", "_sealer", "client", "encoding", "key", "operation", "payload", "query")

    def __init__(self, query: Any, server_key: bytes) -> None:
        """Read a query. server_key: the key that seals its replies."""
        self.query, self.encoding = query, encoding_of(query)
        self._key_expr = query.key_expr
        self.key = str(self._key_expr)
        try:
            route = key_expressions.parse_query_key(self.key)
            self.client, self.operation = route.client, route.operation
        except BadRequestError:
            self.client = self.operation = ""  # the dispatcher will refuse the key expression
        payload = query.payload
        self.payload = b"" if payload is None else payload.to_bytes()
        self._sealer = sealer_of(query, server_key, self.key, self.payload)

    @property
    def slow(self) -> bool:
        """Return whether the request is slow because of its size."""
        size = len(self.payload)
        if size < _SLOW_AVATAR_BYTES:
            return False
        return size >= _SLOW_BYTES or self.operation == "add_avatar" or self.encoding == JSON

    def send(self, reply: EncodedReply, number: int = 0) -> bool:
        """Send one reply; return False if that fails. number: of the reply, increasing."""
        return send_reply(self.query, self._key_expr, reply, self._sealer, number)

    def end(self) -> None:
        """Tell the client that no more replies come."""
        with self.query:
            pass


class _ClientDisconnected(NamedTuple):
    """Marker in a client's queue, after all its requests: the client has disconnected."""

    client: str


class Lane:
    """Carrier of the requests about one scene, from the channel to the dispatcher and back."""

    def __init__(
        self,
        dispatcher: RequestDispatcher,
        scene: str,
        config: ServerConfig,
        queries: Any,
        start: Callable[..., None],
        server_key: bytes,
        tokens: LivelinessTokens,
    ) -> None:
        """Make a lane that does not take queries yet.

        queries: the channel of zenoh's queries.  start: starts a named thread that runs a function
        with arguments.  server_key: seals the replies.  tokens: of the scene's clients.
        """
        self._dispatcher, self._scene, self._config = dispatcher, scene, config
        self._queries, self._server_key, self._tokens = queries, server_key, tokens
        self._start_thread = start
        self._queues = FairQueues(
            QueueLimits(
                config.workers,
                config.max_slow,
                _MAX_WAITING,
                config.max_in_flight,
                config.max_in_flight_bytes,
                config.max_in_flight_by_client,
                FIRST_REQUEST_BYTES,
            )
        )
        self._supervisor = JobSupervisor(
            config.max_request_seconds, self._queues, start, self._start_worker, self._start
        )
        self._streaming: dict[ReceivedRequest, RequestJob] = {}  # whose answers are being sent in parts
        self._given_up = False
        self._emptied = 0.0  # when a worker queued all queries in the channel
        self._dropped = 0.0  # when unused avatars were looked for
        self._watchdog = Watchdog(self._check)

    def start(self) -> None:
        """Start the threads."""
        # A stop does not wait for the watchdog's thread, which watches the others.
        self._watching = start_thread(f"{self._scene}-watchdog", self._watchdog.run)
        for _ in range(self._config.workers):
            self._start_worker()

    def close(self) -> None:
        """End the watchdog, once all other threads have ended."""
        self._watchdog.close()
        self._watching.join()

    @property
    def in_flight(self) -> int:
        """Return the number of requests neither answered nor dropped, and of threads to start."""
        return len(self._queues) + self._supervisor.threads_to_start

    def give_up(self) -> None:
        """Stop running requests and drop waiting ones, which their clients treat as unknown."""
        self._given_up = True
        for job in [*self._supervisor.jobs, *self._streaming.values()]:
            job.end("the server stops")

    def client_here(self, client: str) -> None:
        """Give a client with a token its own turn, also for requests that came before the token."""
        if self._tokens.turn(client) == client:
            self._start(self._queues.give_own_turn(client))

    def client_gone(self, client: str) -> None:
        """Stop and drop all requests of a disconnected client, then notify the dispatcher."""
        dropped, started = self._queues.drop(client)
        self._start(started)
        for ticket in dropped:
            if isinstance(ticket.request, ReceivedRequest):
                ticket.request.end()
        for job in [*self._supervisor.jobs, *self._streaming.values()]:
            if job.client == client:
                job.end("its client is gone")
        for request in list(self._streaming):
            if request.client == client:
                self._streaming.pop(request, None)
        ticket = Ticket(client, _ClientDisconnected(client), 0)
        if self._queues.offer(ticket, always=True) is Offer.RUN:
            self._start([ticket])

    # --- threads ---------------------------------------------------------------------------------

    def _start_worker(self) -> None:
        self._start_thread(self._scene, self._take_all)

    def _start(self, tickets: Iterable[Ticket]) -> None:
        """Carry out requests, each in a separate thread."""
        for ticket in tickets:
            self._start_thread(self._scene, self._run, ticket)

    def _start_later(self, name: str, run: Callable[..., object], *arguments: Any) -> None:
        """Let the watchdog start a thread, which would inherit a slow thread's low priority."""
        self._supervisor.start_later(name, run, *arguments)
        self._watchdog.wake()

    def _take_all(self) -> None:
        """Take queries, and answer them or leave them to a running thread. Runs in a worker."""
        for query in self._queries:
            try:
                if not self._take(query):
                    return
            except Exception:  # affects this query only
                log.exception("a query of scene %s failed", self._scene)

    def _run(self, ticket: Ticket) -> None:
        """Carry out a request and those that follow. Runs in a thread that takes no queries."""
        if ticket.slow:
            lower_priority(threading.get_native_id())
        self._work(ticket, takes=False)

    def _take(self, query: Any) -> bool:
        """Answer a query or leave it to a running thread; return whether this is still a worker."""
        ticket, takes = self._accept(query)
        return takes if ticket is None else self._work(ticket, takes)

    def _accept(self, query: Any) -> tuple[Ticket | None, bool]:
        """Queue a query, or refuse it.

        Return its ticket if this thread is to run it, and whether this thread is still a worker.
        """
        request = ReceivedRequest(query, self._server_key)
        client = request.client
        turn = self._tokens.turn(client)
        ticket = Ticket(client, request, len(request.payload), turn=turn, slow=request.slow)
        offer = self._queues.offer(ticket)
        if offer is Offer.RUN:
            return ticket, True
        if offer is Offer.START:
            self._start([ticket])
        elif offer is not Offer.WAIT:
            return None, self._refuse(request, offer)
        return None, True

    def _empty(self, following: Ticket | None) -> tuple[Ticket | None, bool]:
        """Queue the queries that wait in the channel.

        following: ticket that this thread carries out next, None if there is none yet. Return the
        next ticket, and whether this thread is still a worker.
        """
        takes, number = True, 0
        while takes and number < _MAX_TAKEN and (query := take_waiting(self._queries)) is not None:
            number += 1
            try:
                ticket, takes = self._accept(query)
            except Exception:  # affects this query only
                log.exception("a query of scene %s failed", self._scene)
                continue
            if following is None:
                following = ticket
            elif ticket is not None:
                self._start([ticket])
        self._emptied = time.monotonic()
        return following, takes

    def _refuse(self, request: ReceivedRequest, offer: Offer) -> bool:
        """Answer `busy`; return whether this thread is still a worker."""
        full = LimitReached.OWN_REQUESTS if offer is Offer.FULL_TURN else LimitReached.REQUESTS
        busy = self._dispatcher.busy(request.encoding, full)
        job = RequestJob(None, takes=True, sending=True)
        self._enter(job)
        try:
            with request.query:
                request.send(busy)
        finally:
            self._supervisor.remove(job)
        return not job.left

    # --- requests --------------------------------------------------------------------------------

    def _work(self, ticket: Ticket, takes: bool) -> bool:
        """Carry out a request, and then those that wait, until none does.

        takes: whether this thread is a worker, which takes queries. Return whether it still is.
        """
        following: Ticket | None = ticket
        while following is not None:
            left, started = self._carry_out(following, takes)
            if left:
                for each in started:
                    self._start_later(self._scene, self._run, each)
                return False
            following = next((each for each in started if not each.slow), None)
            self._start(each for each in started if each is not following)
            if takes and time.monotonic() - self._emptied >= _EMPTY_SECONDS:
                following, takes = self._empty(following)
        return takes

    def _carry_out(self, ticket: Ticket, takes: bool) -> tuple[bool, list[Ticket]]:
        """Carry out a request; return whether it gave up its worker, and the tickets to start."""
        job = RequestJob(ticket, takes, part_seconds=self._config.max_request_seconds)
        self._enter(job)
        parts = None
        try:
            if isinstance(ticket.request, _ClientDisconnected):
                self._dispatcher.client_gone(self._scene, ticket.client)
            else:
                parts = self._answer(ticket.request, job)
        except Exception:
            log.exception("a request of client %s of scene %s failed", ticket.client, self._scene)
        finally:
            self._supervisor.remove(job)
            if parts is not None:
                started = self._queues.detach(ticket)
                self._start_later(f"{self._scene}-parts", self._stream, ticket, parts)
            elif job.again:
                started = self._queues.put_back(ticket)
            else:
                started = self._queues.finished(ticket)
        return ticket.left, started

    def _enter(self, job: RequestJob) -> None:
        """Supervise a job with the watchdog."""
        self._supervisor.add(job)
        if self._watchdog.asleep:
            self._watchdog.wake()

    def _answer(self, request: ReceivedRequest, job: RequestJob) -> Iterator[EncodedReply] | None:
        """Answer one query. Return an answer in parts, which a separate thread is to send."""
        if self._given_up:
            request.end()
            return None
        answer = self._dispatcher.answer(request.key, request.payload, request.encoding, job.stop)
        with self._supervisor.lock:
            if job.again and not job.ended:
                return None
            job.again = False
            job.begun, job.sending = time.monotonic(), True
        if not isinstance(answer, EncodedReply):
            if self._has_room(job):
                self._streaming[request] = job
                return answer
            answer = self._dispatcher.busy(request.encoding, LimitReached.PATHS)
        if job.ticket is not None and job.ticket.left:
            for ticket in self._queues.move_to_waiting(job.ticket) or []:
                self._start_later(self._scene, self._run, ticket)
        # Leaving `with query` tells the client that no more replies come.
        with request.query:
            request.send(answer)
        return None

    def _has_room(self, job: RequestJob) -> bool:
        """Return whether one more answer may be sent in parts.

        One turn may take half of the places, so that some are always left for others.
        """
        most, streaming = self._config.max_paths, list(self._streaming.values())
        own = sum(other.turn == job.turn for other in streaming)
        return len(streaming) < most and own < max(1, most // 2)

    def _stream(self, ticket: Ticket, answers: Iterator[EncodedReply]) -> None:
        """Send the parts of an answer. Runs in a thread."""
        request = ticket.request
        try:
            with request.query:
                for number, answer in enumerate(answers):
                    left = self._given_up or request not in self._streaming
                    if left or not request.send(answer, number):
                        break
        except Exception:
            log.exception("sending parts to client %s of scene %s failed", request.client, self._scene)
        finally:
            self._streaming.pop(request, None)
            self._queues.release(ticket)

    # --- the watchdog ----------------------------------------------------------------------------

    def _check(self, now: float) -> bool:
        """Check all jobs and paths; return whether there are any jobs."""
        running = self._supervisor.check(now)
        for job in list(self._streaming.values()):
            self._end_unheard(job, now)
        if now - self._dropped >= _DROP_SECONDS:
            self._dropped = now
            self._dispatcher.drop_unused(self._scene, self._tokens.heeded)
        return running

    def _end_unheard(self, job: RequestJob, now: float) -> None:
        """Stop a path of a client without a token after the time for which its avatars are kept.

        zenoh accepts replies for a closed link, so the server cannot detect that the client is
        gone.
        """
        most = self._config.avatar_seconds
        if now - job.begun >= most and self._tokens.turn(job.client) == ANONYMOUS:
            job.stop.set(
                f"the path took longer than {most:g} s, the most for a client without a liveliness token"
            )
