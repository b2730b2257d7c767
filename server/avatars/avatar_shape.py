"""Points and radius of an avatar from what a user has: an array, a scan or mesh file, or a mesh object.

This module imports neither numba nor h5py, and the readers of files only when a file is named.
"""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from ...schemas.errors import BadRequestError, ScanError, TooLargeError
from ...schemas.wire.request_limits import MAX_AVATAR_POINTS
from ...schemas.wire.requests import make_vectors
from ..scene_interface import AvatarShape
from .mesh_points import closed_parts, cover_surface, fill_inside

if TYPE_CHECKING:
    from ...builder.sources.common.scan import Scan

_SURFACE = "a surface, with nothing inside"
# Limits of an avatar's scale.
_LEAST_SCALE, _MOST_SCALE = 0.001, 1000.0


class MeshLike(Protocol):
    """Mesh of a library such as trimesh. It may also have `faces`, rows of three vertices."""

    @property
    def vertices(self) -> Any: ...


def avatar_shape(
    source: Any,
    radius: float | None = None,
    *,
    up: str | None = None,
    units: str | None = None,
    scale: float = 1.0,
    hollow: bool = False,
) -> AvatarShape:
    """Return the shape of an avatar from any source that `add_avatar` accepts.

    source: points (n, 3) [m], the path of a scan or mesh file, or a mesh object with `vertices` and
    `faces`, such as a `trimesh.Trimesh` or a `trimesh.Scene`. A shape is only scaled.
    radius: of each point's sphere [m]. The surface of a mesh is covered with points such that no
    part of it is farther than the radius from one; None: see `cover_surface`. Points without faces
    are taken as they are.
    up, units: the axis of a file that points up, "x", "y" or "z", and its unit of length, a key of
    METRES (placed_scan.py); None: what its format states, otherwise "z" and "m". A point is scaled
    to metres and turned to z up.
    scale: factor of all lengths, the radius too.
    hollow: leave the inside of closed meshes empty; see `fill_inside`.
    Raise BadRequestError for an invalid mesh, ScanError for a file that cannot be read or whose
    reader is not installed, TooLargeError for more than MAX_AVATAR_POINTS points.
    """
    if not _LEAST_SCALE <= scale <= _MOST_SCALE:
        raise BadRequestError(
            f"avatar scale {scale!r}: expected {_LEAST_SCALE:g} to {_MOST_SCALE:g}: scale its points instead"
        )
    if isinstance(source, AvatarShape):
        radius = None if source.radius is None else source.radius * scale
        return source._replace(points=_scaled(source.points, scale), radius=radius)
    radius = None if radius is None else float(radius) * scale
    if isinstance(source, str | os.PathLike):
        read = read_avatar(Path(source), up, units, faces=True)
        if len(read.triangles):
            return _mesh_shape(read.triangles * scale, radius, str(source), hollow, read.axes)
        return AvatarShape(read.points * scale, radius, 0, f"points: {_SURFACE}; {read.axes}")
    if up is not None or units is not None:
        raise BadRequestError(
            "up and units for an avatar that is no file: expected the path of one: turn and scale the points instead"
        )
    if hasattr(source, "to_mesh") and not hasattr(source, "faces"):
        source = source.to_mesh()  # a trimesh.Scene holds several meshes, each at a pose
    if not hasattr(source, "vertices"):
        return AvatarShape(_scaled(source, scale), radius)
    vertices = make_vectors(source.vertices, "vertices of the mesh") * scale
    faces = np.asarray(getattr(source, "faces", ()))
    if not len(faces):
        return AvatarShape(vertices, radius)
    if faces.ndim != 2 or faces.shape[1] != 3 or faces.dtype.kind not in "iu":
        raise BadRequestError(
            f"mesh with faces of shape {faces.shape} and type {faces.dtype}: expected (n, 3) integers: triangulate it"
        )
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise BadRequestError(
            f"mesh with a face of vertex {faces.max() if faces.min() >= 0 else faces.min()}: expected rows of its "
            f"{len(vertices)} vertices, counted from 0"
        )
    return _mesh_shape(vertices[faces], radius, "mesh", hollow)


def _scaled(points: Any, scale: float) -> Any:
    return points if scale == 1.0 else make_vectors(points, "points") * scale


def _mesh_shape(
    triangles: NDArray[np.float64], radius: float | None, what: str, hollow: bool, axes: str = ""
) -> AvatarShape:
    """Return the shape of a mesh (m, 3, 3). axes: description of a file's axes and unit."""
    cover = cover_surface(triangles, radius, what)
    points, inner, text = cover.points, 0, f"open mesh: {_SURFACE}"
    if hollow:
        text = f"mesh, hollow: {_SURFACE}"
    elif cover.radius is not None and (found := closed_parts(triangles)).parts > found.open_parts:
        small = cover.triangles
        if found.open_parts:
            small = cover_surface(triangles[found.closed], cover.radius, what).triangles
        inside = fill_inside(found, small, points, cover.radius, what)
        points, inner = np.concatenate([points, inside]), len(inside)
        text = "closed mesh, filled"
        if found.open_parts:
            closed = found.parts - found.open_parts
            text = f"mesh: {closed} of {found.parts} parts closed and filled, the others {_SURFACE}"
    return AvatarShape(points, cover.radius, inner, f"{text}; {axes}" if axes else text)


class ReadAvatar(NamedTuple):
    """Content of an avatar's file, in metres with z up.

    triangles: (m, 3, 3) of a mesh.  points: (n, 3) of a file without faces. One of the two is
    empty.
    axes: the up axis and unit that were taken, in words.
    """

    triangles: NDArray[np.float64]
    points: NDArray[np.float64]
    axes: str


def read_avatar(
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
    from ...builder.sources.placed_scan import METRES, TURNS, PlacedScan, place_scan
    from ...builder.sources.scan_files import open_scans
    from ...builder.sources.surface_samples import mesh_triangles

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


def _axes(scan: "Scan", placed: "Scan", up: str | None, units: str | None) -> str:
    """Return the up axis and unit in words, with the format where it states one that is not usual."""
    of_format = f" ({'glTF' if scan.format == 'glb' else scan.format})"
    axis = f"{placed.up} up{of_format if up is None and placed.up != 'z' else ''}"
    return f"{axis}, unit {placed.units}{of_format if units is None and placed.units != 'm' else ''}"


def _points(path: Path, scans: Sequence["Scan"]) -> NDArray[np.float64]:
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
