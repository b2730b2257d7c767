"""Test OBJ and STL: vertices as stored, and sampled surfaces."""

import struct
from pathlib import Path

import numpy as np
import plyfile
import pytest
import trimesh
from scan_cases import read_all
from solidcloud.builder.sources.scan_files import open_scans
from solidcloud.builder.sources.surface_samples import mesh_triangles
from solidcloud.schemas.errors import ScanError

PLY = "ply\nformat ascii 1.0\nelement vertex {}\nproperty double x\nproperty double y\nproperty double z\n"


def write_square(path: Path, side: float) -> None:
    """A square in the plane z = 1, cut into two triangles, and a vertex no face uses."""
    corners = [(0, 0), (side, 0), (side, side), (0, side)]
    vertices = "".join(f"v {x} {y} 1 0.5 0.5 0.5\n" for x, y in corners)
    path.write_text(f"mtllib none.mtl\n{vertices}v 99 99 99\nf 1 2 3\nf 1 3 4\n")


def test_obj_vertices_come_as_they_stand_in_the_file(tmp_path: Path) -> None:
    path = tmp_path / "a.obj"
    path.write_text("v 1 2 3\nv 1 2 3 1.0\n  v\t4 5 6 255 0 0\r\nvt 7 7\nvn 8 8 8\no v 9 9 9\nf 1 2 3\n")
    assert read_all(path).tolist() == [[1, 2, 3], [1, 2, 3], [4, 5, 6]]


def test_vertices_between_line_ends_of_two_kinds_are_not_lost(tmp_path: Path) -> None:
    """Issue 35: a CR within a line of a file with LF hid the vertex behind it."""
    path = tmp_path / "a.obj"
    path.write_bytes(b"o a\nv 1 2 3\rv 4 5 6\nv 7 8 9\r\n")
    assert read_all(path).tolist() == [[1, 2, 3], [4, 5, 6], [7, 8, 9]]


@pytest.mark.parametrize("line", ["v 1 2", "v", "v 1 b 3", "v 1 2 # 3"])
def test_a_broken_obj_vertex_is_refused_with_its_line(line: str, tmp_path: Path) -> None:
    path = tmp_path / "a.obj"
    path.write_text(f"v 1 2 3\nvn 0 0 1\n{line}\nv 4 5 6\n")
    with pytest.raises(ScanError, match=f"line 3 is '{line}', expected 'v' and three numbers"):
        read_all(path)


def test_a_surface_is_sampled_evenly_and_always_alike(tmp_path: Path) -> None:
    path = tmp_path / "square.obj"
    write_square(path, 4.0)
    xyz = read_all(path, spacing=0.1)
    assert len(xyz) == 1600  # area / spacing**2
    assert np.array_equal(xyz[:, 2], np.ones(1600))
    assert (xyz[:, :2] >= 0).all() and (xyz[:, :2] <= 4).all()
    # No place of the square is farther than 1.5 spacings from a sample, none is sampled twice over.
    grid = np.stack(np.meshgrid(*[np.linspace(0, 4, 41)] * 2), axis=-1).reshape(-1, 1, 2)
    assert np.linalg.norm(grid - xyz[None, :, :2], axis=-1).min(axis=1).max() < 0.15
    apart = np.linalg.norm(xyz[:, None] - xyz[None], axis=-1) + np.eye(1600)
    assert 0.06 < apart.min(axis=1).mean() < 0.1
    assert np.array_equal(read_all(path, spacing=0.1), xyz)
    assert np.array_equal(read_all(path, spacing=0.1, block_points=7), xyz)


def test_an_stl_surface_is_sampled_too(tmp_path: Path) -> None:
    path = tmp_path / "a.stl"
    facet = "facet normal 0 0 1\nouter loop\nvertex 0 0 1\nvertex 2 0 1\nvertex 0 2 1\nendloop\nendfacet\n"
    path.write_text(f"solid a\n{facet}endsolid a\n")
    xyz = read_all(path, spacing=0.1)
    assert len(xyz) == 200
    assert (xyz[:, :2].sum(axis=1) <= 2).all() and (xyz[:, 2] == 1).all()


