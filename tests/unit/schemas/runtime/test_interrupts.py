"""Test that signals are deferred until the work checks, or until a block of library calls ends."""

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from solidcloud.schemas.runtime.interrupts import (
    Interrupted,
    blocking_interrupts,
    blocking_sigint,
    check_interrupt,
    deferring_interrupts,
    interrupt_pending,
)
from solidcloud.schemas.runtime.new_hdf5_file import new_hdf5_file


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


def test_an_error_of_the_block_does_not_hide_it() -> None:
    with pytest.raises(KeyboardInterrupt), blocking_interrupts():
        os.kill(os.getpid(), signal.SIGINT)
        raise OSError("the disk")


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


def test_a_process_started_by_others_is_not_reached_by_the_terminal() -> None:
    code = "import signal, sys; sys.exit(signal.SIGINT in signal.pthread_sigmask(signal.SIG_BLOCK, ()))"
    with blocking_sigint():
        assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 1
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
