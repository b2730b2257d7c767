"""Synthetic scans by seed, as arrays and small files: plane, corner, pillar, noise and others."""

from pathlib import Path

import laspy
import numpy as np
import plyfile
from numpy.typing import NDArray

KINDS = ("plane", "corner", "pillar", "noise", "duplicates", "one point", "none")
WITH_POINTS = KINDS[:-1]

# All points lie in [0, SIZE) metres on each axis.
SIZE = 2.0


def make_scan(kind: str, seed: int, count: int = 400) -> NDArray[np.float64]:
    """Return points (n, 3) [m] of one of KINDS, equal for equal seeds.

    n is `count`, or given by the kind.
    """
    rng = np.random.default_rng(seed)
    free = rng.uniform(0, SIZE, (count, 3))
    noise = rng.normal(0, 0.001, count)
    if kind == "plane":  # tilted, so that neither its sphere nor its slab is parallel to an axis
        free[:, 2] = 0.5 + 0.25 * free[:, 0] + 0.125 * free[:, 1] + noise
    elif kind == "corner":
        free[np.arange(count), rng.integers(0, 3, count)] = 0.25 + noise
    elif kind == "pillar":
        angle = rng.uniform(0, 2 * np.pi, count)
        free[:, 0] = 1.0 + (0.1 + noise) * np.cos(angle)
        free[:, 1] = 1.0 + (0.1 + noise) * np.sin(angle)
    elif kind == "duplicates":
        free = free[rng.integers(0, max(1, count // 10), count)]
    elif kind == "one point":
        free = free[:1]
    elif kind == "none":
        free = free[:0]
    elif kind != "noise":
        raise ValueError(f"kind {kind!r}, expected one of {KINDS}")
    return np.clip(free, 0, np.nextafter(SIZE, 0))


def make_steps(kind: str, seed: int, count: int, steps: int) -> NDArray[np.int32]:
    """Return the same scan as lattice integers (n, 3), each in [0, steps)."""
    return np.floor(make_scan(kind, seed, count) / SIZE * steps).astype(np.int32)


def write_xyz(path: Path, xyz: NDArray[np.float64], intensity: NDArray[np.float32] | None = None) -> Path:
    """Write three or four named columns as text, every float64 exactly. Returns the path."""
    columns = [xyz] if intensity is None else [xyz, np.asarray(intensity, np.float64)[:, None]]
    names = "x y z\n" if intensity is None else "x y z intensity\n"
    path.write_text(names + "".join(" ".join(map(repr, row)) + "\n" for row in np.hstack(columns).tolist()))
    return path


def write_ply(path: Path, xyz: NDArray[np.float64], intensity: NDArray[np.float32] | None = None) -> Path:
    """Write a binary PLY of doubles. Returns the path."""
    fields = [(axis, "<f8") for axis in "xyz"] + ([] if intensity is None else [("intensity", "<f4")])
    vertices = np.zeros(len(xyz), fields)
    for k, axis in enumerate("xyz"):
        vertices[axis] = xyz[:, k]
    if intensity is not None:
        vertices["intensity"] = intensity
    plyfile.PlyData([plyfile.PlyElement.describe(vertices, "vertex")]).write(path)
    return path


def write_las(
    path: Path,
    raw: NDArray[np.integer],
    *,
    scale: float = 0.001,
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0),
    intensity: NDArray[np.uint16] | None = None,
    point_format: int = 6,
) -> NDArray[np.float64]:
    """Write a LAS, or LAZ, of raw integers (n, 3). Returns their world points (n, 3) [m]."""
    header = laspy.LasHeader(version="1.4" if point_format > 5 else "1.2", point_format=point_format)
    header.scales, header.offsets = [scale] * 3, list(offset)
    las = laspy.LasData(header)
    las.X, las.Y, las.Z = raw.astype(np.int32).T
    if intensity is not None:
        las.intensity = intensity
    las.write(path, laz_backend=laspy.LazBackend.Lazrs)
    return np.asarray(raw, np.float64) * scale + np.array(offset)
