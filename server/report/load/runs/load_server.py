"""Server under load: a separate process on loopback, its options, and its memory over time."""

import os
import re
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .....schemas.errors import SolidcloudError
from .....schemas.wire.warming_parts import READY_LINE
from ...common.machine import parse_rollup
from ..users import echo_process

SCENE = "load"
COMMAND = [sys.executable, "-P", "-m", "solidcloud.server.cli.main"]
START_SECONDS = 900.0  # the first start on a machine compiles
STOP_SECONDS = 20.0
# RSS is inexpensive to read. PSS visits all mappings and blocks the process's mmap for some ms.
RSS_PERIOD, PSS_PERIOD = 0.05, 1.0


class ServerError(SolidcloudError):
    """Failed start or early end of the server; the message holds its output."""


@dataclass
class Memory:
    """Memory of a process over time.

    at: sample times, time.monotonic() [s].
    rss: at these times [bytes].
    pss_at, pss: the same for PSS, less often.
    high: the maximum RSS according to the kernel [bytes]; 0 where unknown.
    """

    at: list[float] = field(default_factory=list)
    rss: list[int] = field(default_factory=list)
    pss_at: list[float] = field(default_factory=list)
    pss: list[int] = field(default_factory=list)
    high: int = 0

    def peak(self) -> int:
        """Return the maximum RSS [bytes], from the samples where the kernel does not report it."""
        return max(self.high, *self.rss, 0)

    def samples(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return times and RSS."""
        return np.array(self.at), np.array(self.rss, np.float64)


def parse_high(text: str) -> int:
    """Return the maximum RSS [bytes] in a process's status; 0 where it is missing."""
    found = re.search(r"^VmHWM:\s+(\d+) kB", text, re.MULTILINE)
    return int(found[1]) * 1024 if found else 0


class Watcher(threading.Thread):
    """Samples one process's memory until it ends, or until stopped."""

    def __init__(self, process: int) -> None:
        super().__init__(daemon=True)
        self.memory = Memory()
        self._folder = Path("/proc") / str(process)
        self._done = threading.Event()

    def look(self, whole: bool) -> None:
        """Take one sample; whole: PSS too. Raises OSError where the process has ended."""
        pages = int((self._folder / "statm").read_text().split()[1])
        memory, now = self.memory, time.monotonic()
        memory.at.append(now)
        memory.rss.append(pages * os.sysconf("SC_PAGE_SIZE"))
        if whole:
            memory.pss.append(parse_rollup((self._folder / "smaps_rollup").read_text())[0])
            memory.pss_at.append(now)
            memory.high = max(memory.high, parse_high((self._folder / "status").read_text()))

    def run(self) -> None:
        last = -PSS_PERIOD
        while not self._done.is_set():
            due = time.monotonic() - last >= PSS_PERIOD
            last = time.monotonic() if due else last
            try:
                self.look(due)
            except (OSError, ValueError, IndexError):
                return
            self._done.wait(RSS_PERIOD)

    def stop(self) -> Memory:
        """Return all samples, the last one included."""
        self._done.set()
        if self.ident is not None:
            self.join()
        with suppress(OSError, ValueError, IndexError):
            self.look(True)
        return self.memory


@dataclass
class Served:
    """Server that answers.

    endpoint: its address.
    process: its id.
    seconds: from its start until it reported readiness.
    """

    endpoint: str
    process: int
    seconds: float


def free_endpoint() -> str:
    """Return a free endpoint on loopback."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{free.getsockname()[1]}"


def serve_command(archive: Path, endpoint: str, budget: int, policy: str | None) -> list[str]:
    """Return the command that serves an archive. policy: None: the server's default."""
    command = [*COMMAND, "serve", str(archive), "--name", SCENE, "--listen", endpoint, "--cache", str(budget)]
    return command + (["--policy", policy] if policy else [])


def module_command(module: str, *arguments: str) -> list[str]:
    """Return the command that runs a module, by its full name."""
    return [sys.executable, "-P", "-m", module, *arguments]


@contextmanager
def started(command: list[str], log: Path) -> Iterator[subprocess.Popen[str]]:
    """Start a process and end it afterwards, by SIGTERM first. log: receives its standard error."""
    with (
        open(log, "w") as errors,
        subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=errors, text=True
        ) as process,
    ):
        try:
            yield process
        finally:
            end(process)


@contextmanager
def running(command: list[str], log: Path, ready: str) -> Iterator[subprocess.Popen[str]]:
    """Start a process and wait for a line that begins with `ready`.

    Raises ServerError where it ended before, or was too slow.
    """
    with started(command, log) as process:
        lines = _lines_until(ready, process)
        if not lines or not lines[-1].startswith(ready):
            said = log.read_text(errors="replace").strip()[-2000:]
            raise ServerError(f"{' '.join(command[:4])}: not ready (printed {lines}): {said}")
        yield process


def _lines_until(ready: str, process: subprocess.Popen[str]) -> list[str]:
    """Return its lines on standard output up to one that begins with `ready`.

    The last one is another if it ended before, or was too slow.
    """
    found: list[str] = []

    def read() -> None:
        for line in process.stdout or ():
            found.append(line.strip())
            if line.startswith(ready):
                return

    reader = threading.Thread(target=read, daemon=True)
    reader.start()
    reader.join(START_SECONDS)
    return found


def end(process: subprocess.Popen[str]) -> None:
    """End a process: SIGTERM first, then kill."""
    process.terminate()
    if process.stdin is not None:
        process.stdin.close()
    try:
        process.wait(STOP_SECONDS)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


@contextmanager
def serving(archive: Path, budget: int, policy: str | None, log: Path) -> Iterator[Served]:
    """Run `solidcloud serve` on an archive, warm and reachable, with an empty cache of `budget` bytes."""
    endpoint, begin = free_endpoint(), time.monotonic()
    with running(serve_command(archive, endpoint, budget, policy), log, READY_LINE) as process:
        yield Served(endpoint, process.pid, time.monotonic() - begin)


@contextmanager
def echoing(reply_bytes: int, log: Path) -> Iterator[str]:
    """Run a bare echo, reachable at the yielded endpoint."""
    endpoint = free_endpoint()
    with running(module_command(echo_process.__name__, endpoint, str(reply_bytes)), log, "ready"):
        yield endpoint


def ask_stats(client: Any) -> Any:
    """Return a server's cache statistics (`StatsAnswer`), resident voxels included; None if unsupported."""
    if not hasattr(client, "stats"):
        return None
    try:
        return client.stats(keys=True)
    except SolidcloudError:  # an older server
        return None
