"""Clock of simulated users, an open loop: each frame has its due time and waits for no other answer."""

import time
from collections.abc import Callable, Iterable

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

FRAME = 1.0 / 30.0  # an answer later than this after its frame was due stalls the viewer [s]


def pace(
    due: Iterable[float],
    act: Callable[[int], None],
    clock: Callable[[], float] = time.monotonic,
    sleep: Callable[[float], None] = time.sleep,
) -> None:
    """Call act(0), act(1), ... each as soon as it is due, never before; due ascends.

    A delay, because `act` took long or the machine was busy, is caught up at once: later times stay
    unchanged. A slow system thus gets as many requests as a fast one.
    """
    for number, at in enumerate(due):
        while (left := at - clock()) > 0:
            sleep(left)
        act(number)


def stalled(due: Floats, done: Floats, limit: float = FRAME) -> NDArray[np.bool_]:
    """Return which frames (k,) had no answer `limit` seconds after they were due; NaN in `done`: never."""
    return ~(done - due <= limit)


def after_first(user: NDArray[np.int64], due: Floats, seconds: float = 1.0) -> NDArray[np.bool_]:
    """Return which frames (k,) are due at least `seconds` after their user's first one."""
    first = np.full(int(user.max(initial=-1)) + 1, np.inf)
    np.minimum.at(first, user, due)
    return due >= first[user] + seconds
