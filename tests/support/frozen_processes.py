"""Freeze another process for a test."""

import os
import signal
import time
from pathlib import Path


def freeze(pid: int, patience: float = 30.0) -> None:
    """Send SIGSTOP, and return once every thread of the process has stopped (Linux).

    The signal takes effect after `os.kill` returns: on a busy machine the process answers one more
    query meanwhile.
    """
    os.kill(pid, signal.SIGSTOP)
    end = time.monotonic() + patience
    while not all(state == "T" for state in thread_states(pid)):
        assert time.monotonic() < end, f"process {pid} still runs {patience} s after SIGSTOP"
        time.sleep(0.001)


def thread_states(pid: int) -> list[str]:
    """Return the state letter of each thread of a process, as proc(5) defines them."""
    return [
        stat.read_text().rpartition(")")[2].split()[0] for stat in Path(f"/proc/{pid}/task").glob("*/stat")
    ]
