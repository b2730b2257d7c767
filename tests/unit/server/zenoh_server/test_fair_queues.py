"""Whose request is answered next."""

import threading
from itertools import chain

import numpy as np
import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule
from solidcloud.server.zenoh_server.fair_queues import (
    ANONYMOUS,
    FairQueues,
    LivelinessTokens,
    Offer,
    QueueLimits,
    Ticket,
    TicketState,
)

BOUNDS = QueueLimits(workers=2, slow=1, waits=4, requests=100, size=1000, by_turn=50, first=0)


def make(**bounds):
    return FairQueues(BOUNDS._replace(**bounds))


def offered(queues, client, request, size=1, **ticket):
    """A ticket and what became of it."""
    made = Ticket(client, request, size, **ticket)
    return made, queues.offer(made)


def test_requests_of_one_client_run_one_at_a_time_and_in_order():
    queues = make()
    first, offer = offered(queues, "a", 1)
    assert offer is Offer.RUN
    second, offer = offered(queues, "a", 2)
    assert offer is Offer.WAIT
    third, _ = offered(queues, "a", 3)
    other, offer = offered(queues, "b", 4)
    assert offer is Offer.RUN
    assert queues.finished(other) == []
    assert queues.finished(first) == [second]
    assert queues.finished(second) == [third]
    assert queues.finished(third) == []
    assert len(queues) == 0


def test_a_client_whose_token_comes_late_leaves_the_shared_turn():
    queues = make(workers=2)
    running, _ = offered(queues, "a", "a0", turn=ANONYMOUS)
    waiting, _ = offered(queues, "b", "b0", turn=ANONYMOUS)
    late = [offered(queues, "c", f"c{number}", turn=ANONYMOUS)[0] for number in range(2)]
    assert queues.give_own_turn("c") == late[:1]
    assert [ticket.turn for ticket in late] == ["c", "c"]
    assert queues.finished(late[0]) == late[1:]
    assert queues.finished(running) == [waiting]
    assert queues.finished(late[1]) == queues.finished(waiting) == []
    assert len(queues) == 0


def test_a_client_that_has_begun_stays_in_the_shared_turn():
    queues = make(workers=2)
    running, _ = offered(queues, "a", "a0", turn=ANONYMOUS)
    other, _ = offered(queues, "b", "b0", turn=ANONYMOUS)
    waiting, _ = offered(queues, "a", "a1", turn=ANONYMOUS)
    assert queues.give_own_turn("a") == queues.give_own_turn("nobody") == []
    assert queues.finished(running) == [other]
    assert queues.finished(other) == [waiting]
    assert queues.give_own_turn("a") == queues.finished(waiting) == []


def test_clients_take_turns():
    queues = make(workers=1)
    ticket, _ = offered(queues, "a", "a0")
    for request in ("a1", "a2", "b1", "b2", "c1"):
        assert offered(queues, request[0], request)[1] is Offer.WAIT
    order = []
    while following := queues.finished(ticket):
        [ticket] = following
        order.append(ticket.request)
    # b and c were waiting before a's turn was over, and nobody gets two turns while another waits.
    assert order == ["b1", "c1", "a1", "b2", "a2"]


def test_what_is_over_the_bounds_is_refused():
    queues = make(workers=1, requests=2, size=100)
    first, _ = offered(queues, "a", 1, 60)
    assert offered(queues, "b", 2, 60)[1] is Offer.FULL, "bytes"
    second, offer = offered(queues, "b", 2, 40)
    assert offer is Offer.WAIT
    assert offered(queues, "c", 3, 1)[1] is Offer.FULL, "requests"
    third = Ticket("c", 4, 1)
    assert queues.offer(third, always=True) is Offer.WAIT
    assert queues.finished(first) == [second]
    assert queues.finished(second) == [third]
    assert queues.finished(third) == []
    assert offered(queues, "a", 5, 1000)[1] is Offer.RUN, "one alone is never refused"


