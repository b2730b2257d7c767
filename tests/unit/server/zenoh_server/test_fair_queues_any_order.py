"""Test the fair queues with operations in any order, and with several threads."""

import threading
from itertools import chain

import numpy as np
import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule
from solidcloud.server.zenoh_server.fair_queues import (
    FairQueues,
    Offer,
    QueueLimits,
    Ticket,
    TicketState,
)


class AnyOrder(RuleBasedStateMachine):
    """Every accepted request runs, in the order of its client, within the bounds, whatever happens in between."""

    def __init__(self):
        super().__init__()
        self.bounds = QueueLimits(workers=2, slow=2, waits=2, requests=12, size=40, by_turn=4, first=2)
        self.queues = FairQueues(self.bounds)
        self.at_work, self.detached, self.waiting = [], [], {}
        self.number = 0

    def started(self, tickets):
        for ticket in tickets:
            assert ticket.state is (TicketState.SLOW if ticket.slow else TicketState.WORKING)
            assert self.waiting[ticket.client].pop(0).request == ticket.request, "the order of the client"
            self.at_work.append(ticket)

    @rule(
        client=st.sampled_from("abcdef"),
        size=st.integers(0, 20),
        slow=st.booleans(),
        shared=st.booleans(),
        always=st.booleans(),
    )
    def offer(self, client, size, slow, shared, always):
        self.number += 1
        ticket = Ticket(client, self.number, size, turn="" if shared else None, slow=slow)
        everything = [*self.at_work, *self.detached, *chain(*self.waiting.values())]
        offer = self.queues.offer(ticket, always=always and len(everything) < 30)
        if offer in (Offer.FULL, Offer.FULL_TURN):
            own = [other for other in everything if other.turn == ticket.turn]
            total = sum(other.size for other in everything)
            if offer is Offer.FULL_TURN:
                assert len(own) >= self.bounds.by_turn
            else:
                assert own or size > self.bounds.first
                assert len(everything) >= self.bounds.requests or total + size > self.bounds.size
            return
        self.waiting.setdefault(client, []).append(ticket)
        if offer is not Offer.WAIT:
            assert (offer is Offer.START) == slow
            self.started([ticket])

    @precondition(lambda self: self.at_work)
    @rule(data=st.data())
    def finish(self, data):
        ticket = self.at_work.pop(data.draw(st.integers(0, len(self.at_work) - 1)))
        self.started(self.queues.finished(ticket))

    @precondition(lambda self: self.at_work)
    @rule(data=st.data())
    def slow(self, data):
        started = self.queues.move_to_slow(data.draw(st.sampled_from(self.at_work)))
        self.started(started or [])

    @precondition(lambda self: self.at_work)
    @rule(data=st.data())
    def send(self, data):
        started = self.queues.move_to_waiting(data.draw(st.sampled_from(self.at_work)))
        self.started(started or [])

    @precondition(lambda self: self.at_work)
    @rule(data=st.data())
    def put_back(self, data):
        ticket = data.draw(st.sampled_from(self.at_work))
        self.at_work.remove(ticket)
        again = Ticket(ticket.client, ticket.request, ticket.size, turn=ticket.turn, slow=True)
        self.waiting.setdefault(ticket.client, []).insert(0, again)
        self.started(self.queues.put_back(ticket))

    @precondition(lambda self: self.at_work)
    @rule(data=st.data())
    def detach(self, data):
        ticket = self.at_work.pop(data.draw(st.integers(0, len(self.at_work) - 1)))
        self.detached.append(ticket)
        self.started(self.queues.detach(ticket))

    @precondition(lambda self: self.detached)
    @rule()
    def release(self):
        self.queues.release(self.detached.pop())

    @rule(client=st.sampled_from("abcdef"))
    def drop(self, client):
        dropped, started = self.queues.drop(client)
        expected = [ticket.request for ticket in self.waiting.pop(client, [])]
        assert [ticket.request for ticket in dropped] == expected
        self.started(started)

    @rule(client=st.sampled_from("abcdef"))
    def token(self, client):
        began = any(ticket.client == client for ticket in [*self.at_work, *self.detached])
        started = self.queues.give_own_turn(client)
        for ticket in self.waiting.get(client, []):
            ticket.turn = ticket.turn if began else client
        self.started(started)

    @invariant()
    def bounds_hold(self):
        states = [ticket.state for ticket in self.at_work]
        assert states.count(TicketState.WORKING) <= self.bounds.workers
        assert states.count(TicketState.SLOW) <= self.bounds.slow
        assert states.count(TicketState.WAITS) <= self.bounds.waits
        turns = [ticket.turn for ticket in self.at_work]
        assert len(turns) == len(set(turns)), "one of each turn"
        waiting = list(chain(*self.waiting.values()))
        assert len(self.queues) == len(self.at_work) + len(self.detached) + len(waiting)
        # What could run does.
        for slow, state, most in (
            (False, TicketState.WORKING, self.bounds.workers),
            (True, TicketState.SLOW, self.bounds.slow),
        ):
            if states.count(state) < most:
                heads = [
                    ticket
                    for ticket in waiting
                    if ticket.turn not in turns and ticket.slow == slow and self.is_first(ticket)
                ]
                assert heads == []

    def is_first(self, ticket):
        """Whether nothing of the same turn waits before it; within a turn the lowest number that was not put back."""
        return self.queues._turns[ticket.turn].waiting[0].request == ticket.request

    def teardown(self):
        while self.at_work:
            self.started(self.queues.finished(self.at_work.pop()))
        for ticket in self.detached:
            self.queues.release(ticket)
        assert len(self.queues) == 0 and not any(self.waiting.values()), "nothing is forgotten"
        assert not self.queues._turns and not self.queues._clients


