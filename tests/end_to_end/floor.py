"""Avatar, poses, a path and servers for tests on the floor of fake_server.py."""

import subprocess
import sys
import threading
import time
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from fake_server import floor_verdicts
from solidcloud.schemas.wire.warming_parts import READY_LINE

POINTS = np.array([[0.0, 0.0, 0.5], [0.25, 0.0, 1.0], [0.0, 0.25, 1.5]])
DEADLINE = 60.0


@contextmanager
def server_process(endpoint, *arguments, last_line=READY_LINE):
    """Run a server in a separate process until the block ends; yield when it is ready.

    The server is killed if it still runs at the end.  last_line: printed when it is ready.
    """
    command = [sys.executable, str(Path(__file__).parent / "fake_server.py"), endpoint, *arguments]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout.readline().startswith("serving ")
            assert process.stdout.readline().strip() == last_line
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
    """Return poses at these heights, without rotation."""
    poses = np.tile(np.eye(4), (len(values), 1, 1))
    poses[:, 2, 3] = values
    return poses


PATH = heights(np.random.default_rng(6).normal(-0.5, 0.3, 95))
TRUTH = floor_verdicts(POINTS, 0.125, PATH)


def joined(parts):
    """Assert that the parts are a whole path in order; return its verdicts."""
    stops = np.cumsum([len(part) for part in parts]).tolist()
    assert [part.first for part in parts] == [0, *stops[:-1]]
    assert {part.total for part in parts} == {stops[-1]}
    return np.concatenate([part.verdict for part in parts])


def sending():
    """Return the threads that send parts."""
    return [thread for thread in threading.enumerate() if thread.name == "solidcloud-floor-parts"]
