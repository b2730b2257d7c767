"""Points and radius of an avatar from what a user has: an array, a file or a mesh.

This module imports neither numba nor h5py, and the readers of files only when a file is named.
"""

import os
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike

from ...schemas.errors import BadRequestError
from ...schemas.wire.requests import make_vectors
from .surface_points import cover_surface


class MeshLike(Protocol):
    """Mesh of a library such as trimesh. It may also have `faces`, rows of three vertices."""

    @property
    def vertices(self) -> Any: ...


class AvatarShape(NamedTuple):
    """Shape of an avatar.

    points: (n, 3) in the avatar's frame [m].  radius: of each point's sphere [m]; None: half the
    mean closest-point distance of the points.
    """

    points: ArrayLike
    radius: float | None


def avatar_shape(source: Any, radius: float | None = None) -> AvatarShape:
    """Return the shape of an avatar from any source that `add_avatar` accepts.

    source: points (n, 3) [m], the path of a scan or mesh file, or a mesh object with `vertices` and
    `faces`, such as a `trimesh.Trimesh` or a `trimesh.Scene`.
    radius: of each point's sphere [m]. The surface of a mesh is covered with points such that no
    part of it is farther than the radius from one; None: see `cover_surface`. Points without faces
    are taken as they are.
    Raise BadRequestError for an invalid mesh, ScanError for a file that cannot be read or whose
    reader is not installed, TooLargeError for more than MAX_AVATAR_POINTS points.
    """
    radius = None if radius is None else float(radius)
    if isinstance(source, str | os.PathLike):
        from .avatar_file import read_triangles_or_points

        triangles, points = read_triangles_or_points(Path(source))
        if len(triangles):
            return AvatarShape(*cover_surface(triangles, radius, str(source)))
        return AvatarShape(points, radius)
    if hasattr(source, "to_mesh") and not hasattr(source, "faces"):
        source = source.to_mesh()  # a trimesh.Scene holds several meshes, each at a pose
    if not hasattr(source, "vertices"):
        return AvatarShape(source, radius)
    vertices = make_vectors(source.vertices, "vertices of the mesh")
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
    return AvatarShape(*cover_surface(vertices[faces], radius, "mesh"))
