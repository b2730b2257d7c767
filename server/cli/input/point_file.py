"""Reading of points from scan files: all points for an avatar, or thinned ones for a picture."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ....builder.sources.placed_scan import place_scan
from ....builder.sources.scan_files import find_scan_files, open_scans
from ....schemas.errors import ScanError, TooLargeError
from ....schemas.wire.messages import MAX_AVATAR_POINTS


def read_avatar(path: Path) -> NDArray[np.float64]:
    """Read all points (n, 3) of a file [m] as an avatar; of a mesh, its vertices.

    Raises ScanError if the file cannot be read or contains a point that is not finite,
    TooLargeError if it has more than a million points.
    """
    blocks = []
    count = 0
    for scan in open_scans(path):
        for block in scan.blocks():
            if not np.isfinite(block.xyz).all():
                raise ScanError(f"{path}: a point that is not finite, expected none in an avatar: remove it")
            count += len(block.xyz)
            if count > MAX_AVATAR_POINTS:
                raise TooLargeError(
                    f"{path}: over {MAX_AVATAR_POINTS} points, expected at most that in an avatar: thin it out"
                )
            blocks.append(block.xyz)
    return np.concatenate([np.empty((0, 3)), *blocks])


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
