"""The thread that looks at what is at work."""

import os
import sys
import threading
import time

import pytest
from solidcloud.server.zenoh_server.watchdog import Watchdog, cpu_seconds, lower_priority

DEADLINE = 20.0


def eventually(condition):
    deadline = time.monotonic() + DEADLINE
    while not condition():
        assert time.monotonic() < deadline, "never came true"
        time.sleep(0.005)


def running(watchdog):
    thread = threading.Thread(target=watchdog.run)
    thread.start()
    return thread


def test_it_looks_while_there_is_something_and_sleeps_after():
    looks, busy = [], [True]

    def look(now):
        looks.append(now)
        return busy[0]

    watchdog = Watchdog(look, idle=10 * DEADLINE)
    thread = running(watchdog)
    try:
        eventually(lambda: len(looks) > 5 and not watchdog.asleep)
        busy[0] = False
        eventually(lambda: watchdog.asleep)
        before = len(looks)
        busy[0] = True
        watchdog.wake()
        eventually(lambda: len(looks) > before + 5)
    finally:
        watchdog.close()
        thread.join(DEADLINE)
    assert not thread.is_alive() and looks == sorted(looks)


def test_a_look_that_raises_does_not_end_it():
    looks = []

    def look(now):
        looks.append(now)
        raise RuntimeError("as such")

    watchdog = Watchdog(look)
    thread = running(watchdog)
    eventually(lambda: len(looks) > 3)
    watchdog.close()
    thread.join(DEADLINE)
    assert not thread.is_alive()


@pytest.mark.skipif(sys.platform != "linux", reason="priorities of threads")
def test_the_priority_of_one_thread_is_lowered():
    go, found = threading.Event(), []

    def run():
        found.append(threading.get_native_id())
        assert go.wait(DEADLINE)
        found.append(os.getpriority(os.PRIO_PROCESS, 0))

    before = os.getpriority(os.PRIO_PROCESS, 0)
    thread = threading.Thread(target=run)
    thread.start()
    eventually(lambda: found)
    lower_priority(found[0])
    go.set()
    thread.join(DEADLINE)
    assert found[1] == min(19, before + 10) and os.getpriority(os.PRIO_PROCESS, 0) == before
    lower_priority(2**22 + 1)  # of no thread


@pytest.mark.skipif(sys.platform != "linux", reason="times of threads")
def test_the_processor_time_of_a_thread_is_told():
    before = cpu_seconds(threading.get_native_id())
    begin = time.thread_time()
    while time.thread_time() < begin + 0.05:
        pass
    assert 0.04 < cpu_seconds(threading.get_native_id()) - before < DEADLINE
    assert abs(cpu_seconds(threading.get_native_id()) - time.thread_time()) < 1.0
    assert cpu_seconds(2**22 + 1) == float("inf")
