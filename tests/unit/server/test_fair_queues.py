"""Whose request is answered next."""

import threading

import numpy as np
from solidcloud.server.fair_queues import FairQueues, Offer


def test_requests_of_one_client_run_one_at_a_time_and_in_order():
    queues = FairQueues(2, 10, 1000)
    assert queues.offer("a", 1, 1) is Offer.RUN
    assert queues.offer("a", 2, 1) is Offer.WAIT
    assert queues.offer("a", 3, 1) is Offer.WAIT
    assert queues.offer("b", 4, 1) is Offer.RUN
    assert queues.finished("b") is None
    assert queues.finished("a") == ("a", 2)
    assert queues.finished("a") == ("a", 3)
    assert queues.finished("a") is None
    assert len(queues) == 0


def test_clients_take_turns():
    queues = FairQueues(1, 100, 1000)
    assert queues.offer("a", "a0", 1) is Offer.RUN
    for request in ("a1", "a2", "b1", "b2", "c1"):
        assert queues.offer(request[0], request, 1) is Offer.WAIT
    order, client = [], "a"
    while (following := queues.finished(client)) is not None:
        client, request = following
        order.append(request)
    # b and c were waiting before a's turn was over, and nobody gets two turns while another waits.
    assert order == ["b1", "c1", "a1", "b2", "a2"]


def test_a_client_in_flight_holds_one_worker_only():
    queues = FairQueues(2, 100, 1000)
    assert queues.offer("frozen", 1, 1) is Offer.RUN
    for _ in range(5):
        assert queues.offer("frozen", 2, 1) is Offer.WAIT
        assert queues.offer("other", 3, 1) is Offer.RUN
        assert queues.finished("other") is None


def test_what_is_over_the_bounds_is_refused():
    queues = FairQueues(1, 2, 100)
    assert queues.offer("a", 1, 60) is Offer.RUN
    assert queues.offer("b", 2, 60) is Offer.FULL, "bytes"
    assert queues.offer("b", 2, 40) is Offer.WAIT
    assert queues.offer("c", 3, 0) is Offer.FULL, "requests"
    assert queues.offer("c", 4, 0, always=True) is Offer.WAIT
    assert queues.finished("a") == ("b", 2)
    assert queues.finished("b") == ("c", 4)
    assert queues.finished("c") is None
    assert queues.offer("a", 5, 1000) is Offer.RUN, "one alone is never refused"


def test_a_detached_request_takes_up_neither_a_worker_nor_its_clients_turn():
    queues = FairQueues(1, 3, 1000)
    assert queues.offer("path", 1, 60) is Offer.RUN
    assert queues.offer("other", 2, 1) is Offer.WAIT
    assert queues.detach("path") == (60, ("other", 2))
    assert queues.offer("path", 3, 1) is Offer.WAIT
    assert queues.offer("third", 4, 1) is Offer.FULL, "what is detached counts until it is released"
    assert queues.finished("other") == ("path", 3)
    queues.release(60)
    assert len(queues) == 1
    assert queues.finished("path") is None
    assert len(queues) == 0
    assert queues.offer("other", 5, 1000) is Offer.RUN, "its bytes are released too"
    assert queues.detach("other") == (1000, None)


def test_nothing_is_forgotten_by_several_threads():
    queues = FairQueues(3, 10**6, 10**9)
    lock, seen, at_work, others = threading.Lock(), [], {}, []

    def run(client, request):
        following = (client, request)
        while following is not None:
            client, request = following
            with lock:
                assert client not in at_work and len(at_work) < 3
                at_work[client] = request
                seen.append((client, request))
            with lock:
                del at_work[client]
            if request % 7 == 0:  # its answer goes on in a thread of its own
                size, following = queues.detach(client)
                other = threading.Thread(target=queues.release, args=(size,))
                other.start()
                others.append(other)
            else:
                following = queues.finished(client)

    def offer(seed):
        rng = np.random.default_rng(seed)
        for request in range(500):
            client = (seed, int(rng.integers(3)))
            if queues.offer(client, request, 1) is Offer.RUN:
                run(client, request)

    threads = [threading.Thread(target=offer, args=(seed,)) for seed in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(20)
    while others:
        others.pop().join(20)
    assert len(seen) == 2000 and len(queues) == 0
    for client in {client for client, _ in seen}:
        requests = [request for owner, request in seen if owner == client]
        assert requests == sorted(requests)
