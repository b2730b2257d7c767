"""Syntax of zenoh endpoints such as tcp/127.0.0.1:7447, and their canonical names."""

import re

from ...schemas.errors import BadRequestError

DEFAULT_ENDPOINT = "tcp/127.0.0.1:7447"

# Protocols that zenoh's Python library opens without further configuration.
PROTOCOLS = ("tcp", "udp", "ws", "unixsock-stream")
_ENCRYPTED = ("tls", "quic", "wss")

# zenoh takes no surrogates, which stand for bytes of a command line that are no UTF-8.
_ENDPOINT = re.compile(
    r"(?P<protocol>[a-z0-9-]+)/(?P<address>[^?#\s\ud800-\udfff]+)(?P<rest>[?#][^\s\ud800-\udfff]*)?"
)
_LOOPBACK = re.compile(r"(127(\.\d{1,3}){3}|localhost|\[::1\]):\d{1,5}")
_HOST_AND_PORT = re.compile(r"(?P<host>\[[0-9A-Fa-f:.%]+\]|[^:/\[\]]+):(?P<port>\d{1,5})")
# Hosts that stand for all addresses of this host, and another name of a loopback address.
_SAME_AS_LOOPBACK = ("localhost", "0.0.0.0", "[::]")


def check_endpoint(endpoint: str, what: str) -> str:
    """Return the endpoint; raise BadRequestError if zenoh cannot open it.

    what: name of the endpoint in the error message.
    """
    expected = f"expected one such as {DEFAULT_ENDPOINT}"
    match = _ENDPOINT.fullmatch(endpoint)
    if not match:
        hint = f": write tcp/{endpoint}" if _HOST_AND_PORT.fullmatch(endpoint) else ""
        raise BadRequestError(f"{what} {endpoint!r}: not PROTOCOL/ADDRESS: {expected}{hint}")
    protocol = match["protocol"]
    if protocol in _ENCRYPTED:
        raise BadRequestError(
            f"{what} {endpoint!r}: {protocol} needs certificates, which this version does not support: {expected}"
        )
    if protocol not in PROTOCOLS:
        raise BadRequestError(
            f"{what} {endpoint!r}: protocol {protocol!r}: expected one of {', '.join(PROTOCOLS)}"
        )
    if protocol != "unixsock-stream":
        address = _HOST_AND_PORT.fullmatch(match["address"])
        if not address or int(address["port"]) >= 1 << 16:
            raise BadRequestError(
                f"{what} {endpoint!r}: {match['address']!r} is not HOST:PORT with a port of 1 to 65535: {expected}"
            )
    return endpoint


def is_loopback(endpoint: str) -> bool:
    """Return whether only processes of this host can reach an endpoint; False if undecided."""
    match = _ENDPOINT.fullmatch(endpoint)
    if not match:
        return False
    if match["protocol"] in ("unixsock-stream", "unixpipe"):
        return True
    return bool(_LOOPBACK.fullmatch(match["address"])) and match["rest"] is None


def canonical(endpoint: str) -> str:
    """Return a canonical text, equal for endpoints of this host that lead to the same server.

    Some such endpoints have different texts, for example other names of the same host.
    """
    protocol, _, address = endpoint.partition("/")
    match = _HOST_AND_PORT.fullmatch(re.split("[?#]", address)[0])
    if match and match["host"].lower() in _SAME_AS_LOOPBACK:
        address = f"127.0.0.1:{int(match['port'])}"
    return f"{protocol}/{address}"


def zenoh_words(error: Exception) -> str:
    """Return the message of a zenoh error, without the paths of its build."""
    return re.sub(r"\s+at /\S+\.rs:\d+\.?", "", str(error)).strip().rstrip(".") or type(error).__name__
