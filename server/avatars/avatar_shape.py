"""Points and radius of an avatar from what a user has: an array, a file or a mesh.

This module imports neither numba nor h5py, and the readers of files only when a file is named.
"""

import os
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ...schemas.errors import BadRequestError
from ...schemas.wire.requests import make_vectors
from ..scene_interface import AvatarShape
from .mesh_inside import closed_parts, fill_inside
from .surface_points import cover_surface

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
        from .avatar_file import read_avatar_file

        read = read_avatar_file(Path(source), up, units, faces=True)
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
