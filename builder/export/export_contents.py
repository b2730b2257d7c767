"""Properties of the points in an exported file, known before it is written."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray


class Contents(NamedTuple):
    """Properties of the points to write, known in advance.

    low, high: (3,) int64 [lattice]; 0 without points.  columns: name -> type, of the stored
    columns.
    whole_intensity: every intensity is an integer that 16 bits hold.
    """

    points: int
    low: NDArray[np.int64]
    high: NDArray[np.int64]
    columns: dict[str, np.dtype]
    whole_intensity: bool
