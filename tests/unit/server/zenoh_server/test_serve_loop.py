"""Test the signals of a server: those that come while it does its first work."""

import signal
import threading

import pytest
from solidcloud.schemas.errors import CorruptError
from solidcloud.server.zenoh_server.serve_loop import _signalled

NUMBERS = (signal.SIGTERM, signal.SIGHUP)


def test_an_error_of_the_work_is_raised():
    def fails():
        raise CorruptError("record 7")

    with _signalled(*NUMBERS) as signals, pytest.raises(CorruptError, match="record 7"):
        signals.come_after(fails)


def test_a_stop_comes_before_the_end_of_the_work():
    over = threading.Event()
    with _signalled(*NUMBERS) as signals:
        signal.raise_signal(signal.SIGHUP)
        signal.raise_signal(signal.SIGTERM)
        assert not signals.come_after(lambda: over.wait(30))
        over.set()


def test_a_reload_that_is_wanted_meanwhile_comes_after_the_work():
    with _signalled(*NUMBERS) as signals:
        signal.raise_signal(signal.SIGHUP)
        signal.raise_signal(signal.SIGHUP)
        assert signals.come_after(lambda: None)
        signal.raise_signal(signal.SIGTERM)
        assert [signals.next(), signals.next()] == [signal.SIGHUP, signal.SIGTERM]
