"""Context manager that runs `solidcloud serve` in a child process, on a free port."""

import os
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from ....schemas.errors import SolidcloudError
from ....schemas.runtime.kernel_files import default_folder
from ....schemas.wire.warming_parts import READY_LINE

# A server that takes longer without finishing a kernel is considered hung [s]: on a busy machine of
# two cores, compiling all of them took longer than this, but none of them a tenth of it.
READY_SECONDS = 300.0
STOP_SECONDS = 15.0
# Interval of the looks at the compiled kernels [s].
_LOOK_SECONDS = 1.0


@contextmanager
def served(
    what: Path, name: str | None, *options: str, endpoint: str | None = None, until: str = READY_LINE
) -> Iterator[str]:
    """Serve an archive or a scene file during the block; yield the endpoint.

    At the end of the block the server is terminated, and killed if it does not stop.
    name: of the scene, for clients; None: that of the file or folder.
    options: further options of the command.  endpoint: where it listens; None: at a free port.
    until: beginning of the server's line at which the block begins.
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
        _wait_ready(process, what, until)
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


def _wait_ready(process: "subprocess.Popen[str]", what: Path, until: str) -> None:
    """Wait until the server prints a line that begins with `until`."""
    come, late = threading.Event(), threading.Event()

    def watch() -> None:
        """Kill a server that hangs: its output ends, and so does the wait for a line of it."""
        kernels, since = _kernels(), time.monotonic()
        while not come.wait(_LOOK_SECONDS):
            now = _kernels()
            if now != kernels:
                kernels, since = now, time.monotonic()
            elif time.monotonic() - since > READY_SECONDS:
                late.set()
                process.kill()
                return

    watcher = threading.Thread(target=watch, name="server-watch", daemon=True)
    watcher.start()
    try:
        ready = any(line.startswith(until) for line in process.stdout or ())
    finally:
        come.set()
        watcher.join()
    if ready:
        return
    process.wait()
    if late.is_set():
        raise SolidcloudError(
            f"the server of {what} was stopped, because in {READY_SECONDS:g} s it neither served nor compiled "
            "a kernel: if this machine is busy, try again: kernels that are compiled are kept; otherwise "
            "run `solidcloud doctor`"
        )
    raise SolidcloudError(
        f"the server of {what} ended with exit code {process.returncode} before it served: see its error above"
    )


def _kernels() -> frozenset[str]:
    """Return the names of the compiled kernels and of those in work."""
    try:
        return frozenset(os.listdir(default_folder(os.environ.get("NUMBA_CACHE_DIR", ""))))
    except OSError:
        return frozenset()
