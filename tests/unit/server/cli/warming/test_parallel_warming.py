"""Test the child process that compiles while a server warms its scene."""

import os
import subprocess
from pathlib import Path
from typing import Any

import pytest
from solidcloud.schemas.kernels import compiling
from solidcloud.schemas.wire.warming_parts import PARTS
from solidcloud.server.cli.warming import parallel_warming
from solidcloud.server.cli.warming.parallel_warming import main, warmed_in_parallel
from solidcloud.server.scene import Scene

ARCHIVE = Path(__file__).parents[4] / "golden" / "archive"


@pytest.fixture
def started(monkeypatch: pytest.MonkeyPatch) -> list[subprocess.Popen[bytes]]:
    """Return the processes that the module starts, on a machine with two processors."""
    started: list[subprocess.Popen[bytes]] = []
    start = subprocess.Popen

    def noted(*arguments: Any, **options: Any) -> subprocess.Popen[bytes]:
        started.append(start(*arguments, **options))
        return started[-1]

    monkeypatch.setattr(parallel_warming.subprocess, "Popen", noted)
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0, 1})
    return started


def test_nothing_is_started_where_nothing_is_compiled(started: list[subprocess.Popen[bytes]]) -> None:
    with warmed_in_parallel(ARCHIVE):
        pass
    compiling._progress.begin()  # after the block nobody is helped
    assert not started


def test_one_child_compiles_and_is_gone_at_the_end(started: list[subprocess.Popen[bytes]]) -> None:
    with warmed_in_parallel(ARCHIVE):
        compiling._progress.begin()
        compiling._progress.begin()
        assert len(started) == 1 and started[0].returncode is None
    assert started[0].returncode is not None
    assert str(ARCHIVE) in started[0].args  # type: ignore[operator]


def test_one_processor_compiles_alone(
    started: list[subprocess.Popen[bytes]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0})
    with warmed_in_parallel(ARCHIVE):
        compiling._progress.begin()
    assert not started


def test_the_child_warms_all_parts_last_ones_first(monkeypatch: pytest.MonkeyPatch) -> None:
    warmed: list[str] = []
    monkeypatch.setattr(Scene, "warm", lambda scene, *parts: warmed.extend(parts))
    main(str(ARCHIVE))
    assert warmed == list(reversed(PARTS))
