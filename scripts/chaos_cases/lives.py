"""The server of a chaos run, life after life: started, killed, asked to stop, and watched."""

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

from . import board as b
from .ground import SCENE, Ground

START_SECONDS = 300.0  # the first start on a machine compiles
STOP_SECONDS = 60.0
WATCH_PERIOD = 0.5


class Quiet(NamedTuple):
    """What a server holds while nobody asks. life: which.  at: when [s].  threads: by name.  files: by kind or name.

    rss: bytes resident.  of_files: those of them that are a file's, so that the system may take them back.
    calm: whether the server had dropped all avatars that nobody used.
    """

    life: int
    at: float
    threads: dict[str, int]
    files: dict[str, int]
    rss: int
    of_files: int
    calm: bool


class Stop(NamedTuple):
    """One SIGTERM. begin: when [s].  seconds: until it ended.  code: that it ended with."""

    begin: float
    seconds: float
    code: int


class Lives:
    """One server after another at one endpoint."""

    def __init__(self, ground: Ground, endpoint: str, board: b.Board, log: Path) -> None:
        self.ground, self.endpoint, self.board = ground, endpoint, board
        self.log = log.open("ab")
        self.number = 0
        self.serving_at = 0.0
        self.stops: list[Stop] = []
        self.quiet: list[Quiet] = []
        self.memory: list[tuple[int, float, int]] = []  # life, time, RSS
        self.died: list[int] = []  # exit codes of servers that ended by themselves
        self._process: subprocess.Popen | None = None
        threading.Thread(target=self._watch, daemon=True).start()

    @property
    def pid(self) -> int:
        """Return the process id of the server that is up."""
        assert self._process is not None
        return self._process.pid

    def start(self) -> None:
        """Start a server, and return when it says that it serves."""
        self._tell(up=True)
        self.number += 1
        command = [sys.executable, "-P", "-m", "solidcloud.server.cli.main", "serve", str(self.ground.live)]
        command += ["--name", SCENE, "--listen", self.endpoint, "--cache", str(self.ground.cache)]
        process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=self.log, text=True)
        timer = threading.Timer(START_SECONDS, process.kill)
        timer.start()
        assert process.stdout is not None
        line = process.stdout.readline()
        timer.cancel()
        self.serving_at = time.monotonic()
        if not line.startswith("serving "):
            process.kill()
            raise RuntimeError(f"the server did not start: exit code {process.wait()}, see {self.log.name}")
        self._process = process

    def running(self) -> bool:
        """Return whether the server has not ended by itself; notes the code it ended with."""
        if self._process is None or self._process.poll() is None:
            return self._process is not None
        self.died.append(self._process.returncode)
        self._gone()
        return False

    def kill(self) -> None:
        """Kill the server."""
        if self._process is not None:
            self._process.kill()
            self._process.wait()
            self._gone()

    def terminate(self) -> None:
        """Ask the server to stop, and note how long it takes."""
        if self._process is None:
            return
        begin = time.monotonic()
        self._process.terminate()
        try:
            code = self._process.wait(STOP_SECONDS)
        except subprocess.TimeoutExpired:
            self._process.kill()
            code = self._process.wait()
        self.stops.append(Stop(begin, time.monotonic() - begin, code))
        self._gone()

    def hang_up(self) -> None:
        """Ask the server to reload."""
        os.kill(self.pid, signal.SIGHUP)

    def look(self, *, calm: bool) -> None:
        """Note what the server holds; for moments when nobody asks. calm: see `Quiet`."""
        folder = Path("/proc") / str(self.pid)
        threads = Counter((task / "comm").read_text().strip() for task in (folder / "task").iterdir())
        files: Counter[str] = Counter()
        for entry in (folder / "fd").iterdir():
            with suppress(OSError):  # closed meanwhile
                files[entry.readlink().name.partition(":")[0]] += 1
        self.quiet.append(
            Quiet(self.number, time.monotonic(), dict(threads), dict(files), *_resident(self.pid), calm)
        )

    def slope(self) -> tuple[float, float] | None:
        """Return the slope of the last life's memory once settled [MB a minute], and the minutes it was seen for.

        Memory is what is no file's, at calm quiet points. None: they are too few, or less than a minute apart.
        """
        seen = np.array(
            [(q.at, q.rss - q.of_files) for q in self.quiet if q.life == self.number and q.calm], np.float64
        ).reshape(-1, 2)
        if len(seen) < 2 or seen[-1, 0] - seen[0, 0] < 60:
            return None
        rate = np.polyfit(seen[:, 0] - seen[0, 0], seen[:, 1], 1)[0]
        return float(rate * 60 / 1e6), float(seen[-1, 0] - seen[0, 0]) / 60

    def _gone(self) -> None:
        """Tell that no server is up."""
        assert self._process is not None and self._process.stdout is not None
        self._process.stdout.close()
        self._process = None
        self._tell(up=False)

    def _tell(self, *, up: bool) -> None:
        """Tell the clients whether a server may be up."""
        self.board.driver[b.EPOCH] += 1
        self.board.driver[b.UP] = up

    def _watch(self) -> None:
        """Note the server's memory, until this process ends."""
        while True:
            process = self._process
            if process is not None:
                with suppress(OSError, ValueError, IndexError):  # it has just ended
                    if rss := _resident(process.pid)[0]:  # 0: it has ended
                        self.memory.append((self.number, time.monotonic(), rss))
            time.sleep(WATCH_PERIOD)


def _resident(process: int) -> tuple[int, int]:
    """Return the memory that a process has resident, and that of it that is files' [bytes]."""
    _, resident, shared, *_ = Path(f"/proc/{process}/statm").read_text().split()
    page = os.sysconf("SC_PAGE_SIZE")
    return int(resident) * page, int(shared) * page
