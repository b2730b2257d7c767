"""Web server of the viewer: the package's files, and a WebSocket for each browser.

It listens on the loopback interface only. A page of another site that runs in the same browser can
send requests to it too: such a page has another `Origin`, and another `Host` if its name was made
to resolve to 127.0.0.1. Both are refused.
"""

import logging
import os
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from http import HTTPStatus
from typing import Any

from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response
from websockets.protocol import State
from websockets.sync.server import Server, ServerConnection, serve

from ....schemas.errors import BadRequestError, SolidcloudError
from .page_messages import PageConnection
from .static_files import StaticFile, static_files

log = logging.getLogger(__name__)
# Of the library. A page that is frozen or asleep is regular: its end is worth no traceback.
connection_log = logging.getLogger(f"{__name__}.connections")
connection_log.addFilter(lambda record: record.msg != "keepalive ping failed")

HOST = "127.0.0.1"
SOCKET_PATH = "/socket"
# Largest message of a page [bytes]: a list of 256 tiles takes a tenth of it.
MAX_MESSAGE_BYTES = 64 << 10
# Browsers at a time: each is a user of the scene with five threads.
MAX_BROWSERS = 16
# A browser that takes no data for this long is considered gone [s]. Where graphics are computed in
# software beside other work, one was silent for 20 s.
_STALLED_SECONDS = 60.0


class _Page:
    """Connection to a page as `Browser` uses it."""

    def __init__(self, connection: ServerConnection) -> None:
        self._connection = connection

    def __iter__(self) -> Iterator[str | bytes]:
        return iter(self._connection)

    def send(self, message: str | bytes) -> None:
        try:
            self._connection.send(message)
        except ConnectionClosed:
            log.debug("a page was closed while a message was sent")

    def is_open(self) -> bool:
        return self._connection.state is State.OPEN


class WebServer:
    """Web server that serves the page, and `browser` for each connected page.

    url: address of the page.
    """

    def __init__(self, port: int, browser: Callable[[PageConnection], None]) -> None:
        """Listen on a port; 0: a free one. Raise SolidcloudError if the port is in use.

        browser: serves one page; returns when it is closed.
        """
        self._browser, self._files = browser, static_files()
        self._places = threading.Semaphore(MAX_BROWSERS)
        try:
            self._server: Server = serve(
                self._handle,
                HOST,
                port,
                process_request=self._answer,
                compression=None,  # on the loopback interface it costs more time than it saves
                max_size=MAX_MESSAGE_BYTES,
                max_queue=32,
                server_header=None,
                ping_timeout=_STALLED_SECONDS,
                close_timeout=1.0,
                logger=connection_log,
            )
        except OSError as error:
            raise SolidcloudError(
                f"port {port}: cannot listen on {HOST} ({os.strerror(error.errno or 0)}): give another --port, or none"
            ) from None
        self.port = int(self._server.socket.getsockname()[1])
        self._hosts = {f"{HOST}:{self.port}", f"localhost:{self.port}"}
        self.url = f"http://{HOST}:{self.port}/"

    @contextmanager
    def running(self) -> Iterator[None]:
        """Serve during the block."""
        thread = threading.Thread(target=self._server.serve_forever, name="viewer-web", daemon=True)
        thread.start()
        try:
            yield
        finally:
            self._server.shutdown()
            thread.join()

    def _answer(self, connection: ServerConnection, request: Request) -> Response | None:
        """Answer a request for a file; None for a WebSocket that may be opened."""
        hosts = request.headers.get_all("Host")
        if len(hosts) != 1 or hosts[0].lower() not in self._hosts:
            return _refusal(HTTPStatus.FORBIDDEN, f"unknown host: open {self.url}")
        path = request.path.partition("?")[0]
        if path == SOCKET_PATH:
            # Browsers always send it with a WebSocket; other programs may use zenoh itself.
            origin = request.headers.get("Origin", "")
            if origin.lower() not in {f"http://{host}" for host in self._hosts}:
                return _refusal(HTTPStatus.FORBIDDEN, "a page of another site must not use the viewer")
            return None
        file = self._files.get(path)
        if file is None:
            return _refusal(HTTPStatus.NOT_FOUND, "no such file")
        return _file_response(file, self._hosts)

    def _handle(self, connection: ServerConnection) -> None:
        """Serve one page."""
        if not self._places.acquire(blocking=False):
            connection.close(1013, f"{MAX_BROWSERS} browsers are connected: close one")
            return
        try:
            self._browser(_Page(connection))
        except BadRequestError as error:
            log.warning("%s", error)
            connection.close(1008, str(error)[:120])
        except ConnectionClosed:
            log.debug("a page was closed")
        finally:
            self._places.release()


def _file_response(file: StaticFile, hosts: set[str]) -> Response:
    """Return a file, with rules by which the page loads nothing from elsewhere."""
    sockets = " ".join(sorted(f"ws://{host}" for host in hosts))
    # WebAssembly of the page's own modules may be compiled; `eval` stays forbidden.
    policy = (
        "default-src 'none'; script-src 'self' 'wasm-unsafe-eval'; "
        "style-src 'self' 'unsafe-inline'; img-src 'self' data: blob:; "
        f"connect-src 'self' {sockets}; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    )
    return _response(
        HTTPStatus.OK,
        file.content,
        {"Content-Type": file.media_type, "Content-Security-Policy": policy, "Cache-Control": "no-cache"},
    )


def _refusal(status: HTTPStatus, text: str) -> Response:
    """Return a response without a file."""
    return _response(status, f"{text}\n".encode(), {"Content-Type": "text/plain; charset=utf-8"})


def _response(status: HTTPStatus, content: bytes, fields: dict[str, Any]) -> Response:
    """Return a response."""
    headers = Headers(
        {
            **fields,
            "Content-Length": str(len(content)),
            "Connection": "close",
            "X-Content-Type-Options": "nosniff",
            "Cross-Origin-Resource-Policy": "same-origin",
            "Referrer-Policy": "no-referrer",
        }
    )
    return Response(status.value, status.phrase, headers, content)
