"""Parts of paths: those of all clients in turn, all of them computed or cancelled."""

import threading

import pytest
from solidcloud.schemas.errors import BadRequestError
from solidcloud.server.runtime.path_threads import PathThreads

DEADLINE = 20.0


def test_clients_take_turns():
    threads, gate, order = PathThreads("hall", 1), threading.Event(), []
    first = threads.of("a").submit(gate.wait, DEADLINE)
    while not first.running():
        assert not first.done()
    parts = [threads.of("a").submit(order.append, f"a{number}") for number in range(4)]
    parts += [threads.of(client).submit(order.append, client) for client in "bc"]
    gate.set()
    for part in parts:
        part.result(DEADLINE)
    threads.close()
    assert order == ["a0", "b", "c", "a1", "a2", "a3"]


def test_what_is_raised_is_the_parts_own():
    threads = PathThreads("hall", 2)

    def fail():
        raise ValueError("of this part")

    failed, fine = threads.of("a").submit(fail), threads.of("a").submit(str, 3)
    with pytest.raises(ValueError, match="of this part"):
        failed.result(DEADLINE)
    assert fine.result(DEADLINE) == "3"
    threads.close()


def test_what_waits_when_it_is_closed_is_cancelled():
    threads, begun, gate = PathThreads("hall", 1), threading.Event(), threading.Event()
    at_work = threads.of("a").submit(lambda: [begun.set(), gate.wait(DEADLINE)])
    waiting = threads.of("b").submit(str)
    assert begun.wait(DEADLINE)
    closing = threading.Thread(target=threads.close)
    closing.start()
    with pytest.raises(BaseException) as raised:
        waiting.result(DEADLINE)
    assert type(raised.value).__name__ == "CancelledError"
    gate.set()
    closing.join(DEADLINE)
    assert not closing.is_alive() and at_work.result(0) == [None, True]
    with pytest.raises(BadRequestError, match="closed"):
        threads.of("a").submit(str)
    threads.start()
    assert not any(thread.is_alive() for thread in threads._threads)
