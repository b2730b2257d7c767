"""Lanes: carry one scene's requests from a channel to the service and back. Without zenoh.

A fixed number of worker threads take queries from the channel and answer them. A request that runs
for long, or whose answer its client does not accept, keeps its thread and its client's turn, but
its thread is no longer a worker: a new thread replaces it, and the slow one ends after its request.
"""

import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Collection, Iterable, Iterator
from typing import Any, NamedTuple, Protocol

from ..runtime.stop_flag import StopFlag
from ..runtime.threads import start_thread
from ..runtime.watchdog import Watchdog, lower_priority
from ..scene_interface import EncodedReply, LimitReached
from .fair_queues import FairQueues, Offer, QueueLimits, Ticket, TicketState
from .jobs import SLOW_SECONDS, ReceivedRequest, RequestJob, Wire
from .liveliness_tokens import ANONYMOUS, Tokens
from .server_config import ServerConfig

log = logging.getLogger(__name__)

# Most threads that wait without a worker, for a voxel, or for a client to accept a reply (zenoh
# closes its link after `wait_before_close`).
_MOST_WAITING = 64
# Interval at which unused avatars are dropped [s].
_DROP_SECONDS = 5.0
# Interval at which a busy worker queues all queries in the channel [s], and how many at a time. If
# it took them one by one, the query of a new client would wait behind all earlier ones.
_EMPTY_SECONDS = 0.002
_MOST_AT_HAND = 256
# A client without requests in flight may always send one request of at most this size [bytes].
_FIRST_BYTES = 1 << 16


class RequestHandler(Protocol):
    """Service that answers the requests of a lane. No method raises: an error is an answer."""

    def answer(
        self, key: str, payload: bytes, encoding: str | None, stop: StopFlag
    ) -> EncodedReply | Iterator[EncodedReply]: ...
    def busy(self, encoding: str | None, full: LimitReached) -> EncodedReply: ...
    def client_gone(self, scene: str, client: str) -> None: ...
    def drop_unused(self, scene: str, alive: Collection[str]) -> None: ...


class _ClientDisconnected(NamedTuple):
    """Marker in a client's queue, after all its requests: the client has disconnected."""

    client: str


