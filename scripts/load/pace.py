"""The clock of simulated users: an open loop. Each frame has its time, and none waits for the answer to another."""

import time
from collections.abc import Callable, Iterable

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

FRAME = 1.0 / 30.0  # an answer that comes later than this after its frame was due stalls the viewer [s]


def pace(
    due: Iterable[float],
    act: Callable[[int], None],
    clock: Callable[[], float] = time.monotonic,
    sleep: Callable[[float], None] = time.sleep,
) -> None:
    """Call act(0), act(1), ... each as soon as its time has come, never before; due ascends.

    What came late, because `act` took long or the machine was busy, is made up for at once: later times stay as they
    are, so that a slow system is asked as often as a fast one.
    """
    for number, at in enumerate(due):
        while (left := at - clock()) > 0:
            sleep(left)
        act(number)


def stalled(due: Floats, done: Floats, limit: float = FRAME) -> NDArray[np.bool_]:
    """Which frames (k,) had no answer `limit` seconds after they were due; NaN in `done`: never answered."""
    return ~(done - due <= limit)


def after_first(user: NDArray[np.int64], due: Floats, seconds: float = 1.0) -> NDArray[np.bool_]:
    """Which frames (k,) are due at least so long after their user's first one."""
    first = np.full(int(user.max(initial=-1)) + 1, np.inf)
    np.minimum.at(first, user, due)
    return due >= first[user] + seconds