@pytest.mark.parametrize(
    "line", ["v 4 5 6\x0ev 7 8 9", "vn 0 0 1 v 7 8 9", "v 4 5 6#v 7 8 9", "f 1 2 3\x85v 7 8 9"]
)
def test_vertices_that_one_wrong_byte_joins_to_a_line_are_not_lost(line: str, tmp_path: Path) -> None:
    """Issue 35."""
    path = tmp_path / "a.obj"
    path.write_text(f"# v 1\no v 2 3\nv 1 2 3 # v 1\n{line}\n", encoding="latin-1")
    with pytest.raises(ScanError, match=r"line 4 is .*, expected numbers only"):
        read_all(path)


def test_a_binary_stl_may_have_the_words_of_text_in_its_header(tmp_path: Path) -> None:
    path = tmp_path / "a.stl"
    corners = np.arange(9, dtype="<f4")
    record = bytes(12) + corners.tobytes() + bytes(2)
    path.write_bytes(b"solid by FacetModeler".ljust(80) + struct.pack("<I", 1) + record)
    assert np.array_equal(read_all(path), corners.reshape(3, 3))


@pytest.mark.parametrize("name", ["a.obj", "a.stl"])
def test_decimal_commas_are_read_if_no_number_has_a_point(name: str, tmp_path: Path) -> None:
    """Issue 35: programs write them under the settings of many countries."""
    path = tmp_path / name
    lines = [f"v{'ertex' * name.endswith('.stl')} {k},5 -2,25e-1 {k}" for k in range(3)]
    head, end = ("solid a\nfacet\n", "\nendsolid a\n") if name.endswith(".stl") else ("", "\n")
    path.write_text(head + "\n".join(lines) + end)
    assert np.array_equal(read_all(path), [[0.5, -0.225, 0], [1.5, -0.225, 1], [2.5, -0.225, 2]])
    if name.endswith(".obj"):
        path.write_text("v 0,5 0 0\nv 1,5 0 0\nv 0,5 1 0\nvt 0,5 0,5\nf 1/1 2/1 3/1\n")
        assert read_all(path, spacing=0.1).min(axis=0).round(1).tolist() == [0.5, 0, 0]
    path.write_text(head + "\n".join(lines).replace("0,5", "0.5") + end)
    with pytest.raises(ScanError, match=r"line . is .*2,25e-1.*, expected 'v.*' and three numbers"):
        read_all(path)


def test_an_stl_whose_keyword_is_damaged_is_refused(tmp_path: Path) -> None:
    """Issue 35: its point was left out without a word."""
    path = tmp_path / "a.stl"
    path.write_text("solid a\nfacet\nvertex 0 0 1\nvertux 2 0 1\nvertex 0 2 1\nendsolid a\n")
    with pytest.raises(ScanError, match="2 corners, expected three a triangle"):
        read_all(path)


def test_an_stl_may_be_in_capitals(tmp_path: Path) -> None:
    """Issue 35: it was taken for a truncated binary file."""
    path = tmp_path / "a.stl"
    path.write_text(
        "SOLID A\nFACET NORMAL 0 0 1\nOUTER LOOP\nVERTEX 0 0 1\nVERTEX 2 0 1\nVERTEX 0 2 1\nENDLOOP\nENDFACET\n"
        "ENDSOLID A\n"
    )
    assert read_all(path).tolist() == [[0, 0, 1], [2, 0, 1], [0, 2, 1]]


