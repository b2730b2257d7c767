"""Avatars from files: all points of a scan, or the vertices of a mesh. Imports the readers of all formats."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...builder.sources.scan_files import open_scans
from ...schemas.errors import ScanError, TooLargeError
from ...schemas.wire.request_limits import MAX_AVATAR_POINTS


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
