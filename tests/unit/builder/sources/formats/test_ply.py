"""Test PLY: the order of elements, unusual line ends, and inconsistent headers."""

import tracemalloc
from pathlib import Path

import numpy as np
import plyfile
import pytest
from scan_cases import read_all
from solidcloud.builder.sources.scan_files import open_scans
from solidcloud.schemas.errors import ScanError

PLY = "ply\nformat ascii 1.0\nelement vertex {}\nproperty double x\nproperty double y\nproperty double z\n"


def test_ply_vertices_behind_another_element_are_found(tmp_path: Path) -> None:
    camera = np.array([(1.0, 2), (3.0, 4)], dtype=[("a", "f8"), ("b", "i2")])
    vertex = np.array([(1.5, 2.5, 3.5), (4.5, 5.5, 6.5)], dtype=[("z", "f8"), ("y", "f8"), ("x", "f4")])
    elements = [plyfile.PlyElement.describe(camera, "camera"), plyfile.PlyElement.describe(vertex, "vertex")]
    for text, byte_order in ((True, "="), (False, "<"), (False, ">")):
        path = tmp_path / f"{text}{byte_order == '>'}.ply"
        plyfile.PlyData(elements, text=text, byte_order=byte_order).write(path)
        assert read_all(path).tolist() == [[3.5, 2.5, 1.5], [6.5, 5.5, 4.5]]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (PLY.replace("double z", "double w").format(1) + "end_header\n1 2 3\n", "vertices without z"),
        (
            "ply\nformat ascii 1.0\nelement face 0\nproperty int a\nend_header\n",
            "expected an element 'vertex'",
        ),
        (
            PLY.replace("property double x\n", "property list uchar int n\nproperty double x\n").format(1)
            + "end_header\n0 1 2 3\n",
            "vertices without x, y, z before their first list",
        ),
        (PLY.format(2) + "property list uchar int n\nend_header\n1.5 2.5 3.5 1 0\n4 5\n", "line 10 is '4 5'"),
        (PLY.format(1), "from 'ply' to 'end_header'"),
        ("plyx\n", "line 1 is 'plyx'"),
        (PLY.format(3) + "end_header\n1 2 3\n4 5 six\n7 8 9\n", "line 9 is '4 5 six', expected 3 numbers"),
        (PLY.format(2) + "end_header\n1.0 2 3\n4 5\n", "line 9 is '4 5'"),
        (PLY.format(3) + "end_header\n1 2 3\n4 5 6\n            ", "ends after 2 vertices"),
        (PLY.format(10**18) + "end_header\n1 2 3\n", "1000000000000000000"),
        (PLY.format("many") + "end_header\n", "expected"),
        (PLY.replace("ascii", "middle_endian").format(1) + "end_header\n1 2 3\n", "expected"),
    ],
)
def test_a_broken_ply_is_refused(text: str, message: str, tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    path.write_text(text)
    with pytest.raises(ScanError, match=message):
        read_all(path)


LIST_HEAD = """ply
format {} 1.0
element edge 1
property int a
property uchar b
element face 99
property list short int n
property uchar flags
element vertex 100
{}property double x
property float intensity
property double y
{}property double z
property list uchar short last
end_header
"""


def write_lists(path: Path, xyz: np.ndarray, order: str) -> None:
    """Write faces of 0 to 5 corners, then vertices with lists, in binary also around their coordinates.

    order: "<" or ">", or "=" for text. plyfile writes no numbers of big-endian beside lists.
    """
    rng = np.random.default_rng(7)
    body = bytearray()

    def put(*values: tuple[str, object]) -> None:
        arrays = [np.atleast_1d(np.array(value, order + kind)) for kind, value in values]
        text = " ".join(repr(value) for array in arrays for value in array.tolist()) + "\n"
        body.extend(text.encode() if order == "=" else b"".join(array.tobytes() for array in arrays))

    put(("i4", 1), ("u1", 2))
    for corners in [*rng.integers(0, 6, 40), *[3] * 40, *rng.integers(0, 6, 19)]:
        put(("i2", corners), ("i4", rng.integers(0, 9, corners)), ("u1", 7))
    for number, (x, y, z) in enumerate(xyz.tolist()):
        first, near, last = rng.integers(0, 4, 3) if number > 30 else (2, 1, 3)
        inner = order != "="
        put(
            *[("u1", first), ("i2", rng.integers(0, 9, first))] * inner, ("f8", x), ("f4", number), ("f8", y),
            *[("u1", near), ("i2", rng.integers(0, 9, near))] * inner, ("f8", z), ("u1", last),
            ("i2", rng.integers(0, 9, last)),
        )  # fmt: skip
    kind = {"=": "ascii", "<": "binary_little_endian", ">": "binary_big_endian"}[order]
    lists = ["" if order == "=" else f"property list uchar short {name}\n" for name in ("first", "near")]
    path.write_bytes(LIST_HEAD.format(kind, *lists).encode() + body)


@pytest.mark.parametrize("byte_order", ["=", "<", ">"])
def test_lists_in_and_before_the_vertices_are_skipped(byte_order: str, tmp_path: Path) -> None:
    """Issue 35: CloudCompare's and other programs' lists of neighbours, and faces first, were refused."""
    path, xyz = tmp_path / "a.ply", np.random.default_rng(1).normal(size=(100, 3))
    write_lists(path, xyz, byte_order)
    for block_points in (1 << 18, 7):
        assert np.array_equal(read_all(path, block_points=block_points), xyz)
    (scan,) = open_scans(path)
    assert scan.declared_count == 100
    assert np.concatenate([block.intensity for block in scan.blocks()]).tolist() == list(range(100))
    whole = path.read_bytes()
    for kept in (0.3, 0.7, 0.95):
        path.write_bytes(whole[: int(len(whole) * kept)])
        with pytest.raises(ScanError, match="expected"):
            read_all(path)


def test_a_list_of_no_length_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    face = "element face 1\nproperty list {} int n\n"
    head = PLY.replace("ascii", "binary_little_endian").replace("element", face + "element", 1)
    for kind, length in (("char", b"\xff"), ("uint", b"\xff\xff\xff\xff")):
        path.write_bytes((head.format(kind, 1) + "end_header\n").encode() + length + bytes(100))
        with pytest.raises(ScanError, match=r"a list of (-1|4294967295) values in element 'face'"):
            read_all(path)
    path.write_bytes((head.format("float", 1) + "end_header\n").encode() + bytes(100))
    with pytest.raises(ScanError, match="list 'n' with lengths of type float32"):
        read_all(path)


def test_letters_of_ply_names_stop_nothing(tmp_path: Path) -> None:
    """Issue 35: names of properties and elements too, and blank lines."""
    path = tmp_path / "a.ply"
    head = (
        PLY.format(1) + "property float gr\xf6\xdfe\x1b\n\nelement s\xfcd 0\nproperty int \xe4\nend_header\n"
    )
    path.write_bytes((head + "1 2 3 4\n").encode("latin-1"))
    assert read_all(path).tolist() == [[1, 2, 3]]
    path.write_bytes(head.replace("double x", "double u").encode("latin-1") + b"1 2 3 4\n")
    with pytest.raises(ScanError, match="vertices without x"):
        read_all(path)
    path.write_bytes(head.replace("element vertex", "element vert\x1bx").encode("latin-1"))
    with pytest.raises(ScanError, match=r"elements: vert\\x1bx, s\\xfcd, expected"):
        read_all(path)


def test_a_ply_may_have_blanks_and_crlf_at_its_line_ends_and_no_vertices(tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    path.write_bytes((PLY.format(2) + "end_header\n1 2 3\n4 5 6").replace("\n", " \r\n").encode())
    assert read_all(path).tolist() == [[1, 2, 3], [4, 5, 6]]
    path.write_text(PLY.format(0) + "end_header\n")
    assert read_all(path).shape == (0, 3)


def test_lines_before_the_vertices_may_be_of_any_length(tmp_path: Path) -> None:
    """They are not held."""
    path = tmp_path / "a.ply"
    camera = "ply\nformat ascii 1.0\nelement camera 2\nproperty double a\n"
    head = camera + PLY.format(1).split("1.0\n")[1] + "end_header\n"
    with path.open("w") as file:
        file.write(head)
        for _ in range(24):
            file.write(" " * (1 << 20))
        file.write("1\n2\n3 4 5\n")
    tracemalloc.start()
    try:
        assert read_all(path).tolist() == [[3, 4, 5]]
        assert tracemalloc.get_traced_memory()[1] < 8 << 20
    finally:
        tracemalloc.stop()
    path.write_text(head + "1\n")
    with pytest.raises(ScanError):
        read_all(path)
