"""The same points with colours and classes in every format that has them, and archives read back with them."""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import laspy
import numpy as np
from numpy.typing import NDArray
from plyfile import PlyData, PlyElement
from scan_formats import cartesian, text_rows, write_e57
from solidcloud.builder.sources.common.colours import brightest, eight_bits
from solidcloud.builder.sources.scan_files import open_scans
from solidcloud.builder.voxel.record_points import voxel_points
from solidcloud.schemas.archive.archive import Archive


class Coloured(NamedTuple):
    """Points, colours and classes. xyz: (n, 3).  rgb: (n, 3) uint8.  classes: (n,) uint8."""

    xyz: NDArray[np.float64]
    rgb: NDArray[np.uint8]
    classes: NDArray[np.uint8]


def coloured(seed: int, count: int = 300, classes: int = 32) -> Coloured:
    """Return points on a lattice of millimetres, with random colours; black and white are among them."""
    rng = np.random.default_rng(seed)
    xyz = rng.integers(0, 2000, (count, 3)) / 1000
    rgb = rng.integers(0, 256, (count, 3), dtype=np.uint8)
    rgb[0], rgb[1] = 0, 255
    return Coloured(xyz, rgb, rng.integers(0, classes, count, dtype=np.uint8))


def write_las(path: Path, truth: Coloured, point_format: int = 7, factor: int = 257) -> Path:
    """Write LAS or LAZ by the suffix. factor: of the channels in 16 bits; None of them for format 1."""
    header = laspy.LasHeader(point_format=point_format, version="1.4" if point_format > 5 else "1.2")
    header.scales, header.offsets = np.full(3, 0.001), np.zeros(3)
    las = laspy.LasData(header)
    las.x, las.y, las.z = truth.xyz.T
    if point_format not in (0, 1, 4, 6, 9):
        las.red, las.green, las.blue = truth.rgb.T.astype(np.uint16) * factor
    las.classification = truth.classes
    las.write(str(path))
    return path


def write_ply(path: Path, truth: Coloured, *, text: bool, kind: str, prefix: str = "") -> Path:
    """Write PLY. kind: "u1", "u2" (16 bits) or "f4" (fractions) of the channels.  prefix: of their names."""
    names = [prefix + name for name in ("red", "green", "blue")]
    fields = [(axis, "f8") for axis in "xyz"] + [(name, kind) for name in names] + [("label", "i4")]
    rows = np.empty(len(truth.xyz), fields)
    factor = {"u1": 1, "u2": 257, "f4": 1 / 255}[kind]
    for axis, column in zip("xyz", truth.xyz.T, strict=True):
        rows[axis] = column
    for name, column in zip(names, truth.rgb.T, strict=True):
        rows[name] = column * factor if kind == "f4" else column.astype(kind) * factor
    rows["label"] = truth.classes
    PlyData([PlyElement.describe(rows, "vertex")], text=text).write(str(path))
    return path


def write_pcd(path: Path, truth: Coloured, kind: str, name: str, type_of: str) -> Path:
    """Write PCD with a packed colour. name: of its field.  type_of: "F", "U" or "I"."""
    alpha = 0xFF000000 if name == "rgba" and type_of != "F" else 0
    red, green, blue = truth.rgb.T.astype(np.uint32)
    packed = red << 16 | green << 8 | blue | np.uint32(alpha)
    stored = packed.view({"F": "<f4", "U": "<u4", "I": "<i4"}[type_of])
    record = np.zeros(
        len(truth.xyz),
        [("x", "<f8"), ("y", "<f8"), (name, stored.dtype), ("z", "<f8"), ("label", "<u4")],
    )
    record["x"], record["y"], record["z"] = truth.xyz.T
    record[name], record["label"] = stored, truth.classes
    head = (
        f"VERSION 0.7\nFIELDS x y {name} z label\nSIZE 8 8 4 8 4\nTYPE F F {type_of} F U\nCOUNT 1 1 1 1 1\n"
        f"WIDTH {len(record)}\nHEIGHT 1\nPOINTS {len(record)}\nDATA {kind}\n"
    )
    data = record.tobytes()
    if kind == "ascii":
        data = text_rows(*(record[field] for field in record.dtype.names)).encode()
    path.write_bytes(head.encode() + data)
    return path


def write_rows(path: Path, truth: Coloured, head: str, *, separator: str = " ", classes: bool = True) -> Path:
    """Write text: x y z, then an intensity of 0.5, the colour, and the class."""
    columns = [truth.xyz, np.full(len(truth.xyz), 0.5), truth.rgb]
    rows = text_rows(*columns, *([truth.classes] if classes else []))
    path.write_text(head + rows.replace(" ", separator))
    return path


