"""A walk through a scan, and the answers of its frames."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray


class Walk(NamedTuple):
    """A walk to be walked. times: (k,) [s].  poses: (k, 4, 4).  path: where it comes from, in words.

    points: (n, 3) of the scans, thinned [m].  elevation: the horizontal axis that an elevation shows, 0 or 1.
    """

    times: NDArray[np.float64]
    poses: NDArray[np.float64]
    path: str
    points: NDArray[np.float64]
    elevation: int


class Frames(NamedTuple):
    """What was answered, one element a pose: seconds in the engine, seconds from question to answer, the rest.

    verdict: (k,) uint8.  engine, round_trip: (k,) float64 [s].  resident, hits, misses: (k,) int64.
    """

    verdict: NDArray[np.uint8]
    engine: NDArray[np.float64]
    round_trip: NDArray[np.float64]
    resident: NDArray[np.int64]
    resident_bytes: NDArray[np.int64]
    hits: NDArray[np.int64]
    misses: NDArray[np.int64]
