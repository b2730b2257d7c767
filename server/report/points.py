"""Points of a scan file, all of them for an avatar or evenly thinned for a picture."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...builder.sources.files import open_scans, scan_files
from ...builder.sources.placed import placed
from ...schemas.errors import ScanError, TooLargeError
from ...schemas.messages import MAX_AVATAR_POINTS


def read_avatar(path: Path) -> NDArray[np.float64]:
    """All points (n, 3) of a file [m], as an avatar; meshes give their vertices.

    ScanError: it cannot be read, or holds a point that is not finite. TooLargeError: over a million points.
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
    """About `at_most` of the `points` points of scans, taken at even steps, (n, 3) [m]; ScanError as open_scans."""
    step = max(1, -(-points // at_most))
    blocks = [
        block.xyz[::step]
        for path in scan_files(paths)
        for scan in open_scans(path)
        for block in placed(scan).blocks()
    ]
    thinned = np.concatenate([np.empty((0, 3)), *blocks])
    return thinned[np.isfinite(thinned).all(axis=1)]
