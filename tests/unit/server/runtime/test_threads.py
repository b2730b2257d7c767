"""Threads are found by their names, in this process and in the operating system's lists."""

import sys
import threading
from pathlib import Path

import pytest
from solidcloud.server.runtime.threads import start_thread


def test_a_thread_runs_its_function_under_its_name() -> None:
    said = []
    thread = start_thread("hall", lambda *what: said.append((threading.current_thread().name, what)), 1, "b")
    thread.join()
    assert said == [("solidcloud-hall", (1, "b"))] and thread.daemon


@pytest.mark.skipif(sys.platform != "linux", reason="threads have names in /proc on Linux")
def test_the_system_shows_the_end_of_a_long_name() -> None:
    said = []

    def look() -> None:
        said.append(Path(f"/proc/self/task/{threading.get_native_id()}/comm").read_text())

    for name in ("hall", "batalha-monastery-watchdog"):
        start_thread(name, look).join()
    assert said == ["hall\n", "nastery-watchdog\n"[-16:]]
