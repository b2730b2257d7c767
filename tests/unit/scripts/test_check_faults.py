"""scripts/check_faults: the addresses at which a process listens."""

import os
import socket

import pytest
from project_scripts import load_script


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


def test_an_address_that_is_not_on_loopback_is_told_apart(check_faults):
    assert check_faults._address("0100007F") == "127.0.0.1"
    assert check_faults._address("00000000000000000000000001000000") == "::1"
    assert check_faults._address("0000000000000000FFFF00000100007F").endswith("ffff:7f00:0001")
