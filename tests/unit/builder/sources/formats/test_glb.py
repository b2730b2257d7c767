"""Test GLB: node transforms, shared meshes, sampled surfaces, and inconsistent documents."""

import json
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scan_cases import read_all
from scan_formats import glb_document, glb_vertices, write_glb
from solidcloud.builder.sources.scan_files import open_scans
from solidcloud.schemas.errors import ScanError

SQUARE = np.array([[0.0, 0, 1], [2, 0, 1], [2, 2, 1], [0, 2, 1]])
CORNERS = np.array([0, 1, 2, 0, 2, 3], "<u2")


def write_square(path: Path, change: Callable[[dict], object] = lambda d: None) -> Path:
    document = glb_document(4, 6)
    change(document)
    return write_glb(path, document, glb_vertices(SQUARE) + CORNERS.tobytes())


def test_vertices_are_where_the_nodes_put_them(tmp_path: Path) -> None:
    def change(document: dict) -> None:
        document["nodes"] = [
            {"children": [1, 2], "translation": [10, 0, 0]},
            {"mesh": 0, "scale": [2, 2, 2], "rotation": [0, 0, 1, 0]},
            {"mesh": 0, "matrix": [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 5, 0, 1]},
            {"mesh": 0},  # in no scene
        ]

    path = write_square(tmp_path / "a.glb", change)
    expected = np.concatenate([SQUARE * [-2, -2, 2] + np.array([10, 0, 0]), SQUARE + np.array([10, 5, 0])])
    assert np.array_equal(read_all(path), expected)
    assert np.array_equal(read_all(path, block_points=3), expected)
    assert open_scans(path)[0].declared_count == 8 and open_scans(path)[0].up == "y"


def test_letters_of_names_and_a_rotation_of_zeros_are_read(tmp_path: Path) -> None:
    """Issue 35: names in Latin-1, a byte order mark in the JSON, and the rotation 0 0 0 0."""

    def change(document: dict) -> None:
        document["nodes"] = [{"mesh": 0, "name": "SuedX", "rotation": [0, 0, 0, 0], "translation": [1, 2, 3]}]

    path = write_square(tmp_path / "a.glb", change)
    path.write_bytes(path.read_bytes().replace(b"SuedX", "S\xfcd\x1b\x9b".encode("latin-1")))
    assert np.array_equal(read_all(path), SQUARE + np.array([1, 2, 3]))
    (note,) = open_scans(path)[0].notes
    assert open_scans(path, spacing=0.5)[0].notes == (note,)
    assert note == f"{path}: scan 0 has a rotation of zeros, read as no rotation: check how the scan lies"
    document = json.dumps(glb_document(4, 6)).encode()
    path.write_bytes(_glb_of(b"\xef\xbb\xbf" + document))
    assert np.array_equal(read_all(path), SQUARE)


def _glb_of(words: bytes) -> bytes:
    """Return the file of the square with these bytes as its JSON."""
    words += b" " * (-len(words) % 4)
    binary = glb_vertices(SQUARE) + CORNERS.tobytes()
    binary += b"\0" * (-len(binary) % 4)
    head = struct.pack("<4sIII4s", b"glTF", 2, 28 + len(words) + len(binary), len(words), b"JSON")
    return head + words + struct.pack("<I4s", len(binary), b"BIN\0") + binary


def test_parts_that_share_their_vertices_give_them_once(tmp_path: Path) -> None:
    def change(document: dict) -> None:
        (primitive,) = document["meshes"][0]["primitives"]
        document["meshes"][0]["primitives"] = [primitive, {**primitive, "material": 1}]

    assert np.array_equal(read_all(write_square(tmp_path / "a.glb", change)), SQUARE)


# The six corners are two triangles; as a strip a third that covers the first and a flat one; as a fan two flat ones.
@pytest.mark.parametrize(("mode", "area"), [(4, 4.0), (5, 6.0), (6, 4.0), (0, 0.0)])
def test_a_surface_is_sampled_by_its_area(mode: int, area: float, tmp_path: Path) -> None:

    def change(document: dict) -> None:
        document["meshes"][0]["primitives"][0]["mode"] = mode

    path = write_square(tmp_path / "a.glb", change)
    if not area:
        with pytest.raises(ScanError, match="vertices without faces"):
            read_all(path, spacing=0.1)
        return
    xyz = read_all(path, spacing=0.1)
    assert (xyz[:, 2] == 1).all() and xyz[:, :2].min() >= 0 and xyz[:, :2].max() <= 2
    assert abs(len(xyz) - area / 0.01) <= 1


