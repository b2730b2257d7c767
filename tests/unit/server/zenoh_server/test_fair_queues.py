"""Whose request is answered next."""

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


def test_clients_with_a_token_have_a_turn_and_all_others_share_one():
    tokens = LivelinessTokens(2)
    tokens.here("a")
    assert [tokens.turn(client) for client in "abc"] == ["a", ANONYMOUS, ANONYMOUS]
    tokens.gone("a")
    tokens.gone("nobody")
    assert tokens.turn("a") == ANONYMOUS and not tokens.heeded
