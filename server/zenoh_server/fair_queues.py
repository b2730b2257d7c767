"""Fair queues of requests: one request of each client at a time, clients round-robin.

A *turn* is a queue that is served one request at a time: that of one client, or of all clients
without a liveliness token. A request is *quick* until it has been running for longer than the
watchdog allows, or *slow* from the start. Quick requests share the workers. Slow ones keep their
turn but hold no worker; their number is bounded too.
"""

import threading
from collections import deque
from enum import Enum
from typing import Any, NamedTuple

# Turn of all clients without a liveliness token; no client has this name.
ANONYMOUS = ""


class Offer(Enum):
    """Outcome of offering a request."""

    RUN = "run it now"
    START = "run it now, in a separate thread: it is slow"
    WAIT = "it waits; the end of another request starts it"
    FULL = "refused: the server has too many requests in flight"
    FULL_TURN = "refused: this client has too many requests in flight"


class TicketState(Enum):
    """State of an accepted request."""

    WAITING = "in its turn's queue"
    WORKING = "holds a worker and its turn"
    SLOW = "holds its turn and a place among the slow ones"
    WAITS = "holds its turn; it waits for something, or its answer is on the way"
    DETACHED = "holds nothing but its bytes"
    DONE = "answered, or dropped"


class QueueLimits(NamedTuple):
    """Bounds of the queues.

    workers: running quick requests.  slow: running slow requests.
    waits: requests that hold no worker because they wait, for example for their client to accept
    the reply.
    requests, size: requests accepted and not yet answered, and their bytes.
    by_turn: requests in flight of one turn.
    first: a turn without requests in flight may always add one of up to this size [bytes], so that
    no client can lock out another.
    """

    workers: int
    slow: int
    waits: int
    requests: int
    size: int
    by_turn: int
    first: int


class Ticket:
    """One request in the queues.

    client: the client that sent it.  turn: the turn it takes, by default its client's.
    size: its bytes.  slow: whether it needs a slow place to run.
    request: any object; the queues do not use it.
    left: whether the request no longer holds a worker. The thread that runs it must then not start
    another request.
    """

    __slots__ = ("client", "left", "request", "size", "slow", "state", "turn")

    def __init__(
        self, client: str, request: Any, size: int, *, turn: str | None = None, slow: bool = False
    ) -> None:
        """Make a ticket that has not been offered."""
        self.client, self.request, self.size, self.slow = client, request, size, slow
        self.turn = client if turn is None else turn
        self.state, self.left = TicketState.WAITING, False

    def __repr__(self) -> str:
        """Return the ticket as text, for test messages."""
        return f"Ticket({self.client!r}, {self.request!r}, {self.state.name})"


class _Turn:
    """Requests of one turn. busy: whether one of them is running.  count: requests in flight."""

    __slots__ = ("busy", "count", "waiting")

    def __init__(self) -> None:
        self.waiting: deque[Ticket] = deque()
        self.busy, self.count = False, 0


