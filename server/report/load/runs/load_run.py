"""One run: a real server or a bare echo, N users in separate processes, and the outcome of every frame."""

import os
import subprocess
import threading
import time
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from .....builder.synthetic.figure import figure_points
from .....schemas.wire.encoding import encode
from .....schemas.wire.requests import CollideRequest
from ....client import Client
from ..users import frame_outcomes as results
from ..users import user_process, user_traces
from ..users.frame_outcomes import Frames
from ..users.user_process import AVATAR, LAST_ANSWERS, Job
from ..users.user_traces import Trace
from . import load_server
from .load_server import Memory

LEAD = 0.5  # from the start command to the users until the first frame is due [s]
STRIP = 12  # snapshots of the resident voxels, evenly over a run


@dataclass(frozen=True)
class Setup:
    """Settings common to all runs.

    work: a folder for logs and the files that processes exchange.
    avatar: (n, 3) points of every user's avatar [m].
    processes: maximum processes of users.
    budget_ms: time budget of each request; None: an answer waits for its voxels.
    """

    archive: Path
    work: Path
    avatar: NDArray[np.float64] = field(default_factory=figure_points)
    processes: int = 2
    budget_ms: float | None = None


@dataclass
class Outcome:
    """Result of one run.

    trace: the poses actually requested.
    start: when the first frame could be due, time.monotonic() [s].
    empty: RSS of the server when it was warm and its cache empty [bytes].
    memory: of the server from then on.
    strip: snapshots of the resident voxels: seconds since the start, keys.
    stats: the server's cache statistics at the end (`StatsAnswer`), or None.
    faults: some of the error messages.
    """

    trace: Trace
    frames: Frames
    start: float
    ready_seconds: float = 0.0
    empty: int = 0
    memory: Memory = field(default_factory=Memory)
    strip: list[tuple[float, NDArray[np.uint64]]] = field(default_factory=list)
    stats: Any = None
    faults: list[str] = field(default_factory=list)


def save_avatar(setup: Setup) -> str:
    """Write the avatar's points for the processes of users; return the path."""
    path = setup.work / "avatar.npy"
    np.save(path, setup.avatar)
    return str(path)


def run(setup: Setup, trace: Trace, budget: int, policy: str | None, adversary: bool = False) -> Outcome:
    """Serve the archive with a cache of `budget` bytes and drive the users of a trace.

    adversary: the trace determines users and times; the adversaries choose the poses.
    Raises ServerError where something did not start.
    """
    log = setup.work / "server.log"
    with load_server.serving(setup.archive, budget, policy, log) as served, ExitStack() as stack:
        watcher = load_server.Watcher(served.process)
        watcher.look(True)
        empty = watcher.memory.rss[-1]
        watcher.start()
        job = Job(served.endpoint, "", "", load_server.SCENE, save_avatar(setup), setup.budget_ms)
        if adversary:
            job = msgspec.structs.replace(job, archive=str(setup.archive), budget=budget)
        # Adversaries share their knowledge within one process: in several processes none would know
        # what is evicted.
        users = Users(stack, setup, trace, job, 1 if adversary else setup.processes)
        strip = stack.enter_context(Strip(served.endpoint, float(trace.time[-1])))
        start = users.go()
        strip.begin(start)
        found = users.results()
        stats = strip.end()
        memory = watcher.stop()
    pose = np.concatenate([more["pose"] for _, more in found])
    user = np.concatenate([frames.user for frames, _ in found])
    due = np.concatenate([frames.due for frames, _ in found])
    frames = results.merged([frames for frames, _ in found])
    asked = Trace(frames.user, trace.time, pose[np.lexsort((user, due))])
    faults = [str(text) for _, more in found for text in more["faults"]]
    return Outcome(asked, frames, start, served.seconds, empty, memory, strip.pictures, stats, faults)


def run_echo(setup: Setup, trace: Trace, request_bytes: int, reply_bytes: int) -> Outcome:
    """Run the same load on a bare echo: as many sessions, as many requests at the same times and sizes."""
    with load_server.echoing(reply_bytes, setup.work / "echo.log") as endpoint, ExitStack() as stack:
        job = Job(endpoint, "", "", request_bytes=request_bytes)
        users = Users(stack, setup, trace, job, setup.processes)
        start = users.go()
        found = users.results()
    faults = [str(text) for _, more in found for text in more["faults"]]
    return Outcome(trace, results.merged([frames for frames, _ in found]), start, faults=faults)


