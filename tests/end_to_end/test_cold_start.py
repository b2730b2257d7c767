"""Test how a server ends that is still compiling: its child ends too, and its next start is told."""

import os
import signal
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

import pytest
from floor import DEADLINE, eventually
from solidcloud.server.cli.warming import kernel_rehearsal, parallel_warming

ARCHIVE = Path(__file__).parents[1] / "golden" / "archive"

pytestmark = pytest.mark.skipif(
    not Path("/proc/self/task").exists() or len(os.sched_getaffinity(0)) < 2,
    reason="children are listed in /proc, and one processor compiles alone",
)


def children_of(pid, module):
    """Return the process ids of the children of a process that run a module.

    Libraries start short-lived children too while they are imported.
    """
    found = []
    for thread in Path(f"/proc/{pid}/task").iterdir():
        with suppress(FileNotFoundError):  # thread or child may have ended
            for child in (thread / "children").read_text().split():
                if module.__name__.encode() in Path(f"/proc/{child}/cmdline").read_bytes():
                    found.append(int(child))
    return found


def runs(pid):
    """Return whether a process exists and is no zombie."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
def test_the_child_of_a_server_that_compiles_ends_with_it(endpoint, tmp_path, number):
    command = [
        sys.executable,
        "-P",
        "-m",
        "solidcloud.server.cli.main",
        "serve",
        str(ARCHIVE),
        "--listen",
        endpoint,
    ]
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}
    with subprocess.Popen(
        command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    ) as process:
        try:
            found = []
            eventually(lambda: found.extend(children_of(process.pid, parallel_warming)) or found)
            (child,) = found
            process.send_signal(number)
            code = process.wait(DEADLINE)
            eventually(lambda: not runs(child))
        finally:
            process.kill()
    assert code == (0 if number == signal.SIGTERM else -number)
    marks = [path for path in (tmp_path / "solidcloud-kernels").iterdir() if path.suffix == ".starting"]
    assert len(marks) == (number == signal.SIGKILL), "a start that was killed is tried before the next one"


def test_a_trial_ends_with_its_parent(tmp_path):
    program = f"import {kernel_rehearsal.__name__} as k; k._run_trial({str(ARCHIVE)!r}, 600.0, None)"
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}
    with subprocess.Popen([sys.executable, "-P", "-c", program], env=environment) as process:
        try:
            found = []
            eventually(lambda: found.extend(children_of(process.pid, kernel_rehearsal)) or found)
        finally:
            process.kill()
    eventually(lambda: not runs(found[0]))