class FairQueues:
    """Bounded queues, one a turn, served round-robin with one running request each. Thread-safe.

    A turn belongs to one client, or is shared by several clients. The requests of one client stay
    in order: while it has requests in flight, new ones take the same turn. The caller bounds the
    number of turns: a small request of a turn that has nothing in flight is always accepted.

    Methods that free a place return the tickets to start. For each of these tickets, and for each
    offer answered with RUN or START, the caller must call `finished` or `put_back` once, or
    `detach` and later `release`. Every waiting request is then started.
    """

    def __init__(self, bounds: QueueLimits) -> None:
        """Make empty queues."""
        self._bounds = bounds
        self._lock = threading.Lock()
        self._turns: dict[str, _Turn] = {}
        self._clients: dict[str, tuple[str, int]] = {}  # client: its turn, its requests in flight
        # Turns with waiting requests and none running, by whether the first one needs a slow place.
        self._ready: dict[bool, deque[str]] = {False: deque(), True: deque()}
        self._at_work = dict.fromkeys((TicketState.WORKING, TicketState.SLOW, TicketState.WAITS), 0)
        self._requests = self._bytes = 0

    def offer(self, ticket: Ticket, *, always: bool = False) -> Offer:
        """Accept or refuse a request. always: accept it even if a bound is reached."""
        with self._lock:
            ticket.turn, own = self._clients.get(ticket.client, (ticket.turn, 0))
            turn = self._turns.get(ticket.turn)
            if not always and self._requests and (turn is not None or ticket.size > self._bounds.first):
                if turn is not None and turn.count >= self._bounds.by_turn:
                    return Offer.FULL_TURN
                if self._requests >= self._bounds.requests or self._bytes + ticket.size > self._bounds.size:
                    return Offer.FULL
            if turn is None:
                turn = self._turns[ticket.turn] = _Turn()
            self._requests += 1
            self._bytes += ticket.size
            turn.count += 1
            self._clients[ticket.client] = ticket.turn, own + 1
            if not turn.busy and not turn.waiting and self._has_place(ticket.slow):
                self._begin(ticket, turn)
                return Offer.START if ticket.slow else Offer.RUN
            turn.waiting.append(ticket)
            if not turn.busy and len(turn.waiting) == 1:
                self._ready[ticket.slow].append(ticket.turn)
            return Offer.WAIT

    def finished(self, ticket: Ticket) -> list[Ticket]:
        """End a running request; return the tickets to start."""
        with self._lock:
            self._leave(ticket, TicketState.DONE)
            self._forget(ticket)
            return self._start_waiting()

    def put_back(self, ticket: Ticket) -> list[Ticket]:
        """Requeue a running request as slow, with a new ticket, before all others of its turn.

        The old ticket ends with its `left` unchanged. Return the tickets to start.
        """
        again = Ticket(ticket.client, ticket.request, ticket.size, turn=ticket.turn, slow=True)
        with self._lock:
            self._leave(ticket, TicketState.DONE, ready=False)
            self._turns[again.turn].waiting.appendleft(again)
            self._ready[True].append(again.turn)
            return self._start_waiting()

    def move_to_slow(self, ticket: Ticket) -> list[Ticket] | None:
        """Move a request that has been computing for too long to a slow place; it keeps its turn.

        Return the tickets to start; None if it has a slow place, does not run, or all slow places
        are taken.
        """
        with self._lock:
            held = ticket.state in (TicketState.WORKING, TicketState.WAITS)
            if not held or self._at_work[TicketState.SLOW] >= self._bounds.slow:
                return None
            self._move(ticket, TicketState.SLOW)
            return self._start_waiting()

    def move_to_waiting(self, ticket: Ticket) -> list[Ticket] | None:
        """Free the worker or slow place of a request that only waits; it keeps its turn.

        Return the tickets to start; None if it holds neither, or too many requests wait like this.
        """
        with self._lock:
            held = ticket.state in (TicketState.WORKING, TicketState.SLOW)
            if not held or self._at_work[TicketState.WAITS] >= self._bounds.waits:
                return None
            self._move(ticket, TicketState.WAITS)
            return self._start_waiting()

    def detach(self, ticket: Ticket) -> list[Ticket]:
        """Free worker and turn of a request that continues alone; return the tickets to start."""
        with self._lock:
            self._leave(ticket, TicketState.DETACHED)
            return self._start_waiting()

    def release(self, ticket: Ticket) -> None:
        """End a detached request."""
        with self._lock:
            ticket.state = TicketState.DONE
            self._forget(ticket)

    def drop(self, client: str) -> tuple[list[Ticket], list[Ticket]]:
        """Remove the waiting requests of a client.

        Return them, and the tickets to start: requests of other clients of its turn may have waited
        behind them.
        """
        with self._lock:
            if client not in self._clients:
                return [], []
            name = self._clients[client][0]
            turn = self._turns[name]
            dropped = [ticket for ticket in turn.waiting if ticket.client == client]
            if not dropped:
                return [], []
            if not turn.busy:
                self._ready[turn.waiting[0].slow].remove(name)
            turn.waiting = deque(ticket for ticket in turn.waiting if ticket.client != client)
            if not turn.busy and turn.waiting:
                self._ready[turn.waiting[0].slow].append(name)
            for ticket in dropped:
                ticket.state = TicketState.DONE
                self._forget(ticket)
            return dropped, self._start_waiting()

    def give_own_turn(self, client: str) -> list[Ticket]:
        """Move a client's waiting requests from a shared turn to its own; return those to start.

        Nothing moves while one of its requests is running, so that its requests stay in order.
        """
        with self._lock:
            name, count = self._clients.get(client, (client, 0))
            if name == client:
                return []
            shared = self._turns[name]
            own = _Turn()
            own.waiting.extend(ticket for ticket in shared.waiting if ticket.client == client)
            if len(own.waiting) < count:
                return []
            if not shared.busy:
                self._ready[shared.waiting[0].slow].remove(name)
            shared.waiting = deque(ticket for ticket in shared.waiting if ticket.client != client)
            shared.count -= count
            if not shared.busy and shared.waiting:
                self._ready[shared.waiting[0].slow].append(name)
            if not shared.count:
                del self._turns[name]
            own.count = count
            for ticket in own.waiting:
                ticket.turn = client
            self._turns[client], self._clients[client] = own, (client, count)
            self._ready[own.waiting[0].slow].append(client)
            return self._start_waiting()

    def __len__(self) -> int:
        """Return the number of requests accepted and not yet answered."""
        with self._lock:
            return self._requests

    def _has_place(self, slow: bool) -> bool:
        """Return whether one more request may run."""
        if slow:
            return self._at_work[TicketState.SLOW] < self._bounds.slow
        return self._at_work[TicketState.WORKING] < self._bounds.workers

    def _begin(self, ticket: Ticket, turn: _Turn) -> None:
        """Start a request."""
        ticket.state = TicketState.SLOW if ticket.slow else TicketState.WORKING
        ticket.left = ticket.slow
        turn.busy = True
        self._at_work[ticket.state] += 1

    def _move(self, ticket: Ticket, state: TicketState) -> None:
        """Move a running request from its place to another one."""
        self._at_work[ticket.state] -= 1
        self._at_work[state] += 1
        ticket.state, ticket.left = state, True

    def _leave(self, ticket: Ticket, state: TicketState, *, ready: bool = True) -> None:
        """Free the place of a running request. ready: let the next one of its turn begin."""
        self._at_work[ticket.state] -= 1
        ticket.state = state
        turn = self._turns[ticket.turn]
        turn.busy = False
        if ready and turn.waiting:
            self._ready[turn.waiting[0].slow].append(ticket.turn)

    def _forget(self, ticket: Ticket) -> None:
        """Remove a request from the counts."""
        self._requests -= 1
        self._bytes -= ticket.size
        turn = self._turns[ticket.turn]
        turn.count -= 1
        if not turn.count:
            del self._turns[ticket.turn]
        name, own = self._clients[ticket.client]
        if own == 1:
            del self._clients[ticket.client]
        else:
            self._clients[ticket.client] = name, own - 1

    def _start_waiting(self) -> list[Ticket]:
        """Start waiting requests while places are free."""
        started: list[Ticket] = []
        for slow, ready in self._ready.items():
            while ready and self._has_place(slow):
                turn = self._turns[ready.popleft()]
                ticket = turn.waiting.popleft()
                self._begin(ticket, turn)
                started.append(ticket)
        return started


