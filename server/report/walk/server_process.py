"""Context manager that runs `solidcloud serve` in a child process, on a free port."""

import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from ....schemas.errors import SolidcloudError
from ....schemas.wire.warming_parts import READY_LINE

# Enough to load the libraries and compile every kernel on two slow cores. A server that takes
# longer is considered hung.
READY_SECONDS = 300.0
STOP_SECONDS = 15.0


@contextmanager
def served(what: Path, name: str | None, *options: str, endpoint: str | None = None) -> Iterator[str]:
    """Serve an archive or a scene file during the block; yield the endpoint.

    At the end of the block the server is terminated, and killed if it does not stop.
    name: of the scene, for clients; None: that of the file or folder.
    options: further options of the command.  endpoint: where it listens; None: at a free port.
    Raises SolidcloudError if the server does not start; its own error is on standard error.
    """
    endpoint = endpoint or f"tcp/127.0.0.1:{free_port()}"
    command = [sys.executable, "-P", "-m", "solidcloud.server.cli.main", "serve", str(what)]
    process = subprocess.Popen(
        [*command, *(["--name", name] if name else []), "--listen", endpoint, *options],
        stdout=subprocess.PIPE,
        text=True,
    )
    try:
        _wait_ready(process, what)
        yield endpoint
    finally:
        process.terminate()
        try:
            process.wait(STOP_SECONDS)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        if process.stdout:
            process.stdout.close()


def free_port() -> int:
    """Return a TCP port of the loopback interface that is free at this moment."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def _wait_ready(process: "subprocess.Popen[str]", archive: Path) -> None:
    """Wait until the server reports that everything is ready."""
    # The timer kills the server, which closes its output and ends readline(): the only way to wait
    # for a line with a deadline on every system.
    timer = threading.Timer(READY_SECONDS, process.kill)
    timer.start()
    try:
        ready = READY_LINE in map(str.strip, process.stdout or ())
    finally:
        timer.cancel()
    if not ready:
        process.wait()
        raise SolidcloudError(
            f"the server of {archive} ended with exit code {process.returncode}, expected it to serve within "
            f"{READY_SECONDS:g} s: see its error above"
        )
