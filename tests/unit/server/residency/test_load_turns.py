"""Turns to load: order, stop flag, deadline, and a turn that takes too long."""

import threading
import time

from solidcloud.server.residency.load_turns import MAX_TURN_SECONDS, LoadTurns
from solidcloud.server.runtime.stop_flag import NO_STOP, StopFlag

NO_DEADLINE = float("inf")


def until(condition, seconds: float = 20.0) -> bool:
    deadline = time.monotonic() + seconds
    while not condition() and time.monotonic() < deadline:
        time.sleep(0.001)
    return condition()


def start(run) -> threading.Thread:
    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    return thread


def test_one_request_at_a_time_first_come_first_served(monkeypatch) -> None:
    monkeypatch.setattr("solidcloud.server.residency.load_turns.MAX_TURN_SECONDS", 60.0)
    turns, order, holding = LoadTurns(), [], []
    first = turns.take(NO_DEADLINE, NO_STOP)

    def request(number: int) -> None:
        turn = turns.take(NO_DEADLINE, NO_STOP)
        holding.append(number)
        assert holding == [number], "two requests have a turn"
        order.append(number)
        time.sleep(0.002)
        holding.remove(number)
        turns.give_back(turn)

    threads = []
    for number in range(8):
        threads.append(start(lambda number=number: request(number)))
        assert until(lambda number=number: len(turns._queue) == number + 1)
    assert not order
    turns.give_back(first)
    for thread in threads:
        thread.join(20.0)
    assert order == list(range(8))


def test_a_turn_that_takes_too_long_keeps_nobody_waiting() -> None:
    turns = LoadTurns()
    first = turns.take(NO_DEADLINE, NO_STOP)
    second = turns.take(NO_DEADLINE, NO_STOP)  # waits for MAX_TURN_SECONDS, not for `first`
    assert second is not None and second is turns._current
    turns.give_back(first)
    assert turns._current is second, "the end of an overlong turn ended another request's"
    turns.give_back(second)
    turns.give_back(second)
    assert turns._current is None and not turns._queue


def test_a_stop_and_a_deadline_end_the_wait_and_leave_the_queue(monkeypatch) -> None:
    monkeypatch.setattr("solidcloud.server.residency.load_turns.MAX_TURN_SECONDS", 60.0)
    turns, stop, said = LoadTurns(), StopFlag(), []
    first = turns.take(NO_DEADLINE, NO_STOP)
    assert turns.take(time.perf_counter() + MAX_TURN_SECONDS, NO_STOP) is None
    waiting = start(lambda: said.append(turns.take(NO_DEADLINE, stop)))
    assert until(lambda: len(turns._queue) == 1)
    stop.set("the client is gone")
    waiting.join(20.0)
    assert said == [None] and not turns._queue
    turns.give_back(None)
    assert turns._current is first
