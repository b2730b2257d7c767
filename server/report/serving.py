"""A server in a process of its own, for as long as a report asks it: `solidcloud serve` on a free port."""

import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from ...schemas.errors import SolidcloudError

# To load the libraries and compile every kernel on two slow cores; a server that takes longer hangs.
READY_SECONDS = 300.0
STOP_SECONDS = 15.0


@contextmanager
def served(what: Path, name: str | None, *options: str) -> Iterator[str]:
    """Serve an archive or a scene file while inside; gives the endpoint.

    name: what clients call it; None: as the file or folder has it.  options: more, as the command takes them.

    SolidcloudError: the server did not start; its own error stands on standard error. On the way out, whatever
    the reason, it is asked to stop, and killed if it does not.
    """
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    command = [sys.executable, "-P", "-m", "solidcloud.server.cli", "serve", str(what)]
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
    """A TCP port of the loopback interface that nobody listens on at this moment."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def _wait_ready(process: "subprocess.Popen[str]", archive: Path) -> None:
    """Return when the server says that it serves."""
    # Killed, it closes its output: no other way to wait for a line with a deadline on every system.
    timer = threading.Timer(READY_SECONDS, process.kill)
    timer.start()
    try:
        line = process.stdout.readline() if process.stdout else ""
    finally:
        timer.cancel()
    if not line:
        process.wait()
        raise SolidcloudError(
            f"the server of {archive} ended with exit code {process.returncode}, expected it to serve within "
            f"{READY_SECONDS:g} s: see its error above"
        )
