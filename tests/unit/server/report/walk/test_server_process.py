"""Test how long the start of a server is waited for, and what is said if it fails."""

import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from solidcloud.schemas.errors import SolidcloudError
from solidcloud.server.report.walk import server_process
from solidcloud.server.report.walk.server_process import _wait_ready

HANGS = "import time; time.sleep(600)"


@contextmanager
def child(program: str) -> Iterator["subprocess.Popen[str]"]:
    """Run a Python program during the block."""
    process = subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True)
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


@pytest.fixture
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(server_process, "READY_SECONDS", 0.0)
    monkeypatch.setattr(server_process, "_LOOK_SECONDS", 0.01)


@pytest.mark.usefixtures("impatient")
def test_server_that_hangs_is_stopped_and_no_error_of_it_is_claimed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(server_process, "_kernels", frozenset)
    with child(HANGS) as process, pytest.raises(SolidcloudError) as caught:
        _wait_ready(process, Path("hall"), "serving ")
    assert "the server of hall was stopped" in str(caught.value)
    assert "see its error" not in str(caught.value)


def test_server_that_ends_has_an_error_of_its_own() -> None:
    with child("raise SystemExit(3)") as process, pytest.raises(SolidcloudError, match="exit code 3 before"):
        _wait_ready(process, Path("hall"), "serving ")
