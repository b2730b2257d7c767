"""Threads are found by their names, in this process and in the operating system's lists."""

import sys
import threading
from pathlib import Path

import pytest
from solidcloud.server.runtime import threads
from solidcloud.server.runtime.threads import start_loop, start_thread


@pytest.mark.skipif(sys.platform != "linux", reason="threads have names in /proc on Linux")
def test_the_system_shows_the_end_of_a_long_name() -> None:
    said = []

    def look() -> None:
        said.append(Path(f"/proc/self/task/{threading.get_native_id()}/comm").read_text())

    for name in ("hall", "batalha-monastery-watchdog"):
        start_thread(name, look).join()
    assert said == ["hall\n", "nastery-watchdog\n"[-16:]]


def test_loop_goes_on_after_errors_and_ends_when_it_returns(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Issue 35: threads of the viewer ended for good at the first error."""
    monkeypatch.setattr(threads, "PAUSE", 0.0)
    items, told = [1, 0, 2], []

    def loop(numerator: int) -> None:
        while items:
            told.append(numerator / items.pop(0))

    def failed() -> None:
        told.append("failed")
        raise RuntimeError("no page")

    start_loop("\udcff-loop", loop, 4, failed=failed).join(10.0)
    assert told == [4.0, "failed", 2.0]
    assert "ZeroDivisionError" in caplog.text
    assert "no page" in caplog.text
