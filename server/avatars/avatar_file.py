"""Avatars from files: the points of a scan or the vertices of a mesh. Imports all scan readers."""

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...builder.sources.common.scan import Scan
from ...builder.sources.scan_files import open_scans
from ...builder.sources.surface_samples import mesh_triangles
from ...schemas.errors import ScanError, TooLargeError
from ...schemas.wire.request_limits import MAX_AVATAR_POINTS


def read_avatar(path: Path) -> NDArray[np.float64]:
    """Read the points (n, 3) of an avatar from a scan, or the vertices from a mesh, float64 [m].

    Raise ScanError if the file cannot be read, contains no point or one that is not finite,
    TooLargeError if it has more than MAX_AVATAR_POINTS points.
    """
    return _points(path, open_scans(path))


def read_triangles_or_points(path: Path) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Read the triangles (m, 3, 3) of a mesh, or the points (n, 3) of a file without faces [m].

    One of the two is empty. Raise the errors of `read_avatar`.
    """
    scans = open_scans(path)
    triangles = mesh_triangles(scans[0]) if len(scans) == 1 else np.empty((0, 3, 3))
    return triangles, np.empty((0, 3)) if len(triangles) else _points(path, scans)


def _points(path: Path, scans: Iterable[Scan]) -> NDArray[np.float64]:
    """Return the points of scans of one file."""
    blocks = []
    count = 0
    for scan in scans:
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
    if not count:
        raise ScanError(f"{path}: contains no point: expected at least one: choose another file")
    return np.concatenate(blocks)
