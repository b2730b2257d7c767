"""Triangles of mesh files, OBJ, STL, PLY and GLB, and points spread over them."""

import io
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .common.scan import (
    NOT_FINITE,
    Scan,
    ScanBlock,
    damaged_error,
    library_errors,
    reader_library,
    scan_error,
)
from .common.text_rows import DECIMAL_COMMA, open_text_file, text_chunks
from .formats.glb import GlbScan
from .formats.ply import ply_polygons

# Steps of the additive sequence in two dimensions with the plastic number 1.3247...: the known
# sequence of this kind whose points keep farthest apart (Roberts 2018, "The unreasonable
# effectiveness of quasirandom sequences"). Any other pair of irrationals is correct too, but clumps
# more.
STEP_U = 0.7548776662466927
STEP_V = 0.5698402909980532

# A damaged vertex can make a surface of any size. A mesh that needs more sample points than
# SAMPLES_ANYWAY + SAMPLES_A_BYTE per byte of its file is refused as damaged. This allows 800 points
# per triangle of a binary STL (50 bytes), and ten million for a hall of a dozen triangles.
SAMPLES_A_BYTE = 16
SAMPLES_ANYWAY = 10**7

# Maximum file size that trimesh loads [bytes]. It holds a mesh whole: reading an OBJ takes about
# five times its file size.
LARGEST_MESH = 512 << 20

# A face in an OBJ file.
_OBJ_FACE = re.compile(rb"^[ \t]*f[ \t]", re.MULTILINE)
# A face in an OBJ file that does not name at least three vertices: trimesh leaves out most of
# these.
_BROKEN_OBJ_FACE = re.compile(
    rb"^[ \t]*f(?=\s|\Z)(?!(?:[ \t]+-?0*[1-9]\d*(?:/-?\d*){0,2}){3,}[ \t\r]*(?:#.*)?$).*", re.MULTILINE
)
_DECIMAL_POINT = re.compile(rb"^[ \t]*v[ \t][^\n#]*\.", re.MULTILINE | re.IGNORECASE)
# Letters of names and comments, which trimesh would decode -> "?".
_ASCII = bytes(range(128)) + b"?" * 128


class SurfaceSamples(Scan):
    """Sample points of a mesh's surface, area / spacing**2 of them."""

    def __init__(self, vertices: Scan, spacing: float) -> None:
        """Create the scan.

        vertices: the same file as points.
        spacing: side of the square that one point represents [m].
        """
        super().__init__(vertices.path, "mesh")
        self.up, self.notes = vertices.up, vertices.notes
        self._vertices = vertices
        self._spacing = spacing

    def _read(self, block_points: int) -> Iterator[ScanBlock]:
        """Yield the samples.

        Sample k lies in the triangle at which the cumulative area reaches k + 1/2 samples, at the
        k-th point of the sequence. The number of points in a triangle therefore follows its area
        within one, no random number is drawn, and only the mesh and the cumulative sum of its areas
        are held.
        """
        corners = self._triangles()
        area = (
            np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
        )
        # A triangle with a non-finite corner has no area to sample.
        lost = int(np.count_nonzero(~np.isfinite(area)))
        if lost:
            self.dropped[NOT_FINITE] = lost
        with np.errstate(over="ignore"):
            total = np.cumsum(np.where(np.isfinite(area), area, 0.0))
        wanted = total[-1] / self._spacing**2 if len(total) else 0.0
        size = self.path.stat().st_size
        most = SAMPLES_ANYWAY + SAMPLES_A_BYTE * size
        if not wanted <= most:
            raise scan_error(
                self.path,
                f"a surface of {total[-1]:.3g} square lengths, {wanted:.3g} points",
                f"at most {most} points from a file of {size} bytes",
                "check the mesh and its units, give a larger --spacing, or subdivide its triangles",
            )
        count = int(np.ceil(wanted))
        for start in range(0, count, block_points):
            k = np.arange(start, min(start + block_points, count), dtype=np.float64)
            face = np.searchsorted(total, (k + 0.5) * (total[-1] / count), side="right")
            face = np.minimum(face, len(total) - 1)
            u, v = _unit_triangle((0.5 + STEP_U * k) % 1.0, (0.5 + STEP_V * k) % 1.0)
            a, b, c = corners[face, 0], corners[face, 1], corners[face, 2]
            yield ScanBlock(a + u[:, None] * (b - a) + v[:, None] * (c - a), None)

    def _triangles(self) -> NDArray[np.float64]:
        """Return the corners of all triangles, (n, 3, 3). Raises ScanError."""
        corners = mesh_triangles(self._vertices)
        if not len(corners) and any(len(block.xyz) for block in self._vertices.blocks()):
            raise scan_error(
                self.path, "vertices without faces", "a mesh to sample", "build it without --spacing"
            )
        return corners


