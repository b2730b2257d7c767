"""Times of calls measured in turn in one process, as ratios to the first of them."""

import math
import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


class Ratio(NamedTuple):
    """A geometric mean of ratios and its 95 % interval."""

    ratio: float
    low: float
    high: float


def mean_ratio(ratios: Floats) -> Ratio:
    """Return the geometric mean of ratios (k,), k >= 2, and its 95 % interval by normal approximation."""
    logs = np.log(ratios)
    half = 1.96 * logs.std(ddof=1) / math.sqrt(len(logs))
    return Ratio(*np.exp([logs.mean(), logs.mean() - half, logs.mean() + half]).tolist())


def time_in_turn(calls: Sequence[Callable[[], Any]], rounds: int) -> Floats:
    """Return the duration (rounds, calls) of each call [s], all calls in turn in each round.

    Disturbances by other work are thus spread over all calls. Each is called once before, untimed.
    """
    for call in calls:
        call()
    spent = np.empty((rounds, len(calls)))
    for row in spent:
        for at, call in enumerate(calls):
            begin = time.perf_counter()
            call()
            row[at] = time.perf_counter() - begin
    return spent
