"""Process of simulated users, each with its own zenoh session; started by load_run.py.

It reads a job, opens the sessions, prints `ready`, reads the start time from standard input, sends
every frame when it is due, and writes the outcomes. An answer is timed once it is decoded, in the
thread that received it.
"""

import gc
import json
import sys
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Protocol

import msgspec
import numpy as np
import zenoh

from .....schemas.wire.answers import CollideAnswers
from .....schemas.wire.encoding import decode_answer, encode
from .....schemas.wire.requests import CollideRequest
from ....avatars.avatar_model import make_avatar
from ....client import Client
from . import frame_outcomes as results
from . import user_traces
from .adversary_user import Adversary, make_adversary
from .frame_clock import pace
from .frame_outcomes import ANSWERED, REFUSED, Frames

AVATAR = "avatar"
LAST_ANSWERS = 6.0  # time limit of the last answers [s], a second above the lifetime of a query
FAULTS = 5  # maximum refusals whose message is kept


class Job(msgspec.Struct, frozen=True):
    """Task of a process.

    trace, out: paths.
    scene: "" to query a bare echo with request_bytes.
    archive, budget: of the server, for adversaries; "": the poses are the trace's.
    avatar: path of its points.
    """

    endpoint: str
    trace: str
    out: str
    scene: str = ""
    avatar: str = ""
    budget_ms: float | None = None
    request_bytes: int = 0
    archive: str = ""
    budget: int = 0


Came = Callable[[bytes | Exception], None]


class Asker(Protocol):
    """Interface of one user's session."""

    def send(self, payload: bytes, came: Came) -> None:
        """Send a request; `came` receives the answer or its error, in another thread."""


class SceneUser(Client):
    """Client that does not wait for its answers."""

    def send(self, payload: bytes, came: Came) -> None:
        """Send a `collide` request; see `Asker`."""
        self._connection.send("collide", payload, [AVATAR], came)


class EchoUser:
    """User of a bare echo (echo_process.py), as in zenoh's examples."""

    def __init__(self, endpoint: str, user: int) -> None:
        config = zenoh.Config()
        config.insert_json5("connect/endpoints", json.dumps([endpoint]))
        config.insert_json5("scouting/multicast/enabled", "false")
        self._config, self._key = config, f"echo/{user}"

    def __enter__(self) -> "EchoUser":
        with ExitStack() as stack:
            session = stack.enter_context(zenoh.open(self._config))
            self._querier = stack.enter_context(session.declare_querier(self._key))
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def send(self, payload: bytes, came: Came) -> None:
        """Query the echo; see `Asker`."""

        def received(reply: zenoh.Reply) -> None:
            ok = reply.ok
            came(RuntimeError("an error reply of the echo") if ok is None else ok.payload.to_bytes())

        self._querier.get(zenoh.handlers.Callback(received, indirect=False), payload=payload)


class Run:
    """Frames in flight: requests sent and replies received."""

    def __init__(self, job: Job, trace: user_traces.Trace, start: float) -> None:
        self.job, self.trace = job, trace
        self.frames: Frames = results.empty(trace.user, start + trace.time)
        self.faults: list[str] = []
        self._open = len(trace.user)
        self._all = threading.Event()
        self._lock = threading.Lock()
        self._echo = bytes(job.request_bytes)
        self._adversary: Adversary | None = None
        if job.archive:
            avatar = make_avatar(np.load(job.avatar))
            self._adversary = make_adversary(Path(job.archive), job.budget, avatar)

    def ask(self, askers: dict[int, Asker], number: int) -> None:
        """Send one frame."""
        user = int(self.trace.user[number])
        if self._adversary is not None:
            self.trace.pose[number] = self._adversary.pose(recent=user % 2 == 0)
        payload = self._echo if not self.job.scene else encode(
            CollideRequest(AVATAR, self.trace.pose[number : number + 1], 0.0, budget_ms=self.job.budget_ms)
        )  # fmt: skip
        self.frames.sent[number] = time.monotonic()
        askers[user].send(payload, lambda answer: self._came(number, answer))

    def _came(self, number: int, payload: bytes | Exception) -> None:
        """Record one answer; called in a zenoh thread."""
        frames = self.frames
        try:
            if isinstance(payload, Exception):
                self._refused(number, str(payload)[:300])
            elif not self.job.scene:
                frames.done[number], frames.status[number] = time.monotonic(), ANSWERED
            else:
                answer = decode_answer(CollideAnswers, payload)
                frames.done[number] = time.monotonic()
                frames.verdict[number] = answer.verdict[0]
                frames.hits[number], frames.misses[number] = answer.hits, answer.misses
                frames.engine[number], frames.wait[number] = answer.engine_seconds, answer.wait_seconds
                frames.resident_bytes[number] = answer.resident_bytes
                frames.status[number] = ANSWERED
                if answer.faults:
                    self.faults.extend(answer.faults[: FAULTS - len(self.faults)])
        except Exception as error:
            self._refused(number, repr(error))
        with self._lock:
            self._open -= 1
            if not self._open:
                self._all.set()

    def _refused(self, number: int, text: str) -> None:
        self.frames.status[number] = REFUSED
        if len(self.faults) < FAULTS:
            self.faults.append(text)

    def wait(self) -> None:
        """Wait until all frames are answered, or the time limit."""
        self._all.wait(LAST_ANSWERS)


def main() -> None:
    """Run the process; the job's path is its one argument."""
    job = msgspec.json.decode(Path(sys.argv[1]).read_bytes(), type=Job)
    trace = user_traces.load(Path(job.trace))
    sys.setswitchinterval(0.0005)
    with ExitStack() as stack:
        askers: dict[int, Asker] = {}
        for user in np.unique(trace.user).tolist():
            if job.scene:
                client = stack.enter_context(SceneUser(job.endpoint, scene=job.scene))
                client.add_avatar(AVATAR, np.load(job.avatar))
                askers[user] = client
            else:
                askers[user] = stack.enter_context(EchoUser(job.endpoint, user))
        run = Run(job, trace, 0.0)
        gc.freeze()  # no garbage collection of existing objects while frames are paced
        print("ready", flush=True)
        start = float(sys.stdin.readline())
        run.frames.due[:] += start
        pace(run.frames.due.tolist(), lambda number: run.ask(askers, number))
        run.wait()
    results.save(Path(job.out), run.frames, pose=trace.pose, faults=np.array(run.faults, np.str_))


if __name__ == "__main__":
    main()