def test_spacing_samples_a_ply_with_faces_and_leaves_scans_alone(tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    faces = "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
    path.write_text(PLY.format(3) + faces + "0 0 0\n2 0 0\n0 2 0\n3 0 1 2\n")
    assert len(read_all(path)) == 3
    assert len(read_all(path, spacing=0.1)) == 200
    scan = tmp_path / "a.xyz"
    scan.write_text("1 2 3\n")
    assert read_all(scan, spacing=0.1).tolist() == [[1, 2, 3]]


@pytest.mark.parametrize("corners", [3, 4])
@pytest.mark.parametrize("text", [True, False])
def test_faces_of_a_ply_are_in_the_order_of_trimesh(corners: int, text: bool, tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    vertex = np.array([tuple(row) for row in rng.normal(size=(50, 3))], [(axis, "f8") for axis in "xyz"])
    face = np.empty(40, [("vertex_index", "i4", corners), ("flags", "u1")])
    face["vertex_index"], face["flags"] = rng.integers(0, 50, (40, corners)), 7
    elements = [plyfile.PlyElement.describe(vertex, "vertex"), plyfile.PlyElement.describe(face, "face")]
    for order in (elements, elements[::-1]):
        plyfile.PlyData(order, text=text).write(tmp_path / "a.ply")
        (scan,) = open_scans(tmp_path / "a.ply")
        expected = trimesh.load_mesh(tmp_path / "a.ply", process=False)
        found = mesh_triangles(scan)
        assert np.allclose(found, expected.vertices[expected.faces], rtol=0, atol=1e-9)
        assert np.array_equal(found[:, 0], read_all(tmp_path / "a.ply")[expected.faces[:, 0]])


@pytest.mark.parametrize("text", [True, False])
def test_faces_of_a_ply_may_have_any_number_of_corners(text: bool, tmp_path: Path) -> None:
    """Issue 35: trimesh refuses binary faces of three and four corners in one file, which Blender writes."""
    corners = [(0, 0, 0), (2, 0, 0), (2, 1, 0), (1, 2, 0), (0, 1, 0)]
    vertex = np.array(corners, [("x", "f4"), ("y", "f4"), ("z", "f4")])
    face = np.empty(4, [("n", "O")])
    face["n"] = [np.array(each, "i4") for each in ([0, 1, 2], [0, 1, 2, 4], [0, 1, 2, 3, 4], [0, 1])]
    elements = [
        plyfile.PlyElement.describe(vertex, "vertex"),
        plyfile.PlyElement.describe(face, "face", val_types={"n": "i4"}),
    ]
    plyfile.PlyData(elements, text=text, byte_order="=" if text else "<").write(tmp_path / "a.ply")
    found = mesh_triangles(*open_scans(tmp_path / "a.ply"))
    area = np.linalg.norm(np.cross(found[:, 1] - found[:, 0], found[:, 2] - found[:, 0]), axis=1) / 2
    assert len(found) == 6 and area.sum() == 1 + 2 + 3
    whole = (tmp_path / "a.ply").read_bytes()
    (tmp_path / "a.ply").write_bytes(whole[:-5])
    with pytest.raises(ScanError, match="ends after 3 face records at most, expected the 4"):
        mesh_triangles(*open_scans(tmp_path / "a.ply"))


def test_a_surface_too_large_for_its_file_is_refused(tmp_path: Path) -> None:
    """As one of a damaged vertex; up to ten million points, and sixteen a byte, it may be of any size."""
    path = tmp_path / "a.obj"
    write_square(path, 100_000.0)
    size = path.stat().st_size
    most = 10**7 + 16 * size
    found = r"a surface of 1e\+10 square lengths, 1e\+10 points"
    expected = rf"{found}, expected at most {most} points from a file of {size} bytes"
    with pytest.raises(ScanError, match=expected):
        read_all(path, spacing=1.0)
    (scan,) = open_scans(path, spacing=1e5 / (most - 1) ** 0.5)
    assert len(next(scan.blocks(1000)).xyz) == 1000
    with pytest.raises(ScanError, match="square lengths"):
        next(open_scans(path, spacing=1e5 / (most + 1) ** 0.5)[0].blocks(1000))


def test_a_face_beyond_the_vertices_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.obj"
    path.write_text("v 1 2 3\nv 4 5 6\nv 7 8 8\nf 1 2 9\n")
    with pytest.raises(ScanError):
        read_all(path, spacing=0.1)


def test_an_stl_without_triangles_is_valid_and_has_no_points(tmp_path: Path) -> None:
    path = tmp_path / "a.stl"
    path.write_text("solid a\nendsolid a\n")
    assert read_all(path).shape == (0, 3)
    path.write_bytes(bytes(84))
    assert read_all(path).shape == (0, 3)
