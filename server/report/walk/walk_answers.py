"""Types of a walk through a scan and of the answers of its frames."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray


class Walk(NamedTuple):
    """A walk through scans.

    times: (k,) [s].  poses: (k, 4, 4).  path: description in words.
    points: (n, 3) of the scans, thinned [m].
    elevation: the horizontal axis, 0 or 1, of the elevation view.
    """

    times: NDArray[np.float64]
    poses: NDArray[np.float64]
    path: str
    points: NDArray[np.float64]
    elevation: int


class WalkAnswers(NamedTuple):
    """Answers of a walk, one element per pose.

    verdict: (k,) uint8.  engine: (k,) float64, time in the engine [s].
    round_trip: (k,) float64, time from request to answer [s].
    resident, resident_bytes, hits, misses: (k,) int64.
    """

    verdict: NDArray[np.uint8]
    engine: NDArray[np.float64]
    round_trip: NDArray[np.float64]
    resident: NDArray[np.int64]
    resident_bytes: NDArray[np.int64]
    hits: NDArray[np.int64]
    misses: NDArray[np.int64]