AnyOrder.TestCase.settings = settings(max_examples=60, stateful_step_count=60, deadline=None)


TestAnyOrder = AnyOrder.TestCase


@pytest.mark.parametrize("seed", [0, 1])
def test_nothing_is_forgotten_by_several_threads(seed):
    queues = FairQueues(
        QueueLimits(workers=3, slow=2, waits=4, requests=10**6, size=10**9, by_turn=10**6, first=0)
    )
    lock, seen, at_work, others = threading.Lock(), [], set(), []

    def start(tickets):
        for ticket in tickets:
            thread = threading.Thread(target=run, args=(ticket,))
            with lock:
                thread.start()
                others.append(thread)

    def run(ticket):
        while ticket is not None:
            with lock:
                assert ticket.turn not in at_work
                at_work.add(ticket.turn)
                seen.append(ticket)
            if ticket.request % 5 == 0:
                start(queues.move_to_slow(ticket) or [])
            if ticket.request % 11 == 0:
                start(queues.move_to_waiting(ticket) or [])
            with lock:
                at_work.remove(ticket.turn)
            if ticket.request % 7 == 0:  # its answer goes on in a thread of its own
                following = queues.detach(ticket)
                queues.release(ticket)
            else:
                following = queues.finished(ticket)
            ticket = None if ticket.left or not following else following.pop(0)
            start(following)

    def offer(number):
        rng = np.random.default_rng((seed, number))
        for request in range(300):
            ticket = Ticket(f"{number}-{rng.integers(3)}", request, 1, slow=bool(request % 13 == 0))
            offer = queues.offer(ticket)
            if offer is Offer.RUN:
                run(ticket)
            elif offer is Offer.START:
                start([ticket])

    threads = [threading.Thread(target=offer, args=(number,)) for number in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(20)
    while others:
        others.pop().join(20)
    assert len(seen) == 1200 and len(queues) == 0
    for client in {ticket.client for ticket in seen}:
        requests = [ticket.request for ticket in seen if ticket.client == client]
        assert requests == sorted(requests)
