"""The made floor of fake_server.py as tests ask of it: an avatar, poses, a path over it, a server of its own."""

import subprocess
import sys
import threading
import time
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from fake_server import floor_verdicts

POINTS = np.array([[0.0, 0.0, 0.5], [0.25, 0.0, 1.0], [0.0, 0.25, 1.5]])
DEADLINE = 20.0


@contextmanager
def server_process(endpoint, *arguments):
    """A server in a process of its own, ready. Ended with SIGKILL if it still runs."""
    command = [sys.executable, str(Path(__file__).parent / "fake_server.py"), endpoint, *arguments]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout.readline().startswith("serving ")
            yield process
        finally:
            process.kill()


def eventually(condition):
    """Wait until a condition holds, at most until the deadline."""
    deadline = time.monotonic() + DEADLINE
    while not condition():
        assert time.monotonic() < deadline, "never came true"
        time.sleep(0.01)


def heights(values):
    """Poses at these heights, not turned."""
    poses = np.tile(np.eye(4), (len(values), 1, 1))
    poses[:, 2, 3] = values
    return poses


PATH = heights(np.random.default_rng(6).normal(-0.5, 0.3, 95))
TRUTH = floor_verdicts(POINTS, 0.125, PATH)


def joined(parts):
    """The verdicts of a path's parts, which are all of it and in order."""
    stops = np.cumsum([len(part) for part in parts]).tolist()
    assert [part.first for part in parts] == [0, *stops[:-1]]
    assert {part.total for part in parts} == {stops[-1]}
    return np.concatenate([part.verdict for part in parts])


def sending():
    """The threads that send parts."""
    return [thread for thread in threading.enumerate() if thread.name == "solidcloud-floor-parts"]
