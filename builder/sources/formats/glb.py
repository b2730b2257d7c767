"""GLB reader (binary glTF 2): the vertices of the file's scene, each transformed by its node.

The header and the vertices are read here, in blocks. A general loader would hold the file whole,
open other files that it names, and allocate arrays of any size that it claims. glTF uses metres
with y up [glTF 2.0, 3.4]; this reader does not convert coordinates.
"""

import json
import struct
from bisect import bisect_left
from collections.abc import Iterable, Iterator
from io import BufferedReader
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ....schemas.runtime.interrupts import check_interrupt
from ..common.scan import (
    BLOCK_BYTES,
    BLOCK_POINTS,
    Scan,
    ScanBlock,
    apply_pose,
    library_errors,
    quaternion_pose,
    scan_error,
    zero_rotation_note,
)
from .glb_properties import PROPERTIES, damaged_names, used_bytes

# Maximum bytes of JSON. The JSON of a scene of ten thousand parts takes about 4 MiB; parsed it
# takes thirty times that.
LONGEST_JSON = 8 << 20
# Maximum nodes, and maximum primitives at nodes. Nodes may share a mesh, and a shared part takes no
# JSON. This limit is three times the number of parts that the JSON has room for as separate meshes.
# Resolving a part takes 15 us and half a kilobyte.
MAX_PARTS = 1 << 16
# Maximum triangles to sample. The corners of a triangle take 72 bytes, and sampling holds the whole
# mesh: 1.2 GB for this many.
MAX_TRIANGLES = 1 << 24

# Extensions that do not affect the positions of vertices. Other required extensions may:
# instancing, compression.
HARMLESS = ("KHR_lights_", "KHR_materials_", "KHR_texture_", "EXT_texture_", "MSFT_texture_")

FLOAT = 5126
INDEX_TYPES = {5121: "<u1", 5123: "<u2", 5125: "<u4"}
TRIANGLES, STRIP, FAN = 4, 5, 6


class _Accessor(NamedTuple):
    """Accessor: `rows` rows of `width` values, `stride` bytes apart, from byte `start` of the file.

    type: numpy type of a value.
    """

    start: int
    stride: int
    rows: int
    type: str
    width: int


class _Primitive(NamedTuple):
    """Primitive of a mesh, before a node places it.

    indices: vertex numbers of the corners; None: vertices in order.
    limits: (3,) least and greatest values that the document states for the vertices.
    view_end: byte of the binary chunk where their buffer view ends.
    """

    vertices: _Accessor
    mode: int
    indices: _Accessor | None
    limits: tuple[NDArray[np.float32], ...]
    view_end: int


class _Part(NamedTuple):
    """Primitive of a mesh at a node.

    pose: (4, 4), mesh frame -> scene.
    indices: vertex numbers of the corners; None: vertices in order.
    """

    vertices: _Accessor
    pose: NDArray[np.float64]
    mode: int
    indices: _Accessor | None


class GlbScan(Scan):
    """Vertices of a GLB file's scene."""

    up = "y"

    def __init__(self, path: Path, parts: list[_Part]) -> None:
        # Parts of a mesh usually share vertices and differ in material and triangles.
        at_nodes = {(part.vertices, part.pose.tobytes()): part for part in parts}
        self._shown = list(at_nodes.values())
        self._parts = parts
        super().__init__(path, "glb", declared_count=sum(part.vertices.rows for part in self._shown))

    def _read(self, block_points: int) -> Iterator[ScanBlock]:
        with self.path.open("rb") as file:
            for part in self._shown:
                for rows in _rows(file, self.path, part.vertices, block_points):
                    yield ScanBlock(apply_pose(part.pose, rows.astype(np.float64)), None)

    def triangles(self) -> NDArray[np.float64]:
        """Return the corners of all triangles, (n, 3, 3).

        Raises ScanError for more than MAX_TRIANGLES.
        """
        total = sum(part.indices.rows if part.indices else part.vertices.rows for part in self._parts)
        if total > 3 * MAX_TRIANGLES:
            raise scan_error(
                self.path,
                f"about {total // 3} triangles",
                f"at most {MAX_TRIANGLES} to sample",
                "split the mesh, or build it without --spacing",
            )
        found = [np.empty((0, 3, 3))]
        with library_errors(self.path), self.path.open("rb") as file:
            for part in self._parts:
                rows = [np.empty((0, 3)), *_rows(file, self.path, part.vertices, part.vertices.rows or 1)]
                vertices = apply_pose(part.pose, np.concatenate(rows).astype(np.float64))
                corners = _corners(file, self.path, part)
                if len(corners) and corners.max() >= len(vertices):
                    raise _damaged(
                        self.path, f"a triangle with vertex {corners.max()}", f"{len(vertices)} at most"
                    )
                found.append(vertices[corners])
        return np.concatenate(found)


