"""Endpoints: what zenoh could not open is refused in words, before zenoh sees it."""

import pytest
from solidcloud.schemas.errors import BadRequestError
from solidcloud.server.zenoh_common.endpoints import canonical, check_endpoint


@pytest.mark.parametrize(
    "endpoint",
    [
        "tcp/127.0.0.1:7447",
        "tcp/[::1]:7447",
        "tcp/localhost:7447",
        "udp/127.0.0.1:7447",
        "ws/127.0.0.1:7447",
        "unixsock-stream//tmp/a.sock",
        "tcp/127.0.0.1:7447#iface=lo",
    ],
)
def test_endpoints_that_zenoh_opens(endpoint):
    assert check_endpoint(endpoint, "listen") == endpoint


@pytest.mark.parametrize(
    ("endpoint", "says"),
    [
        (
            "127.0.0.1:7551",
            "not PROTOCOL/ADDRESS: expected one such as tcp/127.0.0.1:7447: write tcp/127.0.0.1:7551",
        ),
        ("here", "not PROTOCOL/ADDRESS"),
        ("", "not PROTOCOL/ADDRESS"),
        ("tcp/127.0.0.1 :7447", "not PROTOCOL/ADDRESS"),
        ("tls/127.0.0.1:7447", "tls needs certificates, which this version does not support"),
        ("quic/127.0.0.1:7447", "quic needs certificates"),
        ("serial//dev/ttyS0", "protocol 'serial': expected one of tcp"),
        ("tcp/127.0.0.1", "is not HOST:PORT"),
        ("tcp/127.0.0.1:65536", "is not HOST:PORT with a port of 1 to 65535"),
        ("tcp/:7447", "is not HOST:PORT"),
        ("unixsock-stream//tmp/\udcff", "not PROTOCOL/ADDRESS"),
    ],
)
def test_endpoints_that_zenoh_does_not_open_are_refused_in_words(endpoint, says):
    with pytest.raises(BadRequestError, match="--connect") as error:
        check_endpoint(endpoint, "--connect")
    assert says in str(error.value)


def test_names_of_one_endpoint_are_one():
    same = (
        "tcp/127.0.0.1:7447",
        "tcp/localhost:7447",
        "tcp/0.0.0.0:7447",
        "tcp/[::]:7447",
        "tcp/LOCALHOST:07447",
    )
    assert {canonical(endpoint) for endpoint in same} == {"tcp/127.0.0.1:7447"}
    others = (
        "tcp/127.0.0.1:7448",
        "tcp/127.0.0.2:7447",
        "tcp/[::1]:7447",
        "udp/127.0.0.1:7447",
        "unixsock-stream//tmp/a",
    )
    assert {canonical(endpoint) for endpoint in others} == set(others)
