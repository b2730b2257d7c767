"""Avatars from files: the points of a scan or the vertices of a mesh. Imports all scan readers."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...builder.sources.scan_files import open_scans
from ...schemas.errors import ScanError, TooLargeError
from ...schemas.wire.request_limits import MAX_AVATAR_POINTS


def read_avatar(path: Path) -> NDArray[np.float64]:
    """Read the points (n, 3) of an avatar from a scan, or the vertices from a mesh, float64 [m].

    Raise ScanError if the file cannot be read or contains a point that is not finite,
    TooLargeError if it has more than MAX_AVATAR_POINTS points.
    """
    blocks = []
    count = 0
    for scan in open_scans(path):
        for block in scan.blocks():
            if not np.isfinite(block.xyz).all():
                raise ScanError(
                    f"{path}: contains a point that is not finite: expected finite coordinates: remove it"
                )
            count += len(block.xyz)
            if count > MAX_AVATAR_POINTS:
                raise TooLargeError(
                    f"{path}: more than {MAX_AVATAR_POINTS} points: expected at most that many: thin it out"
                )
            blocks.append(block.xyz)
    return np.concatenate([np.empty((0, 3)), *blocks])
