"""The same points written in every scan format, for tests of the readers."""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import laspy
import numpy as np
import plyfile
import pye57
from scan_formats import glb_document, glb_vertices, ptx_scan, write_glb, write_pcd, write_pts
from solidcloud.builder.sources.scan_files import open_scans


def read_all(path: Path, spacing: float | None = None, block_points: int = 1 << 18) -> np.ndarray:
    """Return the points of all scans of a file, (n, 3)."""
    blocks = [block.xyz for scan in open_scans(path, spacing=spacing) for block in scan.blocks(block_points)]
    return np.concatenate([np.empty((0, 3)), *blocks])


class Truth(NamedTuple):
    """Points within 50 m of a place far from the origin, and their intensities (whole numbers)."""

    xyz: np.ndarray
    intensity: np.ndarray


def write_las(path: Path, truth: Truth) -> None:
    header = laspy.LasHeader(version="1.4", point_format=6)
    header.scales, header.offsets = [0.001] * 3, [990.5, -1990.25, 0.125]
    las = laspy.LasData(header)
    las.x, las.y, las.z = truth.xyz.T
    las.intensity = truth.intensity.astype(np.uint16)
    las.write(path, laz_backend=laspy.LazBackend.Lazrs)


def write_e57(path: Path, truth: Truth) -> None:
    with pye57.E57(str(path), mode="w") as file:
        x, y, z = (truth.xyz - [1000.0, -2000.0, 30.0]).T
        columns = {"cartesianX": x, "cartesianY": y, "cartesianZ": z, "intensity": truth.intensity}
        file.write_scan_raw(columns, translation=np.array([1000.0, -2000.0, 30.0]))


def write_ply(path: Path, truth: Truth, *, text: bool, byte_order: str, real: str = "f8") -> None:
    vertex = np.empty(
        len(truth.xyz), [("x", real), ("y", real), ("z", real), ("red", "u1"), ("scalar_Intensity", "f4")]
    )
    vertex["x"], vertex["y"], vertex["z"] = truth.xyz.T
    vertex["red"], vertex["scalar_Intensity"] = 7, truth.intensity
    face = np.array([([0, 1, 2],)], dtype=[("vertex_indices", "i4", (3,))])
    elements = [plyfile.PlyElement.describe(vertex, "vertex"), plyfile.PlyElement.describe(face, "face")]
    plyfile.PlyData(elements, text=text, byte_order=byte_order).write(path)


def rows_of(truth: Truth, separator: str, end: str = "\n") -> str:
    columns = np.column_stack([truth.xyz, truth.intensity])
    return "".join(separator.join(map(repr, row)) + end for row in columns.tolist())


def write_obj(path: Path, truth: Truth) -> None:
    lines = [f"v {x!r} {y!r} {z!r}\nvn 0 0 1\n" for x, y, z in truth.xyz.tolist()]
    path.write_text("# a comment\nmtllib none.mtl\n" + "".join(lines) + "f 1//1 2//2 3//3\n")


def write_stl(path: Path, truth: Truth) -> None:
    """Write a triangle for every three points; repeat the last point, which is left over."""
    corners = np.concatenate([truth.xyz, truth.xyz[-1:], truth.xyz[-1:]]).reshape(-1, 9)
    record = np.zeros(len(corners), "<f4, (9,)<f4, <u2")
    record = record.astype([("normal", "<f4", 3), ("corners", "<f4", 9), ("attribute", "<u2")])
    record["corners"] = corners
    path.write_bytes(b"solid but binary".ljust(80) + np.uint32(len(corners)).tobytes() + record.tobytes())


def write_ascii_stl(path: Path, truth: Truth) -> None:
    corners = np.concatenate([truth.xyz, truth.xyz[-1:], truth.xyz[-1:]]).reshape(-1, 3, 3)
    text = "solid a\n"
    for triangle in corners.tolist():
        vertices = "".join(f"   vertex {x!r} {y!r} {z!r}\n" for x, y, z in triangle)
        text += f" facet normal 0 0 0\n  outer loop\n{vertices}  endloop\n endfacet\n"
    path.write_text(text + "endsolid a\n")


class Case(NamedTuple):
    """One format, and the largest error of a coordinate in it."""

    name: str
    write: Callable[[Path, Truth], None]
    error: float  # largest error of a coordinate by the format's rounding [m]
    intensity: bool
    repeats: int = 0  # points the format adds at the end


SINGLE = 2.0**-13  # half a float32 step at 2,050 m, and a little


CASES = [
    Case("a.las", write_las, 0.0005 + 1e-9, True),
    Case("a.laz", write_las, 0.0005 + 1e-9, True),
    Case("a.e57", write_e57, 4e-6, True),  # float32 within 50 m of the station
    Case("little.ply", lambda p, t: write_ply(p, t, text=False, byte_order="<"), 0.0, True),
    Case("big.ply", lambda p, t: write_ply(p, t, text=False, byte_order=">"), 0.0, True),
    Case("single.ply", lambda p, t: write_ply(p, t, text=False, byte_order="<", real="f4"), SINGLE, True),
    # plyfile writes both doubles and floats with 18 digits.
    Case("ascii.ply", lambda p, t: write_ply(p, t, text=True, byte_order="="), 0.0, True),
    Case("blanks.xyz", lambda p, t: p.write_text(rows_of(t, "  \t")) and None, 0.0, False),
    Case("count.pts", lambda p, t: p.write_text(f"{len(t.xyz)}\n" + rows_of(t, " ")) and None, 0.0, True),
    Case(
        "header.csv", lambda p, t: p.write_text('"X",Y,z,Intensity\n' + rows_of(t, ",")) and None, 0.0, True
    ),
    Case("crlf.txt", lambda p, t: p.write_bytes(rows_of(t, ";", "\r\n").encode()) and None, 0.0, False),
    Case("a.pts", lambda p, t: write_pts(p, [(t.xyz, t.intensity)]) and None, 0.0, True),
    Case("a.ptx", lambda p, t: p.write_text(ptx_scan(t.xyz, t.intensity, columns=8)) and None, 0.0, True),
    Case("ascii.pcd", lambda p, t: write_pcd(p, *t, "ascii") and None, 0.0, True),
    Case("binary.pcd", lambda p, t: write_pcd(p, *t, "binary") and None, 0.0, True),
    Case("packed.pcd", lambda p, t: write_pcd(p, *t, "binary_compressed") and None, 0.0, True),
    Case(
        "a.glb",
        lambda p, t: write_glb(p, glb_document(len(t.xyz)), glb_vertices(t.xyz)) and None,
        SINGLE,
        False,
    ),
    Case("a.obj", write_obj, 0.0, False),
    Case("binary.stl", write_stl, SINGLE, False, 2),
    Case("ascii.stl", write_ascii_stl, 0.0, False, 2),
]
