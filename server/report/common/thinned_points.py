"""Thinned points of scan files, for a picture."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ....builder.sources.placed_scan import place_scan
from ....builder.sources.scan_files import find_scan_files, open_scans


def read_thinned(paths: Sequence[Path], points: int, at_most: int) -> NDArray[np.float64]:
    """Read every n-th of the `points` points of scans, about `at_most` in all, (n, 3) [m].

    Raises the errors of open_scans.
    """
    step = max(1, -(-points // at_most))
    blocks = [
        block.xyz[::step]
        for path in find_scan_files(paths)
        for scan in open_scans(path)
        for block in place_scan(scan).blocks()
    ]
    thinned = np.concatenate([np.empty((0, 3)), *blocks])
    return thinned[np.isfinite(thinned).all(axis=1)]
