"""Points spread over the triangles of a mesh (OBJ, STL, PLY with faces, by trimesh; GLB)."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .glb import GlbScan
from .scan import NOT_FINITE, Block, Scan, reader_library, scan_error

# Steps of the additive sequence in two dimensions with the plastic number 1.3247...: of all such known the
# one whose points keep farthest apart (Roberts 2018, "The unreasonable effectiveness of quasirandom
# sequences"). Any other pair of irrationals is correct too, and clumps more.
STEP_U = 0.7548776662466927
STEP_V = 0.5698402909980532

# A vertex that is damaged makes a surface of any size: few triangles that come to more points than these are taken for
# that. A triangle of a binary STL, the longest there is, may have 800; and a hall of a dozen ten millions.
SAMPLES_A_BYTE = 16
SAMPLES_ANYWAY = 10**7

# trimesh holds a mesh whole: an OBJ takes about five times its file while it is read.
LARGEST_MESH = 512 << 20


class SurfaceSamples(Scan):
    """A mesh's surface as points, area / spacing**2 of them."""

    def __init__(self, vertices: Scan, spacing: float) -> None:
        """vertices: the same file as points.  spacing: side of the square that one point stands for [m]."""
        super().__init__(vertices.path, "mesh")
        self.up = vertices.up
        self._vertices = vertices
        self._spacing = spacing

    def _read(self, block_points: int) -> Iterator[Block]:
        """Sample k lies where k + 1/2 of the samples' area has gone by, at the k-th place of the sequence.

        So the number of points of a triangle follows its area within one, no random number is drawn, and
        nothing is held but the mesh and the running sum of its areas.
        """
        corners = self._triangles()
        area = (
            np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
        )
        # A triangle with a corner that is not finite has no area to sample.
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
                f"at most {most} of a file of {size} bytes",
                "check the mesh and its units, or give a larger --spacing, or cut its triangles up",
            )
        count = int(np.ceil(wanted))
        for start in range(0, count, block_points):
            k = np.arange(start, min(start + block_points, count), dtype=np.float64)
            face = np.searchsorted(total, (k + 0.5) * (total[-1] / count), side="right")
            face = np.minimum(face, len(total) - 1)
            u, v = _unit_triangle((0.5 + STEP_U * k) % 1.0, (0.5 + STEP_V * k) % 1.0)
            a, b, c = corners[face, 0], corners[face, 1], corners[face, 2]
            yield Block(a + u[:, None] * (b - a) + v[:, None] * (c - a), None)

    def _triangles(self) -> NDArray[np.float64]:
        """The corners of all triangles, (n, 3, 3)."""
        corners = (
            self._vertices.triangles() if isinstance(self._vertices, GlbScan) else _by_trimesh(self.path)
        )
        # Of a file without faces trimesh gives nothing, vertices or not.
        if not len(corners) and any(len(block.xyz) for block in self._vertices.blocks()):
            raise scan_error(
                self.path, "vertices and no faces", "a mesh to sample", "build it without --spacing"
            )
        return corners


def _by_trimesh(path: Path) -> NDArray[np.float64]:
    """The corners of all triangles of an OBJ, STL or PLY file, (n, 3, 3). Raises ScanError."""
    size = path.stat().st_size
    if size > LARGEST_MESH:
        raise scan_error(
            path,
            f"a mesh of {size} bytes",
            f"at most {LARGEST_MESH} to sample",
            "split it, or build it without --spacing",
        )
    trimesh = reader_library("trimesh", path)
    # Materials would make trimesh open whatever files the OBJ names.
    mesh = trimesh.load_mesh(path, process=False, skip_materials=True)
    faces = np.asarray(mesh.faces) if hasattr(mesh, "faces") else np.empty((0, 3), np.int64)
    vertices = np.asarray(mesh.vertices, np.float64)
    if len(faces) and (faces.min() < 0 or faces.max() >= len(vertices)):
        raise scan_error(
            path,
            f"a face with vertex {faces.max()} (counted from 0) of {len(vertices)}",
            "faces between its own vertices",
            "fetch the file again, it is truncated or damaged",
        )
    return np.asarray(vertices[faces], np.float64)


def _unit_triangle(u: Any, v: Any) -> tuple[Any, Any]:
    """Map the unit square onto the triangle u + v <= 1, areas kept in proportion.

    u, v: (n,) float64 in [0, 1).  Returns the same. After Heitz 2019, "A low-distortion map between
    triangle and square": folding the square along its diagonal would lay two point sets over each other.
    """
    upper = v > u
    half_u, half_v = u / 2, v / 2
    return np.where(upper, half_u, u - half_v), np.where(upper, v - half_u, half_v)
