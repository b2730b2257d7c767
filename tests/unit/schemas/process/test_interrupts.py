"""Test that signals are deferred until the work checks, or until a block of library calls ends."""

import contextlib
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from solidcloud.schemas.process import interrupts
from solidcloud.schemas.process.interrupts import (
    Interrupted,
    blocking_interrupts,
    blocking_sigint,
    check_interrupt,
    deferring_interrupts,
    interrupt_pending,
)
from solidcloud.schemas.process.new_hdf5_file import new_hdf5_file


@pytest.fixture(autouse=True)
def usual_handler() -> Iterator[None]:
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def test_an_interrupt_comes_when_the_block_ends() -> None:
    seen = []
    with pytest.raises(KeyboardInterrupt), blocking_interrupts():
        os.kill(os.getpid(), signal.SIGINT)
        seen.append("went on")
    assert seen == ["went on"]
    with pytest.raises(KeyboardInterrupt):
        signal.raise_signal(signal.SIGINT)  # at once, as before


def test_an_interrupt_comes_when_it_is_asked_for() -> None:
    seen = []
    with pytest.raises(KeyboardInterrupt), blocking_interrupts() as deliver:
        deliver()
        os.kill(os.getpid(), signal.SIGINT)
        seen.append("went on")
        deliver()
        seen.append("too far")
    assert seen == ["went on"]


def test_an_error_of_the_block_does_not_hide_it() -> None:
    with pytest.raises(KeyboardInterrupt), blocking_interrupts():
        os.kill(os.getpid(), signal.SIGINT)
        raise OSError("the disk")


def test_other_threads_and_signals_that_are_ignored_are_left_alone() -> None:
    failed: list[BaseException] = []

    def run() -> None:
        try:
            with blocking_interrupts() as deliver:
                deliver()
        except BaseException as error:
            failed.append(error)

    thread = threading.Thread(target=run)
    thread.start()
    thread.join()
    assert failed == []
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with blocking_interrupts():
        os.kill(os.getpid(), signal.SIGINT)
        assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN


def test_an_interrupt_while_hdf5_writes_is_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Raised in the callback by which HDF5 truncates its file, it came out as a SystemError."""
    truncate = os.ftruncate

    def interrupted(descriptor: int, size: int) -> None:
        truncate(descriptor, size)
        os.kill(os.getpid(), signal.SIGINT)

    monkeypatch.setattr(os, "ftruncate", interrupted)
    with pytest.raises(KeyboardInterrupt), new_hdf5_file(tmp_path / "a.h5") as file:
        file.create_dataset("x", data=np.arange(10))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_is_raised_where_the_work_checks(number: int) -> None:
    seen = []
    before = signal.getsignal(number)
    with pytest.raises(Interrupted), deferring_interrupts():
        check_interrupt()
        os.kill(os.getpid(), number)
        os.kill(os.getpid(), number)  # twice, as a wrapper may pass on what the terminal sent too
        seen.append(interrupt_pending())
        check_interrupt()
        seen.append(False)
    assert seen == [True]
    assert signal.getsignal(number) is before and not interrupt_pending()
    check_interrupt()  # of the next command, nothing has come


def test_whatever_ends_an_interrupted_block_is_an_interrupt() -> None:
    with pytest.raises(Interrupted) as caught, deferring_interrupts():
        os.kill(os.getpid(), signal.SIGINT)
        raise ValueError("of a library")
    assert isinstance(caught.value.__cause__, ValueError)
    with pytest.raises(Interrupted), deferring_interrupts():
        os.kill(os.getpid(), signal.SIGINT)
    with pytest.raises(ValueError), deferring_interrupts():
        raise ValueError("of the file")


def test_a_check_that_was_swallowed_is_made_up_for() -> None:
    with pytest.raises(Interrupted), deferring_interrupts():
        os.kill(os.getpid(), signal.SIGINT)
        with contextlib.suppress(BaseException):
            check_interrupt()


def test_work_that_does_not_check_is_interrupted_where_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(interrupts, "GRACE_SECONDS", 0.05)
    deadline = time.monotonic() + 30
    with pytest.raises(Interrupted), deferring_interrupts():
        os.kill(os.getpid(), signal.SIGINT)
        while time.monotonic() < deadline:
            time.sleep(0.01)
    assert time.monotonic() < deadline


def test_an_interrupt_that_python_has_to_drop_comes_again_without_a_word(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(interrupts, "GRACE_SECONDS", 0.05)

    class Long:
        def __del__(self) -> None:
            until = time.monotonic() + 0.3
            while time.monotonic() < until:
                time.sleep(0.01)

    hook, deadline = sys.unraisablehook, time.monotonic() + 30
    with pytest.raises(Interrupted), deferring_interrupts():
        os.kill(os.getpid(), signal.SIGINT)
        Long()
        while time.monotonic() < deadline:
            time.sleep(0.01)
    assert time.monotonic() < deadline and sys.unraisablehook is hook
    assert capsys.readouterr().err == ""


def test_a_second_signal_after_a_while_does_not_wait(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(Interrupted), deferring_interrupts():
        os.kill(os.getpid(), signal.SIGINT)
        monkeypatch.setattr(interrupts, "GRACE_SECONDS", 0.0)
        os.kill(os.getpid(), signal.SIGINT)
        pytest.fail("it went on")


def test_calls_of_a_library_are_not_interrupted_however_long(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(interrupts, "GRACE_SECONDS", 0.02)
    seen = []
    with pytest.raises(Interrupted), deferring_interrupts():
        with blocking_interrupts():
            os.kill(os.getpid(), signal.SIGINT)
            until = time.monotonic() + 0.2
            while time.monotonic() < until:
                time.sleep(0.01)
            os.kill(os.getpid(), signal.SIGTERM)
            seen.append("went on")
        seen.append("too far")
    assert seen == ["went on"]


def test_an_ignored_signal_stays_ignored_and_other_threads_take_none() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with deferring_interrupts():
        os.kill(os.getpid(), signal.SIGINT)
        assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN and not interrupt_pending()
    handlers = []

    def run() -> None:
        with deferring_interrupts():
            handlers.append(signal.getsignal(signal.SIGTERM))

    before = signal.getsignal(signal.SIGTERM)
    thread = threading.Thread(target=run)
    thread.start()
    thread.join()
    assert handlers == [before]


def test_a_block_within_a_block_is_part_of_it() -> None:
    seen = []
    with pytest.raises(Interrupted), deferring_interrupts():
        with deferring_interrupts():
            os.kill(os.getpid(), signal.SIGINT)
        seen.append(interrupt_pending())
        check_interrupt()
    assert seen == [True]


def test_a_process_started_by_others_is_not_reached_by_the_terminal() -> None:
    code = "import signal, sys; sys.exit(signal.SIGINT in signal.pthread_sigmask(signal.SIG_BLOCK, ()))"
    with blocking_sigint():
        assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 1
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
