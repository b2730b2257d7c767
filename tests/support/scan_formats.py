"""Points written in formats that no library here writes: PTX, PTS, PCD, GLB, E57 with every field."""

import json
import struct
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pye57 import libe57

Rows = NDArray[np.float64]


def text_rows(*columns: NDArray) -> str:
    """Return rows of numbers as text, every float64 exactly."""
    table = np.column_stack([np.asarray(column, np.float64) for column in columns])
    return "".join(" ".join(map(repr, row)) + "\n" for row in table.tolist())


def write_pts(path: Path, blocks: Sequence[tuple[Rows, NDArray]]) -> Path:
    """Write a PTS of several blocks of (xyz, intensity)."""
    path.write_text("".join(f"{len(xyz)}\n{text_rows(xyz, light)}" for xyz, light in blocks))
    return path


def ptx_scan(xyz: Rows, light: NDArray, pose: Rows | None = None, columns: int = 1) -> str:
    """Return one scan of a PTX file: a header, and one row per point.

    The number of points is a multiple of `columns`.
    """
    pose = np.eye(4) if pose is None else pose
    head = [f"{columns}", f"{len(xyz) // columns}"]
    for row in (pose[:3, 3], *pose[:3, :3].T, *pose.T):
        head.append(" ".join(map(repr, row.tolist())))
    return "\n".join(head) + "\n" + text_rows(xyz, light)


def lzf(data: bytes) -> bytes:
    """Compress as LZF, by a greedy search for the last occurrence of the next three bytes."""
    out, literals, at, last = bytearray(), bytearray(), 0, {}

    def flush() -> None:
        for k in range(0, len(literals), 32):
            part = literals[k : k + 32]
            out.append(len(part) - 1)
            out.extend(part)
        literals.clear()

    while at < len(data):
        key = data[at : at + 3]
        before = last.get(key, -1)
        last[key] = at
        if len(key) < 3 or before < 0 or at - before > 8192:
            literals.append(data[at])
            at += 1
            continue
        flush()
        length = 3
        while length < 264 and at + length < len(data) and data[at + length] == data[before + length]:
            length += 1
        back = at - before - 1
        if length < 9:
            out.append((length - 2) << 5 | back >> 8)
        else:
            out.extend((7 << 5 | back >> 8, length - 9))
        out.append(back & 255)
        at += length
    flush()
    return bytes(out)


def write_pcd(
    path: Path,
    xyz: Rows,
    light: NDArray,
    kind: str,
    viewpoint: str = "0 0 0 1 0 0 0",
    real: str = "<f8",
    header: str = "",
) -> Path:
    """Write a PCD with a field of three values, padding, and then intensity.

    kind: as in its DATA line.
    """
    size = np.dtype(real).itemsize
    record = np.zeros(
        len(xyz),
        [("normal", "<f4", 3), ("x", real), ("y", real), ("_", "u1"), ("z", real), ("Intensity", "<f4")],
    )
    record["x"], record["y"], record["z"] = xyz.T
    record["normal"], record["_"], record["Intensity"] = 0.5, 3, light
    text = (
        "# .PCD v0.7\nVERSION 0.7\nFIELDS normal x y _ z Intensity\n"
        f"SIZE 4 {size} {size} 1 {size} 4\nTYPE F F F U F F\nCOUNT 3 1 1 1 1 1\n"
        f"WIDTH {len(xyz)}\nHEIGHT 1\nVIEWPOINT {viewpoint}\nPOINTS {len(xyz)}\n{header}DATA {kind}\n"
    )
    data = record.tobytes()
    if kind == "ascii":
        columns = [np.full((len(xyz), 3), 0.5), record["x"], record["y"], record["_"], record["z"], light]
        data = text_rows(*columns).encode()
    elif kind == "binary_compressed":
        data = b"".join(np.ascontiguousarray(record[name]).tobytes() for name in record.dtype.names)
        packed = lzf(data)
        data = struct.pack("<II", len(packed), len(data)) + packed
    path.write_bytes(text.encode() + data)
    return path


def write_glb(path: Path, document: dict, binary: bytes) -> Path:
    """Write a GLB of a document, as JSON, and its binary part."""
    words = json.dumps(document).encode()
    words += b" " * (-len(words) % 4)
    binary += b"\0" * (-len(binary) % 4)
    length = 12 + 8 + len(words) + 8 + len(binary)
    head = struct.pack("<4sIII4s", b"glTF", 2, length, len(words), b"JSON")
    path.write_bytes(head + words + struct.pack("<I4s", len(binary), b"BIN\0") + binary)
    return path


