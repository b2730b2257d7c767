"""Test PLY: the order of elements, unusual line ends, and inconsistent headers."""

import tracemalloc
from pathlib import Path

import numpy as np
import plyfile
import pytest
from solidcloud.builder.sources.scan_files import open_scans
from solidcloud.schemas.errors import ScanError


def read_all(path: Path, spacing: float | None = None, block_points: int = 1 << 18) -> np.ndarray:
    """The points of all scans of a file, (n, 3)."""
    blocks = [block.xyz for scan in open_scans(path, spacing=spacing) for block in scan.blocks(block_points)]
    return np.concatenate([np.empty((0, 3)), *blocks])


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
        (PLY.format(1) + "property list uchar int n\nend_header\n1 2 3 0\n", "list property"),
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


def test_a_binary_ply_with_lists_before_its_vertices_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    face = "element face 1\nproperty list uchar int n\n"
    header = PLY.replace("ascii", "binary_little_endian").replace("element", face + "element", 1)
    path.write_text(header.format(1) + "end_header\n" + "0" * 100)
    with pytest.raises(ScanError, match="element 'face' has a list property"):
        open_scans(path)


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