class LivelinessTokens:
    """Liveliness tokens of a scene's clients. One thread calls `here` and `gone`; any thread reads.

    A client with a token has its own turn in the fair queues; all clients without a token share
    one. zenoh does not report which session a query comes from: `Query.source_info` holds what the
    sender put there, by default nothing.

    Any process can declare any number of tokens, so their number is bounded. The first `most`
    tokens are *heeded*, and up to `most` further ones wait until a heeded token disappears. A
    client whose token is not heeded is treated as one without a token.
    """

    def __init__(self, most: int) -> None:
        """Begin without tokens. most: tokens that are heeded at a time."""
        self._most = most
        self._heeded: dict[str, None] = {}
        self._waiting: dict[str, None] = {}  # in order of arrival

    def here(self, client: str) -> None:
        """Record that the token of a client has appeared."""
        if client in self._heeded or len(self._heeded) < self._most:
            self._heeded[client] = None
        elif len(self._waiting) < self._most:
            self._waiting[client] = None

    def gone(self, client: str) -> None:
        """Record that the token of a client has disappeared."""
        self._waiting.pop(client, None)
        if client not in self._heeded:
            return
        del self._heeded[client]
        if self._waiting:
            following = next(iter(self._waiting))
            del self._waiting[following]
            self._heeded[following] = None

    def turn(self, client: str) -> str:
        """Return the turn of a client: its own name, or that of all clients without a token."""
        return client if client in self._heeded else ANONYMOUS

    @property
    def heeded(self) -> frozenset[str]:
        """Return the clients that have their own turn."""
        return frozenset(self._heeded)