def message_sizes(setup: Setup, trace: Trace, budget: int) -> tuple[int, int]:
    """Return the bytes of a request and of its answer as they are sent."""
    pose = trace.pose[:1]
    request = CollideRequest(AVATAR, pose, 0.0, budget_ms=setup.budget_ms)
    with (
        load_server.serving(setup.archive, budget, None, setup.work / "server.log") as served,
        Client(served.endpoint, scene=load_server.SCENE) as client,
    ):
        client.add_avatar(AVATAR, setup.avatar)
        return len(encode(request)), len(encode(client.collide(AVATAR, pose)))


class Users:
    """Processes of users; their sessions are open once this object exists."""

    def __init__(self, stack: ExitStack, setup: Setup, trace: Trace, job: Job, processes: int) -> None:
        """Start the processes. stack: ends the processes."""
        names = np.unique(trace.user)
        count = max(1, min(processes, len(names)))
        self._length = float(trace.time[-1])
        self._processes: list[subprocess.Popen[str]] = []
        self._outs: list[Path] = []
        commands = []
        for number in range(count):
            paths = {what: str(setup.work / f"users-{number}.{what}.npz") for what in ("trace", "out")}
            user_traces.save(Path(paths["trace"]), user_traces.of_users(trace, names[number::count]))
            Path(paths["out"]).unlink(missing_ok=True)
            path = setup.work / f"users-{number}.json"
            path.write_bytes(msgspec.json.encode(msgspec.structs.replace(job, **paths)))
            commands.append(
                (
                    load_server.module_command(user_process.__name__, str(path)),
                    setup.work / f"users-{number}.log",
                )
            )
            self._outs.append(Path(paths["out"]))
        for command, log in commands:
            self._processes.append(stack.enter_context(load_server.running(command, log, "ready")))

    def go(self) -> float:
        """Send the start time to all; return it."""
        start = time.monotonic() + LEAD
        for process in self._processes:
            assert process.stdin is not None
            process.stdin.write(f"{start!r}\n")
            process.stdin.flush()
        return start

    def results(self) -> list[tuple[Frames, dict[str, NDArray]]]:
        """Wait until all are done. Raises ServerError where one of them failed."""
        deadline = time.monotonic() + LEAD + self._length + 2 * LAST_ANSWERS + 30.0
        for process, out in zip(self._processes, self._outs, strict=True):
            try:
                code: Any = process.wait(max(1.0, deadline - time.monotonic()))
            except subprocess.TimeoutExpired:
                code = "none: still at work"
            if code != 0:
                said = out.with_name(out.name.replace(".out.npz", ".log")).read_text(errors="replace")
                raise load_server.ServerError(
                    f"a process of users ended with exit code {code}: {said[-2000:]}"
                )
        return [results.load(out) for out in self._outs]


class Strip:
    """Snapshots of the resident voxels, from a server that reports them; none from any other."""

    def __init__(self, endpoint: str, length: float) -> None:
        """Prepare the snapshots. length: of the run [s]."""
        self.pictures: list[tuple[float, NDArray[np.uint64]]] = []
        self._length = length
        self._done = threading.Event()
        self._thread: threading.Thread | None = None
        self._client = Client(endpoint, scene=load_server.SCENE)

    def __enter__(self) -> "Strip":
        self._client.__enter__()
        return self

    def __exit__(self, *_: object) -> None:
        self._done.set()
        if self._thread is not None:
            self._thread.join()
        self._client.close()

    def begin(self, start: float) -> None:
        """Take snapshots from `start` on, in a thread."""
        self._thread = threading.Thread(target=self._take, args=(start,), daemon=True)
        self._thread.start()

    def _take(self, start: float) -> None:
        for number in range(STRIP):
            at = (number + 0.5) / STRIP * self._length
            if self._done.wait(max(0.0, start + at - time.monotonic())):
                return
            stats = load_server.ask_stats(self._client)
            if stats is None:
                return
            self.pictures.append((at, np.array(stats.keys, np.uint64)))

    def end(self) -> Any:
        """Stop taking snapshots; return the server's final statistics, or None."""
        self._done.set()
        return load_server.ask_stats(self._client)


def cores() -> int:
    """Return the number of cores available to this process."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
