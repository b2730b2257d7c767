"""What a server may be set to."""

import pytest
from solidcloud.schemas.errors import BadRequestError
from solidcloud.server.zenoh_common.endpoints import is_loopback
from solidcloud.server.zenoh_server.server_config import ServerConfig


@pytest.mark.parametrize(
    "endpoint",
    [
        "tcp/127.0.0.1:7447",
        "tcp/127.8.9.1:0",
        "tcp/localhost:7447",
        "tcp/[::1]:7447",
        "unixsock-stream//tmp/a.sock",
    ],
)
def test_loopback_endpoints(endpoint):
    assert is_loopback(endpoint)
    assert ServerConfig(listen=endpoint).listen == endpoint


@pytest.mark.parametrize(
    "endpoint",
    [
        "tcp/0.0.0.0:7447",
        "tcp/[::]:7447",
        "tcp/192.168.1.4:7447",
        "tcp/127.0.0.1.example.org:7447",
        "tcp/localhost.example.org:7447",
        "tcp/example.org:7447",
        "udp/0.0.0.0:7447",
        "tcp/127.0.0.1:7447#iface=eth0",
    ],
)
def test_endpoints_others_may_reach_need_insecure(endpoint):
    with pytest.raises(BadRequestError, match="--insecure"):
        ServerConfig(listen=endpoint)
    assert ServerConfig(listen=endpoint, insecure=True).insecure


@pytest.mark.parametrize("endpoint", ["", "127.0.0.1:7447", "tcp/", "tcp/127.0.0.1:7447 x", "tcp"])
def test_what_is_no_endpoint_is_refused(endpoint):
    with pytest.raises(BadRequestError, match="expected one such as"):
        ServerConfig(listen=endpoint, insecure=True)


@pytest.mark.parametrize(
    "setting",
    [
        {"workers": 0},
        {"max_in_flight": 0},
        {"max_in_flight_bytes": 0},
        {"max_poses": 0},
        {"max_poses": 100_001},
        {"max_avatar_points": 1_000_001},
    ],
)
def test_bounds_that_are_none_are_refused(setting):
    with pytest.raises(BadRequestError, match=next(iter(setting))):
        ServerConfig(**setting)
