"""The servers of a chaos run, one after another: started, killed, terminated and observed."""

import os
import signal
import subprocess
import sys
import threading
import time
from collections import Counter
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

import numpy as np

from . import scoreboard as b
from .fixtures import SCENE, Fixture

START_SECONDS = 300.0  # the first start on a machine compiles
STOP_SECONDS = 60.0
WATCH_PERIOD = 0.5


class QuietPoint(NamedTuple):
    """Resources of a server while no client sends queries.

    life: number of the server.  at: time [s].  threads: by name.  files: by kind or name.
    rss: resident bytes.  of_files: those that belong to files, which the system may reclaim.
    calm: whether the server had dropped all unused avatars.
    """

    life: int
    at: float
    threads: dict[str, int]
    files: dict[str, int]
    rss: int
    of_files: int
    calm: bool


class Shutdown(NamedTuple):
    """One SIGTERM. begin: time [s].  seconds: until the server ended.  code: its exit code."""

    begin: float
    seconds: float
    code: int


class ServerRuns:
    """Servers that follow one another at one endpoint."""

    def __init__(self, fixture: Fixture, endpoint: str, board: b.Scoreboard, log: Path) -> None:
        self.fixture, self.endpoint, self.scoreboard = fixture, endpoint, board
        self.log = log.open("ab")
        self.number = 0
        self.serving_at = 0.0
        self.stops: list[Shutdown] = []
        self.quiet: list[QuietPoint] = []
        self.memory: list[tuple[int, float, int]] = []  # life, time, RSS
        self.died: list[int] = []  # exit codes of servers that ended by themselves
        self._process: subprocess.Popen | None = None
        threading.Thread(target=self._watch, daemon=True).start()

    @property
    def pid(self) -> int:
        """Return the process id of the running server."""
        assert self._process is not None
        return self._process.pid

    def start(self) -> None:
        """Start a server, and return when it serves."""
        self._tell(up=True)
        self.number += 1
        command = [sys.executable, "-P", "-m", "solidcloud.server.cli.main", "serve", str(self.fixture.live)]
        command += ["--name", SCENE, "--listen", self.endpoint, "--cache", str(self.fixture.cache)]
        process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=self.log, text=True)
        timer = threading.Timer(START_SECONDS, process.kill)
        timer.start()
        assert process.stdout is not None
        line = process.stdout.readline()
        self.serving_at = time.monotonic()
        if self.number == 1:  # compiles what is refused until then
            process.stdout.readline()
        timer.cancel()
        if not line.startswith("serving "):
            process.kill()
            raise RuntimeError(f"the server did not start: exit code {process.wait()}, see {self.log.name}")
        self._process = process

    def running(self) -> bool:
        """Return whether the server runs. Record the exit code of one that ended by itself."""
        if self._process is None or self._process.poll() is None:
            return self._process is not None
        self.died.append(self._process.returncode)
        self._mark_ended()
        return False

    def kill(self) -> None:
        """Kill the server."""
        if self._process is not None:
            self._process.kill()
            self._process.wait()
            self._mark_ended()

    def terminate(self) -> None:
        """Terminate the server, and record how long it takes."""
        if self._process is None:
            return
        begin = time.monotonic()
        self._process.terminate()
        try:
            code = self._process.wait(STOP_SECONDS)
        except subprocess.TimeoutExpired:
            self._process.kill()
            code = self._process.wait()
        self.stops.append(Shutdown(begin, time.monotonic() - begin, code))
        self._mark_ended()

    def hang_up(self) -> None:
        """Make the server reload, by SIGHUP."""
        os.kill(self.pid, signal.SIGHUP)

    def record_quiet_point(self, *, calm: bool) -> None:
        """Record the server's resources while no client sends queries. calm: see `QuietPoint`."""
        folder = Path("/proc") / str(self.pid)
        threads = Counter((task / "comm").read_text().strip() for task in (folder / "task").iterdir())
        files: Counter[str] = Counter()
        for entry in (folder / "fd").iterdir():
            with suppress(OSError):  # closed meanwhile
                files[entry.readlink().name.partition(":")[0]] += 1
        self.quiet.append(
            QuietPoint(self.number, time.monotonic(), dict(threads), dict(files), *_resident(self.pid), calm)
        )

    def slope(self) -> tuple[float, float] | None:
        """Return the growth of the last server's memory [MB a minute], and the minutes it was observed.

        Memory of files is excluded. Only calm quiet points count. None: there are too few of them, or
        they are less than a minute apart.
        """
        seen = np.array(
            [(q.at, q.rss - q.of_files) for q in self.quiet if q.life == self.number and q.calm], np.float64
        ).reshape(-1, 2)
        if len(seen) < 2 or seen[-1, 0] - seen[0, 0] < 60:
            return None
        rate = np.polyfit(seen[:, 0] - seen[0, 0], seen[:, 1], 1)[0]
        return float(rate * 60 / 1e6), float(seen[-1, 0] - seen[0, 0]) / 60

    def _mark_ended(self) -> None:
        """Tell the clients that no server is up."""
        assert self._process is not None and self._process.stdout is not None
        self._process.stdout.close()
        self._process = None
        self._tell(up=False)

    def _tell(self, *, up: bool) -> None:
        """Tell the clients whether a server may be up."""
        self.scoreboard.driver[b.EPOCH] += 1
        self.scoreboard.driver[b.UP] = up

    def _watch(self) -> None:
        """Record the server's memory until this process ends."""
        while True:
            process = self._process
            if process is not None:
                with suppress(OSError, ValueError, IndexError):  # it has just ended
                    if rss := _resident(process.pid)[0]:  # 0: it has ended
                        self.memory.append((self.number, time.monotonic(), rss))
            time.sleep(WATCH_PERIOD)


def _resident(process: int) -> tuple[int, int]:
    """Return a process's resident memory, and the part of it that belongs to files [bytes]."""
    _, resident, shared, *_ = Path(f"/proc/{process}/statm").read_text().split()
    page = os.sysconf("SC_PAGE_SIZE")
    return int(resident) * page, int(shared) * page