class Lane:
    """Carrier of the requests about one scene, from the channel to the service and back.

    queries: the channel.  at_hand: takes a query from it without waiting; None if there is none.
    start: starts a named thread that runs a function with arguments.  tokens: of the clients.
    """

    def __init__(
        self,
        service: RequestHandler,
        scene: str,
        config: ServerConfig,
        queries: Iterable[Any],
        at_hand: Callable[[], Any | None],
        start: Callable[..., None],
        wire: Wire,
        tokens: Tokens,
    ) -> None:
        """Make a lane that does not take queries yet."""
        self._tokens = tokens
        self._service, self._scene, self._config = service, scene, config
        self._queries, self._at_hand, self._wire = queries, at_hand, wire
        self._start_thread = start
        self._queues = FairQueues(
            QueueLimits(
                config.workers,
                config.max_slow,
                _MOST_WAITING,
                config.max_in_flight,
                config.max_in_flight_bytes,
                config.max_in_flight_by_client,
                _FIRST_BYTES,
            )
        )
        self._lock = threading.Lock()
        self._jobs: set[RequestJob] = set()  # running now
        self._streaming: dict[
            ReceivedRequest, RequestJob
        ] = {}  # requests whose answers are being sent in parts
        self._to_start: deque[tuple[str, Callable[..., object], tuple[Any, ...]]] = deque()
        self._given_up = False
        self._emptied = 0.0  # when a worker queued all queries at hand
        self._dropped = 0.0  # when unused avatars were looked for
        self._watchdog = Watchdog(self._look)

    def start(self) -> None:
        """Start the threads."""
        # A stop does not wait for the watchdog's thread, which watches the others.
        self._watching = start_thread(f"{self._scene}-watchdog", self._watchdog.run)
        for _ in range(self._config.workers):
            self._start_taker()

    def close(self) -> None:
        """End the watchdog, once all other threads have ended."""
        self._watchdog.close()
        self._watching.join()

    @property
    def in_flight(self) -> int:
        """Return the number of requests neither answered nor dropped, and of threads to start."""
        return len(self._queues) + len(self._to_start)

    def give_up(self) -> None:
        """Stop running requests and drop waiting ones, which their clients treat as unknown."""
        self._given_up = True
        for job in [*self._jobs, *self._streaming.values()]:
            job.end("the server stops")

    def client_gone(self, client: str) -> None:
        """Stop and drop all requests of a disconnected client, then have the service forget it."""
        dropped, started = self._queues.drop(client)
        self._start(started)
        for ticket in dropped:
            if isinstance(ticket.request, ReceivedRequest):
                self._drop(ticket.request)
        for job in [*self._jobs, *self._streaming.values()]:
            if job.client == client:
                job.end("its client is gone")
        for request in list(self._streaming):
            if request.client == client:
                self._streaming.pop(request, None)
        ticket = Ticket(client, _ClientDisconnected(client), 0)
        if self._queues.offer(ticket, always=True) is Offer.RUN:
            self._start([ticket])

    # --- threads ---------------------------------------------------------------------------------------------

    def _start_taker(self) -> None:
        self._start_thread(self._scene, self._take_all)

    def _start(self, tickets: Iterable[Ticket]) -> None:
        """Carry out requests, each in a separate thread."""
        for ticket in tickets:
            self._start_thread(self._scene, self._run, ticket)

    def _hand_over(self, name: str, run: Callable[..., object], *arguments: Any) -> None:
        """Have the watchdog start a thread: a slow thread would pass on its low priority.

        The watchdog retries while the system has no thread left.
        """
        self._to_start.append((name, run, arguments))
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
        request = ReceivedRequest(query, self._wire)
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

        following: what this thread carries out next, None if nothing yet. Return that, and whether
        this thread is still a worker.
        """
        takes, number = True, 0
        while takes and number < _MOST_AT_HAND and (query := self._at_hand()) is not None:
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
        busy = self._service.busy(request.encoding, full)
        job = RequestJob(None, takes=True, sending=True)
        self._enter(job)
        try:
            with request.query as query:
                self._wire.reply(query, request.key_expr, busy, request.sealer, 0)
        finally:
            with self._lock:
                self._jobs.discard(job)
        return not job.left

    def _drop(self, request: ReceivedRequest) -> None:
        """Leave a query without an answer."""
        with request.query:
            pass

    # --- requests --------------------------------------------------------------------------------------------

    def _work(self, ticket: Ticket, takes: bool) -> bool:
        """Carry out a request, and then those that wait, until none does.

        takes: whether this thread is a worker, which takes queries. Return whether it still is.
        """
        following: Ticket | None = ticket
        while following is not None:
            left, started = self._carry_out(following, takes)
            if left:
                for each in started:
                    self._hand_over(self._scene, self._run, each)
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
                self._service.client_gone(self._scene, ticket.client)
            else:
                parts = self._answer(ticket.request, job)
        except Exception:
            log.exception("a request of client %s of scene %s failed", ticket.client, self._scene)
        finally:
            with self._lock:
                self._jobs.discard(job)
            if parts is not None:
                started = self._queues.detach(ticket)
                self._hand_over(f"{self._scene}-parts", self._stream, ticket, parts)
            elif job.again:
                started = self._queues.put_back(ticket)
            else:
                started = self._queues.finished(ticket)
        return ticket.left, started

    def _enter(self, job: RequestJob) -> None:
        """Have the watchdog watch a job."""
        with self._lock:
            self._jobs.add(job)
        if self._watchdog.asleep:
            self._watchdog.wake()

    def _answer(self, request: ReceivedRequest, job: RequestJob) -> Iterator[EncodedReply] | None:
        """Answer one query. Return an answer in parts, which a separate thread is to send."""
        if self._given_up:
            self._drop(request)
            return None
        answer = self._service.answer(request.key, request.payload, request.encoding, job.stop)
        with self._lock:
            if job.again and not job.ended:
                return None
            job.again = False
            job.begun, job.sending = time.monotonic(), True
        if not isinstance(answer, EncodedReply):
            if self._has_room(job):
                self._streaming[request] = job
                return answer
            answer = self._service.busy(request.encoding, LimitReached.PATHS)
        if job.ticket is not None and job.ticket.left:
            for ticket in self._queues.waits(job.ticket) or []:
                self._hand_over(self._scene, self._run, ticket)
        # Leaving `with query` tells the client that no more replies come.
        with request.query as query:
            self._wire.reply(query, request.key_expr, answer, request.sealer, 0)
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
            with request.query as query:
                for number, answer in enumerate(answers):
                    left = self._given_up or request not in self._streaming
                    if left or not self._wire.reply(query, request.key_expr, answer, request.sealer, number):
                        break
        except Exception:
            log.exception("sending parts to client %s of scene %s failed", request.client, self._scene)
        finally:
            self._streaming.pop(request, None)
            self._queues.release(ticket)

    # --- the watchdog ----------------------------------------------------------------------------------------

    def _look(self, now: float) -> bool:
        """Check all jobs; return whether there are any."""
        while self._to_start:
            name, run, arguments = self._to_start[0]
            self._start_thread(name, run, *arguments)
            self._to_start.popleft()
        jobs = list(self._jobs)
        for job in jobs:
            if now - job.begun >= SLOW_SECONDS:
                self._look_at(job, now)
        for job in list(self._streaming.values()):
            self._end_unheard(job, now)
        if now - self._dropped >= _DROP_SECONDS:
            self._dropped = now
            self._service.drop_unused(self._scene, self._tokens.heeded)
        return bool(jobs)

    def _end_unheard(self, job: RequestJob, now: float) -> None:
        """Stop a path of a client without a token after the time for which its avatars are kept.

        zenoh accepts replies for a closed link, so nothing reports that this client is gone.
        """
        most = self._config.avatar_seconds
        if now - job.begun >= most and self._tokens.turn(job.client) == ANONYMOUS:
            job.stop.set(
                f"the path took longer than {most:g} s, the most for a client without a liveliness token"
            )

    def _look_at(self, job: RequestJob, now: float) -> None:
        """Replace the worker of a job that takes long, and stop a job whose time is up."""
        most = self._config.max_request_seconds
        if job.ticket is None:
            with self._lock:
                replace = job in self._jobs and not job.left
                job.left = job.left or replace
            if replace and job.takes:
                self._start_taker()
            return
        if not job.low:
            self._replace(job, job.ticket)
        if not job.sending and now - job.begun >= most:
            job.stop.set(f"the request took longer than {most:g} s, the most that this server spends on one")

    def _replace(self, job: RequestJob, ticket: Ticket) -> None:
        """Start a new thread in place of the job's thread.

        A job that waits for a voxel, a client or a processor occupies only its thread; one that
        computes occupies a slow place.
        """
        left, works = ticket.left, not job.sending and job.works
        if left and not works:
            return
        started = self._queues.slow(ticket) if works else self._queues.waits(ticket)
        if started is not None:
            if works:
                job.low = True
                lower_priority(job.thread_id)
            if job.takes and not left:
                self._start_taker()
            self._start(started)
        elif works and not job.stop and ticket.state in (TicketState.WORKING, TicketState.WAITS):
            # All slow places are taken: the request waits for one without a worker, and restarts.
            with self._lock:
                job.again = not job.sending
            if job.again:
                job.stop.set("more slow requests than the server takes at a time")