def mesh_triangles(vertices: Scan) -> NDArray[np.float64]:
    """Return the corners (n, 3, 3) of all triangles of a file [m]; none if it holds only points.

    vertices: the file as points. Only an OBJ file with faces needs the library trimesh.
    Raises ScanError.
    """
    path = vertices.path
    suffix = path.suffix.lower()
    if isinstance(vertices, GlbScan):
        return vertices.triangles()
    if suffix == ".stl":
        _check_size(path)
        corners = np.concatenate([np.empty((0, 3)), *(block.xyz for block in vertices.blocks())])
        return corners.reshape(-1, 3, 3)
    with library_errors(path):
        if suffix == ".obj" and _has_faces(path):
            return _by_trimesh(path)
        if suffix == ".ply":
            return _ply_triangles(vertices)
    return np.empty((0, 3, 3))


def _has_faces(path: Path) -> bool:
    """Return whether an OBJ file has faces. Raises ScanError."""
    with open_text_file(path) as file:
        return any(_OBJ_FACE.search(chunk) for _, chunk in text_chunks(file, path))


def _ply_triangles(vertices: Scan) -> NDArray[np.float64]:
    """Return the corners (n, 3, 3) of the faces of a PLY file; polygons become fans. Raises ScanError.

    Of faces with four corners the first triangles of all come before the second ones: so does
    trimesh, and samples follow this order.
    """
    polygons = [each for each in ply_polygons(vertices.path) if each.shape[1] > 2]
    if not polygons:
        return np.empty((0, 3, 3))
    _check_size(vertices.path)
    faces = [
        each[:, [k, k + 1, 0] if k > 1 else [0, 1, 2]]
        for each in polygons
        for k in range(1, each.shape[1] - 1)
    ]
    xyz = np.concatenate([np.empty((0, 3)), *(block.xyz for block in vertices.blocks())])
    return _corners(vertices.path, xyz, np.concatenate(faces))


def _check_size(path: Path) -> None:
    """Raise ScanError for a mesh file that is too large to hold whole."""
    size = path.stat().st_size
    if size > LARGEST_MESH:
        raise scan_error(
            path,
            f"a mesh of {size} bytes",
            f"at most {LARGEST_MESH} to sample",
            "split it, or build it without --spacing",
        )


def _by_trimesh(path: Path) -> NDArray[np.float64]:
    """Return the corners (n, 3, 3) of all triangles of an OBJ file. Raises ScanError."""
    _check_size(path)
    trimesh = reader_library("trimesh", path)
    with open_text_file(path) as file:
        text = file.read().translate(_ASCII)
    # As keyword_rows() reads the vertices; trimesh reads no decimal commas.
    if b"," in text and not _DECIMAL_POINT.search(text):
        text = DECIMAL_COMMA.sub(b".", text)
    if broken := _BROKEN_OBJ_FACE.search(text.replace(b"\\\r\n", b"").replace(b"\\\n", b"")):
        raise scan_error(
            path,
            f"the face {broken[0].decode().strip()[:60]!r}",
            "at least three vertices, counted from 1",
            "fetch the file again, it is damaged",
        )
    # With materials, trimesh would open any file that the OBJ names.
    mesh = trimesh.load_mesh(io.BytesIO(text), file_type="obj", process=False, skip_materials=True)
    faces = np.asarray(mesh.faces) if hasattr(mesh, "faces") else np.empty((0, 3), np.int64)
    return _corners(path, np.asarray(mesh.vertices, np.float64), faces)


def _corners(path: Path, vertices: NDArray[np.float64], faces: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return the corners (n, 3, 3) of faces (n, 3), by vertex numbers. Raises ScanError."""
    if len(faces) and (faces.min() < 0 or faces.max() >= len(vertices)):
        raise damaged_error(
            path,
            f"a face with vertex {faces.max()} (counted from 0) of {len(vertices)}",
            "faces between its own vertices",
        )
    return np.asarray(vertices[faces], np.float64)


def _unit_triangle(u: Any, v: Any) -> tuple[Any, Any]:
    """Map the unit square onto the triangle u + v <= 1, areas kept in proportion.

    u, v: (n,) float64 in [0, 1). Returns the same. After Heitz 2019, "A low-distortion map between
    triangle and square": folding the square along its diagonal would overlay two point sets.
    """
    upper = v > u
    half_u, half_v = u / 2, v / 2
    return np.where(upper, half_u, u - half_v), np.where(upper, v - half_u, half_v)
