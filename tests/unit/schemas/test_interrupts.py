"""Signals kept back until a block ends or asks for them."""

import os
import signal
import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from solidcloud.schemas.interrupts import kept_back
from solidcloud.schemas.new_file import new_file


@pytest.fixture(autouse=True)
def usual_handler() -> Iterator[None]:
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def test_an_interrupt_comes_when_the_block_ends() -> None:
    seen = []
    with pytest.raises(KeyboardInterrupt), kept_back():
        os.kill(os.getpid(), signal.SIGINT)
        seen.append("went on")
    assert seen == ["went on"]
    with pytest.raises(KeyboardInterrupt):
        signal.raise_signal(signal.SIGINT)  # at once, as before


def test_an_interrupt_comes_when_it_is_asked_for() -> None:
    seen = []
    with pytest.raises(KeyboardInterrupt), kept_back() as deliver:
        deliver()
        os.kill(os.getpid(), signal.SIGINT)
        seen.append("went on")
        deliver()
        seen.append("too far")
    assert seen == ["went on"]


def test_an_error_of_the_block_does_not_hide_it() -> None:
    with pytest.raises(KeyboardInterrupt), kept_back():
        os.kill(os.getpid(), signal.SIGINT)
        raise OSError("the disk")


def test_other_threads_and_signals_that_are_ignored_are_left_alone() -> None:
    failed: list[BaseException] = []

    def run() -> None:
        try:
            with kept_back() as deliver:
                deliver()
        except BaseException as error:
            failed.append(error)

    thread = threading.Thread(target=run)
    thread.start()
    thread.join()
    assert failed == []
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with kept_back():
        os.kill(os.getpid(), signal.SIGINT)
        assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN


def test_an_interrupt_while_hdf5_writes_is_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Raised in the callback by which HDF5 truncates its file, it came out as a SystemError."""
    truncate = os.ftruncate

    def interrupted(descriptor: int, size: int) -> None:
        truncate(descriptor, size)
        os.kill(os.getpid(), signal.SIGINT)

    monkeypatch.setattr(os, "ftruncate", interrupted)
    with pytest.raises(KeyboardInterrupt), new_file(tmp_path / "a.h5") as file:
        file.create_dataset("x", data=np.arange(10))
    assert list(tmp_path.iterdir()) == []
