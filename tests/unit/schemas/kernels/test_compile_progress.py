"""Messages about compilation: soon, rarely, and only for long waits."""

import logging
import sys

import pytest
from solidcloud.schemas.kernels.compile_progress import PAUSE, CompileProgress

NAME = "solidcloud.schemas.kernels.compile_progress"


def compile_for(seconds: float, every: float = 0.5) -> CompileProgress:
    """Compile functions one after the other."""
    now = [100.0]
    progress = CompileProgress(lambda: now[0])
    while now[0] < 100.0 + seconds:
        progress.begin()
        now[0] += every
        progress.end()
    return progress


def test_a_short_wait_is_silent(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.INFO, NAME):
        compile_for(0.7, 0.2)
    assert not caplog.messages


def test_a_long_wait_is_reported_after_a_second_and_then_every_ten(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.INFO, NAME):
        compile_for(22.0)
    assert [message.partition(": ")[2] for message in caplog.messages] == [
        "2 functions in 1 s so far",
        "22 functions in 11 s so far",
        "42 functions in 21 s so far",
    ]


def test_a_pause_begins_a_new_count(caplog: pytest.LogCaptureFixture) -> None:
    now = [100.0]
    progress = CompileProgress(lambda: now[0])
    with caplog.at_level(logging.INFO, NAME):
        for _ in range(3):
            progress.begin()
            now[0] += 6.0  # longer than a pause, but one function
            progress.end()
            now[0] += PAUSE
    assert [message.partition(": ")[2] for message in caplog.messages] == ["1 functions in 6 s so far"] * 3


@pytest.mark.parametrize("watched", [True, False])
def test_who_watches_is_warned(
    watched: bool, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys.stderr, "isatty", lambda: watched, raising=False)
    monkeypatch.delitem(sys.modules, "ipykernel", raising=False)
    with caplog.at_level(logging.INFO, NAME):
        compile_for(3.0)
    assert [record.levelno for record in caplog.records] == [logging.WARNING if watched else logging.INFO]


def test_the_first_compilation_is_announced_once() -> None:
    calls = []
    progress = CompileProgress()
    progress.on_first = lambda: calls.append(progress._count)
    progress.begin()
    progress.end()
    progress.begin()
    assert calls == [0]
