"""Test who may use the web server: its own page, and nobody else."""

import contextlib
import http.client
import socket
import time
from collections.abc import Iterator

import pytest
from solidcloud.schemas.errors import BadRequestError, SolidcloudError
from solidcloud.server.viewer.page.page_messages import PageConnection
from solidcloud.server.viewer.page.web_server import (
    MAX_BROWSERS,
    MAX_MESSAGE_BYTES,
    WebServer,
)
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect


def echo(page: PageConnection) -> None:
    """Send every message back; "bad" is refused as an invalid one."""
    for message in page:
        if message == "bad":
            raise BadRequestError("message of a page: bad")
        page.send(message)


@pytest.fixture
def server() -> Iterator[WebServer]:
    server = WebServer(0, echo)
    with server.running():
        yield server


def get(server: WebServer, path: str, host: str | None = None) -> tuple[int, bytes, dict[str, str]]:
    connection = http.client.HTTPConnection("127.0.0.1", server.port, timeout=30)
    connection.request("GET", path, headers={"Host": host or f"127.0.0.1:{server.port}"})
    answer = connection.getresponse()
    return answer.status, answer.read(), dict(answer.getheaders())


def socket_of(server: WebServer, **changes: str) -> connect:
    fields = {"Origin": f"http://127.0.0.1:{server.port}", **changes}
    return connect(
        f"ws://127.0.0.1:{server.port}/socket",
        origin=fields["Origin"] or None,  # type: ignore[arg-type]
        max_size=None,
    )


def test_page_and_its_modules_are_served_with_a_strict_policy(server: WebServer) -> None:
    status, content, fields = get(server, "/")
    assert (status, fields["Content-Type"]) == (200, "text/html; charset=utf-8")
    assert b'src="main.js"' in content
    policy = fields["Content-Security-Policy"]
    assert "default-src 'none'" in policy
    assert "script-src 'self' 'wasm-unsafe-eval';" in policy
    for path in ("/main.js", "/vendor/three.module.min.js", "/panels/index.js"):
        status, _, fields = get(server, path)
        assert (status, fields["Content-Type"]) == (200, "text/javascript; charset=utf-8")
    status, content, fields = get(server, "/raster/splats.wasm")
    assert (status, fields["Content-Type"], content[:4]) == (200, "application/wasm", b"\0asm")
    assert get(server, "/?at=1,2,3,4")[0] == 200


@pytest.mark.parametrize(
    "path", ["/other.js", "/../viewer.py", "/..%2fviewer.py", "//etc/passwd", "/vendor", "/%2e%2e/"]
)
def test_nothing_else_is_served(server: WebServer, path: str) -> None:
    assert get(server, path)[0] == 404


@pytest.mark.parametrize(
    "host", ["evil.example", "evil.example:{port}", "127.0.0.1", "127.0.0.1:1", "[::1]:{port}"]
)
def test_other_host_is_refused(server: WebServer, host: str) -> None:
    assert get(server, "/", host.format(port=server.port))[0] == 403


@pytest.mark.parametrize(
    "origin",
    [
        "",
        "null",
        "http://evil.example",
        "http://127.0.0.1",
        "https://127.0.0.1:{port}",
        "http://evil.example:{port}",
    ],
)
def test_socket_of_another_page_is_refused(server: WebServer, origin: str) -> None:
    with pytest.raises(InvalidStatus) as refused, socket_of(server, Origin=origin.format(port=server.port)):
        pass
    assert refused.value.response.status_code == 403


def test_own_page_is_served_by_either_name(server: WebServer) -> None:
    for host in ("127.0.0.1", "localhost"):
        with socket_of(server, Origin=f"http://{host}:{server.port}") as page:
            page.send("hello")
            assert page.recv(timeout=30) == "hello"


def test_large_and_invalid_messages_end_the_connection(server: WebServer) -> None:
    for message, code in (("x" * (MAX_MESSAGE_BYTES + 1), 1009), ("bad", 1008)):
        with socket_of(server) as page:
            page.send(message)
            with pytest.raises(ConnectionClosed) as closed:
                page.recv(timeout=30)
            assert closed.value.rcvd is not None
            assert closed.value.rcvd.code == code


def test_number_of_browsers_is_bounded_and_a_place_is_free_again(server: WebServer) -> None:
    pages = [socket_of(server).__enter__() for _ in range(MAX_BROWSERS)]
    for page in pages:
        page.send("hello")
        assert page.recv(timeout=30) == "hello"
    with socket_of(server) as late, pytest.raises(ConnectionClosed) as closed:
        late.recv(timeout=30)
    assert closed.value.rcvd is not None
    assert closed.value.rcvd.code == 1013
    for page in pages:
        page.close()
    assert is_served(server)


def is_served(server: WebServer) -> bool:
    """Return whether a page is served, as soon as the server has noticed that others are closed."""
    end = time.monotonic() + 30
    while time.monotonic() < end:
        with contextlib.suppress(ConnectionClosed), socket_of(server) as page:
            page.send("hello")
            return page.recv(timeout=30) == "hello"
    return False


def test_port_in_use_is_named() -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(SolidcloudError, match=f"port {port}: cannot listen on 127.0.0.1 .*--port"):
            WebServer(port, echo)