LIES: dict[str, tuple[Callable[[dict], object], str]] = {
    "more vertices": (lambda d: d["accessors"][0].update(count=5), "5 rows of 12 bytes, 16 apart"),
    "a view beyond": (lambda d: d["bufferViews"][0].update(byteLength=9999), "the binary part of 76 bytes"),
    "a place beyond": (lambda d: d["accessors"][0].update(byteOffset=8), "from byte 8 of 64"),
    "a stride too short": (lambda d: d["bufferViews"][0].update(byteStride=8), "8 apart"),
    "a negative count": (
        lambda d: d["accessors"][0].update(count=-1),
        "the number -1, expected a whole number",
    ),
    "vertices of 16 bits": (lambda d: d["accessors"][0].update(componentType=5122), "VEC3 of type 5122"),
    "no such accessor": (lambda d: d["accessors"].pop(), "number 1 of 1 accessors"),
    "no such mesh": (lambda d: d["nodes"][0].update(mesh=3), "number 3 of 1 meshes"),
    "a circle": (lambda d: d["nodes"][0].update(children=[0]), "node 0 twice"),
    "another file": (lambda d: d["buffers"][0].update(uri="/etc/hostname"), "in another file"),
    "Draco": (
        lambda d: d["meshes"][0]["primitives"][0].update(extensions={"KHR_draco_mesh_compression": {}}),
        "compressed by Draco",
    ),
    "instances": (
        lambda d: d.update(extensionsRequired=["KHR_materials_unlit", "EXT_mesh_gpu_instancing"]),
        "requires the extension EXT_mesh_gpu_instancing, expected plain meshes",
    ),
    "sparse": (lambda d: d["accessors"][0].update(sparse={"count": 1}), "not sparse"),
    "a matrix that projects": (lambda d: d["nodes"][0].update(matrix=[1.0] * 16), "node 0 with the matrix"),
    "a turn that stretches": (lambda d: d["nodes"][0].update(rotation=[0, 0, 1, 1]), "quaternion of length"),
    "a list for an object": (lambda d: d.update(nodes=[[]]), "expected"),
}


@pytest.mark.parametrize("lie", LIES)
def test_a_document_that_lies_is_refused(lie: str, tmp_path: Path) -> None:
    change, message = LIES[lie]
    path = write_square(tmp_path / "a.glb", change)
    with pytest.raises(ScanError, match=message):
        open_scans(path)


@pytest.mark.parametrize("behind", [b"\0" * 12, b"\0" * 1000, b"unused bytes" * 9])
@pytest.mark.parametrize("last", [False, True])
def test_bytes_that_are_no_vertices_may_follow_them(behind: bytes, last: bool, tmp_path: Path) -> None:
    """Issue 35: files align their parts, to a page for instance; others keep bytes that nothing uses."""
    document, data = glb_document(4, 6), glb_vertices(SQUARE)
    document["accessors"][0].update(min=[0, 0, 1], max=[2, 2, 1])
    if last:
        document["accessors"].pop()
        del document["meshes"][0]["primitives"][0]["indices"], document["bufferViews"][1]
        data += behind
    else:
        document["bufferViews"][1]["byteOffset"] += len(behind)
        data += behind + CORNERS.tobytes()
    path = write_glb(tmp_path / "a.glb", document, data)
    assert np.array_equal(read_all(path), SQUARE)
    document["accessors"][0]["count"] = 3
    with pytest.raises(
        ScanError, match="further vertices, which nothing uses, behind 3, expected a count of all"
    ):
        open_scans(write_glb(tmp_path / "a.glb", document, data))


def test_a_last_vertex_at_the_origin_is_not_taken_for_zeros_between_parts(tmp_path: Path) -> None:
    document = glb_document(4, 6)
    document["accessors"][0]["count"] = 3
    data = glb_vertices(SQUARE[[1, 2, 3, 0]] * [1, 1, 0]) + CORNERS.tobytes()
    with pytest.raises(ScanError, match="further vertices, which nothing uses, behind 3"):
        open_scans(write_glb(tmp_path / "a.glb", document, data))


def test_parts_of_shared_meshes_are_bounded(tmp_path: Path) -> None:
    """A few words are parts without end, a hundred thousand nodes of a mesh of as many primitives."""

    def change(document: dict) -> None:
        document["nodes"] = [{"mesh": 0}] * 20_000
        document["scenes"] = [{"nodes": list(range(20_000))}]
        document["meshes"][0]["primitives"] *= 4

    with pytest.raises(ScanError, match="over 65536 primitives at nodes, expected at most that many"):
        open_scans(write_square(tmp_path / "a.glb", change))


def test_a_triangle_of_no_vertex_is_refused(tmp_path: Path) -> None:
    path = write_glb(tmp_path / "a.glb", glb_document(4, 6), glb_vertices(SQUARE) + (CORNERS + 1).tobytes())
    assert len(read_all(path)) == 4
    with pytest.raises(ScanError, match="a triangle with vertex 4, expected 4 at most"):
        read_all(path, spacing=0.1)
