"""The thread that looks at what is at work."""

import threading
import time

from solidcloud.server.zenoh_server.watchdog import Watchdog

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