def test_a_turn_with_nothing_in_flight_always_has_room():
    """However many turns have filled the queues; but for what is large."""
    queues = make(workers=1, requests=4, size=100, first=10)
    first, _ = offered(queues, "a", 1, 60)
    for number in range(2, 5):
        assert offered(queues, "a", number, 10)[1] is Offer.WAIT
    assert offered(queues, "a", 5)[1] is Offer.FULL
    assert offered(queues, "b", 6, 11)[1] is Offer.FULL, "large"
    newcomer, offer = offered(queues, "b", 7, 10)
    assert offer is Offer.WAIT
    assert offered(queues, "b", 8)[1] is Offer.FULL, "it has one in flight"
    assert queues.finished(first) == [newcomer]


def test_only_the_client_with_too_many_requests_is_refused():
    queues = make(by_turn=3)
    for number in range(3):
        offered(queues, "flood", number)
    assert offered(queues, "flood", 3)[1] is Offer.FULL_TURN
    assert offered(queues, "other", 4)[1] is Offer.RUN


def test_a_slow_request_gives_up_its_worker_and_keeps_its_turn():
    queues = make(workers=1)
    heavy, _ = offered(queues, "heavy", 1)
    other, offer = offered(queues, "other", 2)
    assert offer is Offer.WAIT
    assert queues.move_to_slow(heavy) == [other] and heavy.left
    again, offer = offered(queues, "heavy", 3)
    assert offer is Offer.WAIT, "the turn is kept"
    assert queues.finished(other) == []
    assert queues.finished(heavy) == [again] and not again.left


def test_slow_requests_are_bounded():
    queues = make(workers=2, slow=1)
    first, _ = offered(queues, "a", 1)
    second, _ = offered(queues, "b", 2)
    assert queues.move_to_slow(first) == []
    assert queues.move_to_slow(first) is None, "it is slow already"
    assert queues.move_to_slow(second) is None, "no place"
    assert queues.put_back(second) == [], "it waits for a place and holds no worker"
    third, offer = offered(queues, "c", 3)
    assert offer is Offer.RUN
    assert second.state is TicketState.DONE and not second.left
    [again] = queues.finished(first)
    assert again.request == 2 and again.state is TicketState.SLOW and again.left
    assert queues.move_to_waiting(second) is None and again.state is TicketState.SLOW, (
        "the old ticket is over"
    )
    assert queues.finished(third) == queues.finished(again) == []
    assert queues.move_to_slow(again) is None, "it is answered"
    assert len(queues) == 0


def test_a_request_that_is_slow_from_the_start_takes_no_worker():
    queues = make(workers=1, slow=1)
    first, offer = offered(queues, "a", 1, slow=True)
    assert offer is Offer.START and first.left
    second, offer = offered(queues, "b", 2, slow=True)
    assert offer is Offer.WAIT
    quick, offer = offered(queues, "c", 3)
    assert offer is Offer.RUN
    assert queues.finished(first) == [second]
    assert queues.finished(quick) == queues.finished(second) == []


def test_what_is_put_back_comes_before_what_its_client_asked_after():
    queues = make(workers=1, slow=1)
    slow, _ = offered(queues, "a", 1, slow=True)
    heavy, _ = offered(queues, "b", 2)
    after, _ = offered(queues, "b", 3)
    assert queues.put_back(heavy) == []
    [again] = queues.finished(slow)
    assert again.request == 2 and queues.finished(again) == [after]
    assert after.state is TicketState.WORKING


def test_an_answer_on_its_way_holds_neither_worker_nor_slow_place():
    queues = make(workers=1, slow=1, waits=2)
    first, _ = offered(queues, "a", 1)
    assert queues.move_to_waiting(first) == []
    second, _ = offered(queues, "b", 2, slow=True)
    third, _ = offered(queues, "c", 3, slow=True)
    assert queues.move_to_waiting(second) == [third]
    assert queues.move_to_waiting(third) is None, "bounded"
    assert offered(queues, "a", 4)[1] is Offer.WAIT, "the turn is kept"
    assert [ticket.request for ticket in queues.finished(first)] == [4]


def test_a_request_that_waited_takes_a_slow_place_once_it_computes():
    queues = make(workers=1, slow=1)
    first, _ = offered(queues, "a", 1)
    assert queues.move_to_waiting(first) == []
    assert queues.move_to_slow(first) == [] and first.state is TicketState.SLOW
    second, _ = offered(queues, "b", 2)
    assert queues.move_to_waiting(second) == []
    assert queues.move_to_slow(second) is None, "no place"
    assert queues.put_back(second) == [] and second.left, "whoever carried it out has no worker"
    assert [ticket.request for ticket in queues.finished(first)] == [2]


