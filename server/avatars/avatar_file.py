"""Avatars from files: the points of a scan or the vertices of a mesh. Imports all scan readers."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...builder.sources.common.scan import Scan
from ...builder.sources.placed_scan import METRES, TURNS, PlacedScan, place_scan
from ...builder.sources.scan_files import open_scans
from ...builder.sources.surface_samples import mesh_triangles
from ...schemas.errors import BadRequestError, ScanError, TooLargeError
from ...schemas.wire.request_limits import MAX_AVATAR_POINTS


class ReadAvatar(NamedTuple):
    """Content of an avatar's file, in metres with z up.

    triangles: (m, 3, 3) of a mesh.  points: (n, 3) of a file without faces. One of the two is
    empty.
    axes: the up axis and unit that were taken, in words.
    """

    triangles: NDArray[np.float64]
    points: NDArray[np.float64]
    axes: str


def read_avatar(path: Path) -> NDArray[np.float64]:
    """Read the points (n, 3) of an avatar from a scan, or the vertices from a mesh, float64 [m].

    Raise the errors of `read_avatar_file`.
    """
    return read_avatar_file(path).points


def read_avatar_file(
    path: Path, up: str | None = None, units: str | None = None, *, faces: bool = False
) -> ReadAvatar:
    """Read the points of a scan, or the vertices of a mesh.

    up: a key of TURNS, the file's axis that points up.  units: a key of METRES, its unit of length.
    None: what its format states, otherwise z and metres; glTF states y.
    faces: read the triangles of a mesh instead of its vertices.
    Raise ScanError if the file cannot be read, contains no point or one that is not finite,
    TooLargeError if it has more than MAX_AVATAR_POINTS points, BadRequestError for another axis or
    unit.
    """
    for name, word, known in (("up", up, TURNS), ("units", units, METRES)):
        if word is not None and word not in known:
            raise BadRequestError(f"{name} {word!r} of avatar {path}: expected one of {', '.join(known)}")
    scans = open_scans(path)
    if not scans:
        raise ScanError(f"{path}: contains no point: expected at least one: choose another file")
    placed = [place_scan(scan, up=up, units=units) for scan in scans]
    axes = _axes(scans[0], placed[0], up, units)
    triangles = mesh_triangles(scans[0]) if faces and len(scans) == 1 else np.empty((0, 3, 3))
    if not len(triangles):
        return ReadAvatar(triangles, _points(path, placed), axes)
    if isinstance(placed[0], PlacedScan):
        triangles = placed[0].place(triangles.reshape(-1, 3)).reshape(-1, 3, 3)
    return ReadAvatar(triangles, np.empty((0, 3)), axes)


def _axes(scan: Scan, placed: Scan, up: str | None, units: str | None) -> str:
    """Return the up axis and unit in words, with the format where it states one that is not usual."""
    of_format = f" ({'glTF' if scan.format == 'glb' else scan.format})"
    axis = f"{placed.up} up{of_format if up is None and placed.up != 'z' else ''}"
    return f"{axis}, unit {placed.units}{of_format if units is None and placed.units != 'm' else ''}"


def _points(path: Path, scans: Sequence[Scan]) -> NDArray[np.float64]:
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