def _corners(file: BufferedReader, path: Path, part: _Part) -> NDArray[np.int64]:
    """Return the vertex numbers of a part's triangles, (n, 3)."""
    if part.mode not in (TRIANGLES, STRIP, FAN):
        return np.empty((0, 3), np.int64)
    order = np.arange(part.vertices.rows, dtype=np.int64)
    if part.indices is not None:
        rows = [np.empty((0, 1)), *_rows(file, path, part.indices, part.indices.rows or 1)]
        order = np.concatenate(rows).astype(np.int64)[:, 0]
    if part.mode == TRIANGLES:
        return order[: len(order) // 3 * 3].reshape(-1, 3)
    if len(order) < 3:
        return np.empty((0, 3), np.int64)
    first = order[:-2] if part.mode == STRIP else np.full(len(order) - 2, order[0])
    return np.stack([first, order[1:-1], order[2:]], axis=1)


def _rows(file: BufferedReader, path: Path, accessor: _Accessor, block_rows: int) -> Iterator[NDArray[Any]]:
    """Yield the rows of an accessor, (n, width) of its type, in blocks of bounded memory."""
    item = np.dtype(accessor.type).itemsize
    step = max(1, min(block_rows, BLOCK_BYTES // accessor.stride))
    for begin in range(0, accessor.rows, step):
        count = min(step, accessor.rows - begin)
        # The last row, and the file with it, may end before the row's full stride.
        wanted = (count - 1) * accessor.stride + accessor.width * item
        file.seek(accessor.start + begin * accessor.stride)
        check_interrupt()
        data = file.read(wanted)
        if len(data) < wanted:
            raise _damaged(path, "a file that ends within its vertices", "all its vertices")
        yield np.ndarray((count, accessor.width), accessor.type, data, strides=(accessor.stride, item))


def _held(rows: NDArray[Any], primitive: _Primitive) -> NDArray[np.bool_]:
    """Return which of vertices (n, 3) lie within the stated limits of a primitive."""
    low, high = primitive.limits
    return np.asarray(((rows >= low) & (rows <= high)).all(axis=1))


def _limits_hold(file: BufferedReader, path: Path, primitive: _Primitive) -> bool:
    """Return whether a primitive has vertices, and all lie within its stated limits."""
    blocks = _rows(file, path, primitive.vertices, BLOCK_POINTS)
    return primitive.vertices.rows > 0 and all(_held(rows, primitive).all() for rows in blocks)


def open_glb(path: Path) -> list[Scan]:
    """Return the one scan of a GLB file; reads its header only. Raises ScanError."""
    with library_errors(path), path.open("rb") as file:
        document, start, size = _read_header(file, path)
        resolved = _Document(path, document, start, size)
        scan = GlbScan(path, resolved.parts())
        scan.notes = resolved.notes
        return [scan]


def _read_header(file: BufferedReader, path: Path) -> tuple[dict[str, Any], int, int]:
    """Return the JSON, and the offset and size of the binary chunk (size 0 where there is none)."""
    held = path.stat().st_size
    head = file.read(20)
    magic, version, length, words, kind = struct.unpack("<4sIII4s", head.ljust(20, b"\0"))
    if magic != b"glTF" or version != 2 or kind != b"JSON":
        raise _damaged(
            path, f"a file that begins with {head[:8]!r}", "b'glTF' of version 2, with a JSON part"
        )
    if length > held or words > min(length - 20, LONGEST_JSON):
        raise _damaged(
            path,
            f"{length} bytes with {words} of JSON in a file of {held}",
            f"at most the file's size, and at most {LONGEST_JSON} of JSON",
        )
    # Names with letters of another encoding, or with control characters, do not matter here.
    document = json.loads(file.read(words).decode("utf-8-sig", "replace"), strict=False)
    head = file.read(8)
    size, kind = struct.unpack("<I4s", head) if len(head) == 8 else (0, b"")
    if kind != b"BIN\0":
        size = 0
    if 28 + words + size > length and size:
        raise _damaged(path, f"a binary part of {size} bytes", f"at most the {length - 28 - words} left")
    if not isinstance(document, dict):
        raise _damaged(path, "JSON that is not an object", "a glTF document")
    return document, 28 + words, size


class _Document:
    """JSON of a GLB file, resolved to parts and checked. Its methods may raise anything."""

    def __init__(self, path: Path, document: dict[str, Any], start: int, size: int) -> None:
        """Hold the parsed JSON. start, size: of the binary chunk [bytes]."""
        self.path, self.document, self.start, self.size = path, document, start, size
        self.notes: tuple[str, ...] = ()

    def parts(self) -> list[_Part]:
        """Return every primitive at each node of the scene, in one depth-first walk of the node tree.

        Raises ScanError for more than MAX_PARTS nodes or primitives at nodes.
        """
        self._check_properties("glTF", self.document)
        required = [str(name) for name in self.document.get("extensionsRequired", [])]
        if others := [name for name in required if not name.startswith(HARMLESS)]:
            raise scan_error(
                self.path,
                f"a file that requires the extension {others[0]}",
                "plain meshes at nodes",
                "write it without compression and instancing",
            )
        nodes = self.document.get("nodes", [])
        scenes = self.document.get("scenes", [])
        if scenes:
            roots = self._at("scenes", self.document.get("scene", 0)).get("nodes", [])
        else:
            children = {child for node in nodes for child in node.get("children", [])}
            roots = [k for k in range(len(nodes)) if k not in children]
        found: list[_Part] = []
        meshes: dict[int, list[_Primitive]] = {}
        parts = 0
        waiting = [(root, np.eye(4)) for root in roots]
        seen: set[int] = set()
        while waiting:
            number, outer = waiting.pop()
            if number in seen:
                raise _damaged(self.path, f"node {number} twice in its scene", "a tree of nodes")
            seen.add(number)
            self._check_parts(len(seen), "nodes")
            node = self._at("nodes", number)
            pose = outer @ self._pose(number, node)
            if "mesh" in node:
                parts += len(self._at("meshes", node["mesh"])["primitives"])
                self._check_parts(parts, "primitives at nodes")
                if node["mesh"] not in meshes:
                    meshes[node["mesh"]] = self._mesh(node["mesh"])
                found += [_Part(p.vertices, pose, p.mode, p.indices) for p in meshes[node["mesh"]]]
            waiting += [(child, pose) for child in reversed(node.get("children", []))]
        self._check_ends(primitive for mesh in meshes.values() for primitive in mesh)
        if self.document.get("meshes") and not found:
            raise _damaged(self.path, "meshes of which no node of the scene shows one", "a mesh at a node")
        return found

    def _check_ends(self, primitives: Iterable[_Primitive]) -> None:
        """Refuse vertices behind which the binary chunk has others that nothing uses.

        A count that is too small would leave these out. Zeros behind the buffer view, which align
        what follows, are no vertices. Neither are values beyond the accessor's least and greatest,
        if those are right.
        Raises ScanError.
        """
        views = [self._at("bufferViews", k) for k in range(len(self.document.get("bufferViews", [])))]
        begins, ends = used_bytes(self.document.get("accessors", []), views)
        with self.path.open("rb") as file:
            for accessor, own in {each.vertices: each for each in primitives}.items():
                row = np.dtype(accessor.type).itemsize * accessor.width
                at = accessor.start - self.start + accessor.rows * accessor.stride
                before = bisect_left(begins, at + row)
                if before and ends[before - 1] > at:
                    continue
                past = begins[before] if before < len(begins) else self.size
                count = max(0, past - at - row + accessor.stride) // accessor.stride
                behind = accessor._replace(start=self.start + at, rows=count)
                in_view = (own.view_end - at - row + accessor.stride) // accessor.stride
                for rows in _rows(file, self.path, behind, BLOCK_POINTS):
                    found = rows[rows.any(axis=1) | (np.arange(len(rows)) < in_view)]
                    if len(found) and (_held(found, own).any() or not _limits_hold(file, self.path, own)):
                        raise _damaged(
                            self.path,
                            f"further vertices, which nothing uses, behind {accessor.rows}",
                            "a count of all of them",
                        )
                    in_view -= len(rows)

    def _check_parts(self, parts: int, what: str) -> None:
        if parts > MAX_PARTS:
            raise scan_error(
                self.path, f"over {MAX_PARTS} {what}", "at most that many", "join meshes, or split the scene"
            )

    def _mesh(self, number: int) -> list[_Primitive]:
        """Return the primitives of a mesh that have positions."""
        primitives = [self._primitive(primitive) for primitive in self._at("meshes", number)["primitives"]]
        return [primitive for primitive in primitives if primitive is not None]

    def _pose(self, number: int, node: dict[str, Any]) -> NDArray[np.float64]:
        """Return the transform (4, 4) from a node to its parent.

        A node states a matrix by columns, or a scale, then a rotation, then a translation.
        """
        if "matrix" in node:
            pose = np.array(node["matrix"], np.float64).reshape(4, 4).T
        else:
            x, y, z, w = (float(v) for v in node.get("rotation", (0, 0, 0, 1)))
            pose = quaternion_pose(self.path, number, (w, x, y, z), node.get("translation", (0, 0, 0)))
            self.notes = self.notes or zero_rotation_note(self.path, 0, (w, x, y, z))
            pose[:3, :3] *= np.array(node.get("scale", (1, 1, 1)), np.float64).reshape(3)
        if not np.isfinite(pose).all() or pose[3].tolist() != [0, 0, 0, 1]:
            raise _damaged(
                self.path,
                f"node {number} with the matrix {pose.tolist()}",
                "a finite matrix with last row 0 0 0 1",
            )
        return pose

    def _primitive(self, primitive: dict[str, Any]) -> _Primitive | None:
        """Return a primitive's accessors, or None where it has no positions."""
        self._check_properties("primitives", primitive)
        if primitive.get("extensions", {}).get("KHR_draco_mesh_compression") is not None:
            raise _damaged(
                self.path, "a mesh compressed by Draco", "plain vertices (write it without compression)"
            )
        attributes = primitive["attributes"]
        if wrong := damaged_names(attributes, ["POSITION"]):
            raise _damaged(self.path, f"the attribute {wrong[0]!r}", "'POSITION'")
        if "POSITION" not in attributes:
            return None
        vertices = self._accessor(attributes["POSITION"], "VEC3", {FLOAT: "<f4"})
        counts = {self._at("accessors", number).get("count") for number in attributes.values()}
        if len(counts) > 1:
            raise _damaged(
                self.path, f"attributes of {sorted(map(str, counts))} vertices", "the same number each"
            )
        indices = None
        if "indices" in primitive:
            indices = self._accessor(primitive["indices"], "SCALAR", INDEX_TYPES)
        stated = self._at("accessors", attributes["POSITION"])
        limits = tuple(
            np.array(stated.get(n, [v] * 3), "<f4") for n, v in (("min", -np.inf), ("max", np.inf))
        )
        view = self._at("bufferViews", stated["bufferView"])
        view_end = view.get("byteOffset", 0) + view["byteLength"]
        return _Primitive(vertices, int(primitive.get("mode", TRIANGLES)), indices, limits, view_end)

    def _accessor(self, number: int, shape: str, types: dict[int, str]) -> _Accessor:
        """Return an accessor, checked against its buffer view, and the view against the binary chunk."""
        accessor = self._at("accessors", number)
        if accessor["type"] != shape or accessor["componentType"] not in types or "sparse" in accessor:
            raise _damaged(
                self.path,
                f"accessor {number} of {accessor['type']} of type {accessor['componentType']}",
                f"{shape} of one of {sorted(types)}, not sparse",
            )
        view = self._at("bufferViews", accessor["bufferView"])
        if view.get("buffer", 0) != 0 or view.get("extensions") or "uri" in self._at("buffers", 0):
            raise _damaged(
                self.path,
                f"accessor {number} in another file or compressed",
                "all within the GLB (write it as one file, without compression)",
            )
        type_, width = types[accessor["componentType"]], 3 if shape == "VEC3" else 1
        row = np.dtype(type_).itemsize * width
        offset, count = self._whole(accessor.get("byteOffset", 0)), self._whole(accessor["count"])
        begin, length = self._whole(view.get("byteOffset", 0)), self._whole(view["byteLength"])
        stride = self._whole(view.get("byteStride", row)) or row
        if (
            stride < row
            or begin + length > self.size
            or (count and offset + (count - 1) * stride + row > length)
        ):
            raise _damaged(
                self.path,
                f"accessor {number}: {count} rows of {row} bytes, {stride} apart, from byte {offset} of {length}",
                f"an accessor within its buffer view, and the view within the binary part of {self.size} bytes",
            )
        return _Accessor(self.start + begin + offset, stride, count, type_, width)

    def _at(self, name: str, number: Any) -> dict[str, Any]:
        """Return one entry of a list of the document. Raises ScanError for an invalid index."""
        entries = self.document.get(name, [])
        if not isinstance(number, int) or not 0 <= number < len(entries):
            raise _damaged(self.path, f"number {number!r} of {len(entries)} {name}", "an existing number")
        found: dict[str, Any] = entries[number]
        self._check_properties(name, found)
        return found

    def _check_properties(self, name: str, found: dict[str, Any]) -> None:
        """Raise ScanError for a property whose name is damaged. name: of the object's list."""
        if wrong := damaged_names(found, PROPERTIES.get(name, ())):
            raise _damaged(self.path, f"the property {wrong[0]!r} in {name}", "one of glTF 2.0")

    def _whole(self, number: Any) -> int:
        if not isinstance(number, int) or number < 0:
            raise _damaged(self.path, f"the number {number!r}", "a whole number, 0 or more")
        return number


def _damaged(path: Path, found: str, expected: str) -> Exception:
    return scan_error(
        path, found, expected, "check the program that wrote this file, and that it is complete"
    )
