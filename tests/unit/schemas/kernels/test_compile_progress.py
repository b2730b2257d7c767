"""Test messages about compilation: soon and rarely."""

import logging

import pytest
from solidcloud.schemas.kernels.compile_progress import CompileProgress

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


def test_a_long_wait_is_reported_after_a_second_and_then_every_ten(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.INFO, NAME):
        compile_for(22.0)
    assert [message.partition(": ")[2] for message in caplog.messages] == [
        "2 functions in 1 s so far",
        "22 functions in 11 s so far",
        "42 functions in 21 s so far",
    ]