def test_clients_that_share_a_turn_are_answered_one_at_a_time():
    queues = make(by_turn=3)
    first, offer = offered(queues, "x", 1, turn="")
    assert offer is Offer.RUN
    second, offer = offered(queues, "y", 2, turn="")
    assert offer is Offer.WAIT
    assert offered(queues, "z", 3, turn="")[1] is Offer.WAIT
    assert offered(queues, "new", 4, turn="")[1] is Offer.FULL_TURN, "the bound is of all that share"
    assert offered(queues, "own", 5)[1] is Offer.RUN
    assert queues.finished(first) == [second]


def test_a_client_stays_in_its_turn_while_it_has_requests_in_flight():
    queues = make()
    first, _ = offered(queues, "x", 1, turn="")
    second, offer = offered(queues, "x", 2)
    assert offer is Offer.WAIT and second.turn == ""
    assert queues.finished(first) == [second]
    assert queues.finished(second) == []
    assert offered(queues, "x", 3)[0].turn == "x"


def test_waiting_requests_of_a_client_that_is_gone_are_dropped():
    queues = make(workers=1, slow=1)
    first, _ = offered(queues, "x", 1, turn="")
    dropped = [offered(queues, "x", number, turn="")[0] for number in (2, 3)]
    other, _ = offered(queues, "y", 4, turn="")
    assert queues.drop("x") == (dropped, []) and queues.drop("nobody") == ([], [])
    assert queues.finished(first) == [other]
    waiting, _ = offered(queues, "z", 5)
    assert queues.drop("z") == ([waiting], []), "with nothing at work"
    assert queues.finished(other) == [] and len(queues) == 0


def test_what_waited_behind_a_dropped_request_begins():
    queues = make(workers=1, slow=1)
    slow, _ = offered(queues, "a", 1, slow=True)
    first, _ = offered(queues, "x", 2, turn="", slow=True)
    second, _ = offered(queues, "y", 3, turn="")
    assert queues.drop("x") == ([first], [second]) and second.state is TicketState.WORKING
    assert queues.finished(second) == queues.finished(slow) == []


def test_a_detached_request_takes_up_neither_a_worker_nor_its_clients_turn():
    queues = make(workers=1, requests=3)
    path, _ = offered(queues, "path", 1, 60)
    other, _ = offered(queues, "other", 2)
    assert queues.detach(path) == [other]
    again, offer = offered(queues, "path", 3)
    assert offer is Offer.WAIT
    assert offered(queues, "third", 4)[1] is Offer.FULL, "what is detached counts until it is released"
    assert queues.finished(other) == [again]
    queues.release(path)
    assert len(queues) == 1
    assert queues.finished(again) == []
    assert len(queues) == 0
    alone, offer = offered(queues, "other", 5, 1000)
    assert offer is Offer.RUN, "its bytes are released too"
    assert queues.detach(alone) == []


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


AnyOrder.TestCase.settings = settings(max_examples=500, stateful_step_count=60, deadline=None)
TestAnyOrder = AnyOrder.TestCase


@pytest.mark.parametrize("seed", [0, 1])
def test_nothing_is_forgotten_by_several_threads(seed):
    queues = make(workers=3, slow=2, requests=10**6, size=10**9, by_turn=10**6)
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


def test_clients_with_a_token_have_a_turn_and_all_others_share_one():
    tokens = LivelinessTokens(2)
    tokens.here("a")
    assert [tokens.turn(client) for client in "abc"] == ["a", ANONYMOUS, ANONYMOUS]
    tokens.gone("a")
    tokens.gone("nobody")
    assert tokens.turn("a") == ANONYMOUS and not tokens.heeded


def test_so_many_tokens_are_heeded_and_the_next_once_one_goes():
    tokens = LivelinessTokens(2)
    for client in "abcdefg":
        tokens.here(client)
    assert tokens.heeded == {"a", "b"} and tokens.turn("c") == ANONYMOUS
    tokens.gone("d")
    tokens.gone("a")
    assert tokens.heeded == {"b", "c"}
    tokens.gone("b")
    assert tokens.heeded == {"c"}, "e came when as many waited as are remembered"
    tokens.here("e")
    assert tokens.turn("e") == "e"
