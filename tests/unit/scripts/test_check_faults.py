"""Test scripts/check_faults: the addresses on which a process listens."""

import os
import socket

import numpy as np
import pytest
from project_scripts import load_script
from solidcloud.schemas.wire.answers import Verdict


@pytest.fixture(scope="module")
def check_faults():
    return load_script("check_faults")


@pytest.mark.parametrize(
    ("family", "host"), [(socket.AF_INET, "127.0.0.1"), (socket.AF_INET, "0.0.0.0"), (socket.AF_INET6, "::1")]
)
@pytest.mark.parametrize("kind", [socket.SOCK_STREAM, socket.SOCK_DGRAM])
def test_every_socket_that_can_be_reached_is_found(check_faults, family, host, kind):
    with socket.socket(family, kind) as own:
        try:
            own.bind((host, 0))
        except OSError:
            pytest.skip(f"this machine has no {host}")
        if kind == socket.SOCK_STREAM:
            assert f"{host}:{own.getsockname()[1]}" not in check_faults._sockets(os.getpid())
            own.listen()
        assert f"{host}:{own.getsockname()[1]}" in check_faults._sockets(os.getpid())


def test_an_answer_is_of_no_server_from_the_kill_to_the_next_start(check_faults):
    truth = np.array([Verdict.CLEAR, Verdict.CONTACT])
    unknown = np.full(2, Verdict.UNKNOWN)
    away = [(10.0, 14.0), (20.0, 25.0)]

    def judged(begin, end, verdict):
        return check_faults.judged([(begin, end, verdict)], truth, away)

    for begin, end in ((10.0, 10.1), (13.0, 14.0), (20.0, 24.9)):
        found = judged(begin, end, truth)
        assert (found["asked_while_away"], found["known_while_away"], found["wrong_verdicts"]) == (1, 1, 0)
        assert judged(begin, end, unknown)["known_while_away"] == 0
    for begin, end in ((9.9, 10.1), (13.0, 14.1), (15.0, 16.0), (13.0, 21.0)):
        assert judged(begin, end, truth)["asked_while_away"] == 0
    assert judged(1.0, 2.0, truth[::-1])["wrong_verdicts"] == 2


def test_an_address_that_is_not_on_loopback_is_told_apart(check_faults):
    assert check_faults._address("0100007F") == "127.0.0.1"
    assert check_faults._address("00000000000000000000000001000000") == "::1"
    assert check_faults._address("0000000000000000FFFF00000100007F").endswith("ffff:7f00:0001")