def write_coloured_e57(path: Path, truth: Coloured, kind: type, limits: dict[str, int] | None = None) -> Path:
    """Write E57 with colours in `kind`, uint8 or uint16."""
    factor = 257 if kind is np.uint16 and not limits else 1
    colours = {
        f"color{name}": truth.rgb[:, k].astype(kind) * kind(factor)
        for k, name in enumerate(("Red", "Green", "Blue"))
    }
    scan = {"columns": {**cartesian(truth.xyz), **colours}}
    return write_e57(path, [{**scan, "limits": limits} if limits else scan])


_LIMITS = {
    f"color{name}{end}": v
    for name in ("Red", "Green", "Blue")
    for end, v in (("Minimum", 0), ("Maximum", 255))
}
_PTX = "1\n300\n0 0 0\n1 0 0\n0 1 0\n0 0 1\n1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n"

# Name of a file -> function that writes 300 points to it. Those of E57, PTX and PTS have no classes.
WRITERS: dict[str, Callable[[Path, Coloured], Path]] = {
    "2.las": lambda p, t: write_las(p, t, 2),
    "3-eight-bits.las": lambda p, t: write_las(p, t, 3, 1),
    "7.las": lambda p, t: write_las(p, t, 7),
    "8-eight-bits.las": lambda p, t: write_las(p, t, 8, 1),
    "2.laz": lambda p, t: write_las(p, t, 2),
    "7.laz": lambda p, t: write_las(p, t, 7),
    "bytes.e57": lambda p, t: write_coloured_e57(p, t, np.uint8),
    "words.e57": lambda p, t: write_coloured_e57(p, t, np.uint16),
    "limits.e57": lambda p, t: write_coloured_e57(p, t, np.uint16, _LIMITS),
    "bytes.ply": lambda p, t: write_ply(p, t, text=False, kind="u1"),
    "words.ply": lambda p, t: write_ply(p, t, text=False, kind="u2"),
    "fractions.ply": lambda p, t: write_ply(p, t, text=False, kind="f4"),
    "diffuse.ply": lambda p, t: write_ply(p, t, text=True, kind="u1", prefix="diffuse_"),
    "text-words.ply": lambda p, t: write_ply(p, t, text=True, kind="u2"),
    "a.ptx": lambda p, t: write_rows(p, t, _PTX, classes=False),
    "counted.pts": lambda p, t: write_rows(p, t, "300\n", classes=False),
    "bare.pts": lambda p, t: write_rows(p, t, "", classes=False),
    "float.pcd": lambda p, t: write_pcd(p, t, "binary", "rgb", "F"),
    "rgba.pcd": lambda p, t: write_pcd(p, t, "binary", "rgba", "U"),
    "float-text.pcd": lambda p, t: write_pcd(p, t, "ascii", "rgb", "F"),
    "rgba-text.pcd": lambda p, t: write_pcd(p, t, "ascii", "rgba", "I"),
    "named.csv": lambda p, t: write_rows(p, t, "x,y,z,i,Red,Green,Blue,Classification\n", separator=","),
    "commented.xyz": lambda p, t: write_rows(p, t, "# x y z i r g b class\n"),
}  # fmt: skip


def has_classes(name: str) -> bool:
    """Return whether a file of WRITERS has classes."""
    return not name.endswith((".e57", ".ptx", ".pts"))


def read_scan(path: Path, block_points: int = 1 << 18) -> Coloured:
    """Read a file of one scan as a build does; a missing column is 0."""
    (scan,) = open_scans(path)
    scan.wanted = frozenset({"rgb", "classification"})
    blocks = list(scan.blocks(block_points))
    xyz = np.concatenate([block.xyz for block in blocks])
    rgb, classes = np.zeros((len(xyz), 3), np.uint8), np.zeros(len(xyz), np.uint8)
    if "rgb" in scan.columns:
        greatest = max(brightest(block.rgb) for block in blocks)
        rgb = np.concatenate([eight_bits(block.rgb, greatest) for block in blocks])
    if "classification" in scan.columns:
        classes = np.concatenate([block.classification for block in blocks])
    return Coloured(xyz, rgb, classes)


def table(points: Coloured) -> NDArray[np.int64]:
    """Return points as rows of integers, millimetres, colour, class, (n, 7), in an order of their own."""
    rows = np.column_stack([np.rint(points.xyz * 1000), points.rgb, points.classes]).astype(np.int64)
    return rows[np.lexsort(rows.T)]


def read_archive(folder: Path) -> Coloured:
    """Read all points of an archive with colours and classes; a missing column is 0."""
    parts = []
    with Archive(folder) as archive:
        lattice = archive.header.lattice
        for row in range(len(archive.voxels)):
            voxel, links = archive.read_voxel(row)
            steps = voxel_points(voxel, links) + archive.coordinates[row] * lattice.voxel_steps
            none = np.zeros(len(steps), np.uint8)
            rgb = np.stack([none] * 3, axis=1) if voxel.rgb is None else voxel.rgb
            classes = none if voxel.classification is None else voxel.classification
            parts.append(Coloured(lattice.to_world(steps), rgb, classes))
    return Coloured(*map(np.concatenate, zip(*parts, strict=True)))