def glb_document(vertices: int, corners: int = 0) -> dict:
    """Return a document with one mesh at one node.

    Its float32 vertices lie 16 bytes apart; uint16 corners of triangles follow.
    """
    attributes = {"POSITION": 0}
    primitive = {"attributes": attributes, "indices": 1} if corners else {"attributes": attributes, "mode": 0}
    size = 16 * vertices
    return {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [primitive]}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": vertices, "type": "VEC3"},
            {"bufferView": 1, "componentType": 5123, "count": corners, "type": "SCALAR"},
        ],
        "bufferViews": [
            {"buffer": 0, "byteOffset": 0, "byteLength": size, "byteStride": 16},
            {"buffer": 0, "byteOffset": size, "byteLength": 2 * corners},
        ],
        "buffers": [{"byteLength": size + 2 * corners}],
    }


def glb_vertices(xyz: Rows) -> bytes:
    """Return vertices in the layout of glb_document()."""
    rows = np.zeros((len(xyz), 4), "<f4")
    rows[:, :3] = xyz
    return rows.tobytes()


def cartesian(xyz: NDArray, real: type = np.float64) -> dict[str, NDArray]:
    """Return the columns x, y, z of an E57 scan."""
    return {f"cartesian{axis}": xyz[:, k].astype(real) for k, axis in enumerate("XYZ")}


def write_e57(path: Path, scans: list[dict], crs: str = "") -> Path:
    """Write an E57 of scans.

    scans: dicts with the keys columns (name -> array), and optionally rotation, translation, bounds
    (2, 3), scaled, limits (name -> number, of the colours).
    scaled: name -> (scale, offset) of columns written as scaled integers; the array holds the
    decoded
    values.
    libE57Format is called directly: pye57 cannot write spherical coordinates, and its bounds do not
    follow the standard.
    """
    image = libe57.ImageFile(str(path), "w")
    image.extensionsAdd("", libe57.E57_V1_0_URI)
    root = image.root()
    root.set("formatName", libe57.StringNode(image, "ASTM E57 3D Imaging Data File"))
    root.set("guid", libe57.StringNode(image, "{1}"))
    root.set("versionMajor", libe57.IntegerNode(image, 1))
    root.set("versionMinor", libe57.IntegerNode(image, 0))
    if crs:
        root.set("coordinateMetadata", libe57.StringNode(image, crs))
    data3d = libe57.VectorNode(image, True)
    root.set("data3D", data3d)

    def numbers(names: list[str], values: np.ndarray) -> libe57.StructureNode:
        node = libe57.StructureNode(image)
        for name, value in zip(names, values, strict=True):
            node.set(name, libe57.FloatNode(image, float(value)))
        return node

    for scan in scans:
        node = libe57.StructureNode(image)
        pose = libe57.StructureNode(image)
        if "rotation" in scan:
            pose.set("rotation", numbers(list("wxyz"), scan["rotation"]))
        if "translation" in scan:
            pose.set("translation", numbers(list("xyz"), scan["translation"]))
        if "rotation" in scan or "translation" in scan:
            node.set("pose", pose)
        if "limits" in scan:
            limits = libe57.StructureNode(image)
            for name, value in scan["limits"].items():
                limits.set(name, libe57.IntegerNode(image, value, 0, 65535))
            node.set("colorLimits", limits)
        if "bounds" in scan:
            names = [f"{axis}{end}" for end in ("Minimum", "Maximum") for axis in "xyz"]
            node.set("cartesianBounds", numbers(names, np.ravel(scan["bounds"])))
        prototype, buffers = libe57.StructureNode(image), libe57.VectorSourceDestBuffer()
        for name, column in scan["columns"].items():
            if name in scan.get("scaled", {}):
                scale, offset = scan["scaled"][name]
                kind = libe57.ScaledIntegerNode(image, 0, -(2**31), 2**31 - 1, scale, offset)
            elif column.dtype == np.int8:
                kind = libe57.IntegerNode(image, 0, 0, 2)
            elif column.dtype.kind == "u":
                kind = libe57.IntegerNode(image, 0, 0, int(np.iinfo(column.dtype).max))
            elif column.dtype == np.float32:
                kind = libe57.FloatNode(image, 0.0, libe57.FloatPrecision.E57_SINGLE)
            else:
                kind = libe57.FloatNode(image, 0.0)
            prototype.set(name, kind)
            buffers.append(libe57.SourceDestBuffer(image, name, column, len(column), True, True))
        points = libe57.CompressedVectorNode(image, prototype, libe57.VectorNode(image, True))
        node.set("points", points)
        data3d.append(node)
        count = len(next(iter(scan["columns"].values())))
        if count:
            writer = points.writer(buffers)
            writer.write(count)
            writer.close()
    image.close()
    return path
