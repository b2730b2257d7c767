"""Test the lines on standard error while kernels are compiled: only when they are, and counted."""

import os
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from solidcloud.schemas.runtime.kernel_files import KernelFiles
from solidcloud.server.cli.output import compile_notice
from solidcloud.server.cli.output.compile_notice import CompileNotice, compile_notices

pytestmark = pytest.mark.interpreted


class Clock:
    now = 100.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    KernelFiles(tmp_path / "kernels").write("old.kernel", b"code")
    return tmp_path / "kernels"


def watched(folder: Path) -> tuple[list[str], Callable[[float], None]]:
    """Return the lines of a notice, and a function that looks after some seconds."""
    lines: list[str] = []
    clock = Clock()
    notice = CompileNotice(folder, lines.append, clock)

    def after(seconds: float) -> None:
        clock.now += seconds
        notice.look()

    return lines, after


def test_a_start_that_compiles_nothing_says_nothing(folder: Path) -> None:
    lines, after = watched(folder)
    for _ in range(20):
        after(1.0)
    assert lines == []


def test_a_compilation_of_less_than_a_second_says_nothing(folder: Path) -> None:
    files = KernelFiles(folder)
    lines, after = watched(folder)
    assert files.read("new.kernel") is None  # which marks it
    after(0.3)
    after(0.3)
    files.write("new.kernel", b"code")
    for _ in range(10):
        after(0.6)
    assert lines == []


def test_a_longer_one_is_reported_and_counted(folder: Path) -> None:
    files = KernelFiles(folder)
    lines, after = watched(folder)
    for number in range(12):
        assert files.read(f"{number}.kernel") is None
        after(0.5)
        files.write(f"{number}.kernel", b"code")
        after(0.5)
    assert lines == [
        "compiling kernels, once on this machine: please wait",
        "compiling kernels, once on this machine: 11 done in 11 s",
    ]
    for _ in range(3):
        after(1.0)
    assert lines[2:] == ["compiled 12 kernels in 12 s; they are kept for the next start"]


def test_a_mark_that_a_killed_process_left_is_no_compilation(folder: Path) -> None:
    mark = folder / "new.compiling"
    mark.touch()
    os.utime(mark, (time.time() - 60, time.time() - 60))
    lines, after = watched(folder)
    for _ in range(5):
        after(1.0)
    assert lines == []


def test_it_watches_the_folder_that_kernels_are_kept_in(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    for name in ("_LOOK_SECONDS", "_QUIET_SECONDS"):
        monkeypatch.setattr(compile_notice, name, 0.01)
    files = KernelFiles(tmp_path / "solidcloud-kernels")
    with compile_notices():
        deadline, said = time.monotonic() + 10, ""
        while "compiling" not in said and time.monotonic() < deadline:
            files.read("new.kernel")
            said += capsys.readouterr().err
            time.sleep(0.02)
    assert "compiling kernels, once on this machine" in said
