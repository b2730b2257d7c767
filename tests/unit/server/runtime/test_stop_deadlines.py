"""The thread that sets the flags of requests whose time is up."""

import gc
import time
import weakref

import pytest
from solidcloud.server.runtime import stop_flag as stop_module
from solidcloud.server.runtime.stop_flag import Deadlines, StopFlag

DEADLINE = 20.0
FAR = 1e9


def is_set(stop):
    deadline = time.monotonic() + DEADLINE
    while not stop:
        assert time.monotonic() < deadline, "never set"
        time.sleep(0.002)
    return stop.reason


def test_each_flag_is_set_at_its_time_whatever_the_order():
    deadlines, now = Deadlines(), time.perf_counter()
    order = []

    class Noted(StopFlag):
        def set(self, reason):
            order.append(reason)
            super().set(reason)

    stops = [Noted() for _ in range(3)]
    never = StopFlag()
    deadlines.add(never, now + FAR, "never")
    for stop, when in zip(stops, (0.3, 0.1, 0.2), strict=True):
        deadlines.add(stop, now + when, str(when))
    assert [is_set(stop) for stop in stops] == ["0.3", "0.1", "0.2"]
    assert order == ["0.1", "0.2", "0.3"] and not never
    past = StopFlag()
    deadlines.add(past, now, "past")
    assert is_set(past) == "past"


def test_flags_that_nobody_has_any_more_are_dropped():
    deadlines, now = Deadlines(), time.perf_counter()
    kept = StopFlag()
    deadlines.add(kept, now + FAR, "kept")
    dropped = StopFlag()
    gone = weakref.ref(dropped)
    deadlines.add(dropped, now + 0.01, "dropped")
    del dropped
    gc.collect()
    assert gone() is None
    after = StopFlag()
    deadlines.add(after, now + 0.02, "after")
    assert is_set(after) == "after" and not kept


def test_a_thread_that_could_not_be_started_is_started_by_the_next_deadline(monkeypatch):
    deadlines, start, failures = Deadlines(), stop_module.start_loop, [1]

    def starting(*what):
        if failures:
            failures.pop()
            raise RuntimeError("can't start new thread")
        return start(*what)

    monkeypatch.setattr(stop_module, "start_loop", starting)
    first, second = StopFlag(), StopFlag()
    with pytest.raises(RuntimeError, match="can't start"):
        deadlines.add(first, time.perf_counter(), "first")
    deadlines.add(second, time.perf_counter(), "second")
    assert (is_set(first), is_set(second)) == ("first", "second")
