"""The servers of a chaos run, one after another: started, killed, terminated and observed."""

import os
import signal
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.stats import t
from solidcloud.server.client import Client

from . import scoreboard as b
from .fixtures import SCENE, Fixture
from .measured_server import GIVEN_BACK

START_SECONDS = 300.0  # the first start on a machine compiles
STOP_SECONDS = 60.0
WATCH_PERIOD = 0.5
# A server's memory grows at first, as each kind of request and fault occurs once: by 8 MB, and on a busy
# machine for 200 s [s]. Then a cache of parsed keys fills, at 0.2 MB a minute, up to 2 MB.
SETTLED_SECONDS = 200.0
CONFIDENCE = 0.95
MEASURED_SERVER = Path(__file__).with_name("measured_server.py")


class QuietPoint(NamedTuple):
    """Resources of a server while no client sends queries.

    life: number of the server.  at, age: time and time since it serves [s].
    threads: by name.  files: by kind or name.
    memory: resident bytes that do not belong to files, once freed memory was given back.
    avatars: those of it that belong to avatars.  clients: number of clients with avatars.
    """

    life: int
    at: float
    age: float
    threads: dict[str, int]
    files: dict[str, int]
    memory: int
    avatars: int
    clients: int


class Growth(NamedTuple):
    """Growth of a server's memory [MB a minute]: a fit, and the ends of its confidence interval.

    minutes, points: how long and how often the memory was measured.
    """

    rate: float
    low: float
    high: float
    minutes: float
    points: int


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
        command = [sys.executable, "-P", str(MEASURED_SERVER), "serve", str(self.fixture.live)]
        command += ["--name", SCENE, "--listen", self.endpoint, "--cache", str(self.fixture.cache)]
        process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=self.log, text=True
        )
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

    def cpu_seconds(self) -> float:
        """Return the processor time that the server has used [s]."""
        fields = Path(f"/proc/{self.pid}/stat").read_text().rpartition(")")[2].split()
        user, system = fields[11:13]
        return (int(user) + int(system)) / os.sysconf("SC_CLK_TCK")

    def hang_up(self) -> None:
        """Make the server reload, by SIGHUP."""
        os.kill(self.pid, signal.SIGHUP)

    def record_quiet_point(self) -> None:
        """Record the server's resources while no client sends queries."""
        folder = Path("/proc") / str(self.pid)
        threads = Counter((task / "comm").read_text().strip() for task in (folder / "task").iterdir())
        files: Counter[str] = Counter()
        for entry in (folder / "fd").iterdir():
            with suppress(OSError):  # closed meanwhile
                files[entry.readlink().name.partition(":")[0]] += 1
        with Client(self.endpoint, scene=SCENE) as client:
            avatars = client.stats().avatars
        self._give_back_memory()
        resident, of_files = _resident(self.pid)
        at = time.monotonic()
        self.quiet.append(
            QuietPoint(
                life=self.number,
                at=at,
                age=at - self.serving_at,
                threads=dict(threads),
                files=dict(files),
                memory=resident - of_files,
                avatars=avatars.bytes,
                clients=avatars.clients,
            )
        )

    def _give_back_memory(self) -> None:
        """Make the server give back freed memory to the system."""
        assert self._process is not None
        assert self._process.stdin is not None and self._process.stdout is not None
        self._process.stdin.write("\n")
        self._process.stdin.flush()
        # Its other output may come first.
        if GIVEN_BACK not in iter(self._process.stdout.readline, ""):
            raise BrokenPipeError("the server has ended")

    def growth(self) -> Growth | None:
        """Return the growth of the last server's memory without that of avatars, once it has settled.

        None: there are too few quiet points.
        """
        return fit_growth([q for q in self.quiet if q.life == self.number])

    def _mark_ended(self) -> None:
        """Tell the clients that no server is up."""
        assert self._process is not None
        assert self._process.stdin is not None and self._process.stdout is not None
        self._process.stdout.close()
        self._process.stdin.close()
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


def fit_growth(quiet: Sequence[QuietPoint]) -> Growth | None:
    """Return the growth of a server's memory without that of avatars, once it has settled.

    quiet: quiet points of one server. None: there are fewer than three after SETTLED_SECONDS.
    """
    settled = [each for each in quiet if each.age >= SETTLED_SECONDS]
    if len(settled) < 3:
        return None
    minutes = np.array([each.age for each in settled]) / 60
    megabytes = np.array([each.memory - each.avatars for each in settled]) / 1e6
    slope, start = np.polyfit(minutes, megabytes, 1)
    freedom = len(settled) - 2
    variance = np.sum((megabytes - start - slope * minutes) ** 2) / freedom
    error = np.sqrt(variance / np.sum((minutes - minutes.mean()) ** 2))
    margin = float(t.ppf((1 + CONFIDENCE) / 2, freedom) * error)
    rate = float(slope)
    return Growth(rate, rate - margin, rate + margin, float(np.ptp(minutes)), len(settled))


def _resident(process: int) -> tuple[int, int]:
    """Return a process's resident memory, and the part of it that belongs to files [bytes]."""
    _, resident, shared, *_ = Path(f"/proc/{process}/statm").read_text().split()
    page = os.sysconf("SC_PAGE_SIZE")
    return int(resident) * page, int(shared) * page
