"""What is particular to one format: headers that lie, poses, invalid points, column rules, surfaces."""

import struct
from pathlib import Path

import laspy
import numpy as np
import plyfile
import pytest
from pye57 import libe57
from solidcloud.builder.sources import Lattice, header_bounds, open_scans
from solidcloud.builder.sources.rows import LONGEST_LINE
from solidcloud.schemas.errors import ScanError


def read_all(path: Path, spacing: float | None = None, block_points: int = 1 << 18) -> np.ndarray:
    """The points of all scans of a file, (n, 3)."""
    blocks = [block.xyz for scan in open_scans(path, spacing=spacing) for block in scan.blocks(block_points)]
    return np.concatenate([np.empty((0, 3)), *blocks])


def intensities(path: Path) -> list[float] | None:
    """The intensities of a file with one scan, None where it has none."""
    found = [block.intensity for scan in open_scans(path) for block in scan.blocks()]
    return None if found[0] is None else np.concatenate(found).tolist()


# --- LAS and LAZ -----------------------------------------------------------------------------------------


@pytest.fixture(params=["1.2", "1.4"])
def las(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    """200 points in map coordinates, with extra bytes in each record."""
    header = laspy.LasHeader(version=request.param, point_format=3 if request.param == "1.2" else 6)
    header.scales, header.offsets = [0.01, 0.02, 0.005], [2322968.4731, 4770131.8677, 290.1455]
    header.add_extra_dim(laspy.ExtraBytesParams("extra", np.float64))
    las = laspy.LasData(header)
    rng = np.random.default_rng(1)
    las.X, las.Y, las.Z = rng.integers(-(2**31), 2**31, (3, 200))
    las.intensity = rng.integers(0, 65536, 200)
    path = tmp_path / "a.las"
    las.write(path)
    return path


def test_las_coordinates_are_raw_times_scale_plus_offset_to_the_bit(las: Path) -> None:
    judge = laspy.read(las)
    assert np.array_equal(read_all(las), np.column_stack([judge.x, judge.y, judge.z]))


def test_las_gives_its_lattice_and_bounds(las: Path) -> None:
    (scan,) = open_scans(las)
    assert scan.lattice == Lattice((0.01, 0.02, 0.005), (2322968.4731, 4770131.8677, 290.1455))
    xyz = read_all(las)
    assert np.allclose(scan.bounds, [xyz.min(axis=0), xyz.max(axis=0)], rtol=0, atol=1e-6)
    assert np.array_equal(header_bounds(las), scan.bounds)
    assert np.array_equal(scan.pose, np.eye(4))


def test_laz_gives_what_las_gives(las: Path) -> None:
    laz = las.with_suffix(".laz")
    laspy.read(las).write(laz, laz_backend=laspy.LazBackend.Lazrs)
    assert np.array_equal(read_all(laz), read_all(las))
    assert open_scans(laz)[0].format == "laz"
    assert open_scans(laz)[0].lattice == open_scans(las)[0].lattice


LAS_LIES = {
    "signature": (0, "<4s", b"LASX", "b'LASF'"),
    "version": (24, "<B", 2, "LAS version 2"),
    "header size": (94, "<H", 100, "header of 100 bytes"),
    "points before the header's end": (96, "<I", 200, "points that begin at byte 200"),
    "points behind the file": (96, "<I", 1 << 30, "points that begin at byte 1073741824"),
    "record format": (104, "<B", 17, "point record format 17"),
    "record length": (105, "<H", 12, "records of 12 bytes"),
    "scale of zero": (131, "<d", 0.0, "scale"),
    "scale without value": (139, "<d", float("nan"), "scale"),
    "infinite offset": (155, "<d", float("inf"), "offset"),
    "many records": (100, "<I", 1_069_128_089, "1069128089 variable length records"),
}


@pytest.mark.parametrize("lie", LAS_LIES)
def test_a_las_header_that_lies_is_refused(lie: str, las: Path) -> None:
    at, code, value, message = LAS_LIES[lie]
    data = bytearray(las.read_bytes())
    struct.pack_into(code, data, at, value)
    las.write_bytes(data)
    with pytest.raises(ScanError, match=message):
        open_scans(las)


def test_a_las_header_that_claims_more_points_than_the_file_holds_is_refused(las: Path) -> None:
    data = bytearray(las.read_bytes())
    new = data[25] == 4
    struct.pack_into("<Q" if new else "<I", data, 247 if new else 107, 201)
    las.write_bytes(data)
    with pytest.raises(ScanError, match="201 points declared, expected at most the 200"):
        open_scans(las)


def test_a_laz_chunk_table_beyond_the_file_is_refused(las: Path) -> None:
    laz = las.with_suffix(".laz")
    laspy.read(las).write(laz, laz_backend=laspy.LazBackend.Lazrs)
    data = bytearray(laz.read_bytes())
    (points,) = struct.unpack_from("<I", data, 96)
    struct.pack_into("<q", data, points, len(data) + 5)
    laz.write_bytes(data)
    with pytest.raises(ScanError, match="chunk table at byte"):
        open_scans(laz)


def write_laz(path: Path, count: int, point_format: int) -> np.ndarray:
    """Points whose raw coordinates are returned, (n, 3); 50,000 of them a chunk."""
    header = laspy.LasHeader(version="1.4", point_format=point_format)
    header.scales, header.offsets = [1.0] * 3, [0.0] * 3
    las = laspy.LasData(header)
    xyz = np.random.default_rng(6).integers(-1000, 1000, (count, 3))
    las.X, las.Y, las.Z = xyz.T
    las.write(path, laz_backend=laspy.LazBackend.Lazrs)
    return xyz


@pytest.mark.parametrize("point_format", [0, 3, 6, 7, 8, 9])
@pytest.mark.parametrize("count", [1, 50_000, 50_001])
def test_laz_of_every_kind_and_number_of_chunks_is_read(
    point_format: int, count: int, tmp_path: Path
) -> None:
    path = tmp_path / "a.laz"
    xyz = write_laz(path, count, point_format)
    assert np.array_equal(read_all(path), xyz)


def test_a_laz_chunk_that_claims_gigabytes_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.laz"
    write_laz(path, 100, 6)
    data = bytearray(path.read_bytes())
    (start,) = struct.unpack_from("<I", data, 96)
    # Behind the table's place, the first point raw and the count: the size of the first layer.
    struct.pack_into("<I", data, start + 8 + 30 + 4, 0xFFFF_0000)
    path.write_bytes(data)
    with pytest.raises(ScanError, match="chunk 0 that ends at byte"):
        open_scans(path)


def test_a_laz_without_the_record_that_describes_it_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.laz"
    write_laz(path, 100, 6)
    path.write_bytes(path.read_bytes().replace(b"laszip encoded", b"laszip forgets", 1))
    with pytest.raises(ScanError, match="22204"):
        open_scans(path)


def test_a_las_without_points_is_valid_and_has_none(tmp_path: Path) -> None:
    path = tmp_path / "none.las"
    laspy.LasData(laspy.LasHeader()).write(path)
    assert open_scans(path)[0].declared_count == 0
    assert open_scans(path)[0].bounds is None
    assert read_all(path).shape == (0, 3)


def test_bounds_of_a_truncated_las_are_those_of_its_header(las: Path) -> None:
    whole = open_scans(las)[0].bounds
    las.write_bytes(las.read_bytes()[:1000])
    with pytest.raises(ScanError):
        open_scans(las)
    assert np.array_equal(header_bounds(las), whole)


# --- E57 -------------------------------------------------------------------------------------------------

TURN = np.array([0.5, 0.5, -0.5, 0.5])  # w, x, y, z: a third of a turn about a diagonal, exact in float64
TURNED = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])


def write_e57(path: Path, scans: list[dict]) -> None:
    """Scans with the keys columns (name -> array), and perhaps rotation, translation and bounds (2, 3).

    By libE57Format itself: pye57 cannot write spherical coordinates, and writes bounds against the standard.
    """
    image = libe57.ImageFile(str(path), "w")
    image.extensionsAdd("", libe57.E57_V1_0_URI)
    root = image.root()
    root.set("formatName", libe57.StringNode(image, "ASTM E57 3D Imaging Data File"))
    root.set("guid", libe57.StringNode(image, "{1}"))
    root.set("versionMajor", libe57.IntegerNode(image, 1))
    root.set("versionMinor", libe57.IntegerNode(image, 0))
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
        if "bounds" in scan:
            names = [f"{axis}{end}" for end in ("Minimum", "Maximum") for axis in "xyz"]
            node.set("cartesianBounds", numbers(names, np.ravel(scan["bounds"])))
        prototype, buffers = libe57.StructureNode(image), libe57.VectorSourceDestBuffer()
        for name, column in scan["columns"].items():
            whole = column.dtype == np.int8
            prototype.set(name, libe57.IntegerNode(image, 0, 0, 2) if whole else libe57.FloatNode(image, 0.0))
            buffers.append(libe57.SourceDestBuffer(image, name, column, len(column), True, True))
        points = libe57.CompressedVectorNode(image, prototype, libe57.VectorNode(image, True))
        node.set("points", points)
        data3d.append(node)
        writer = points.writer(buffers)
        writer.write(len(column))
        writer.close()
    image.close()


def cartesian(xyz: np.ndarray) -> dict[str, np.ndarray]:
    return {
        f"cartesian{axis}": np.ascontiguousarray(column) for axis, column in zip("XYZ", xyz.T, strict=True)
    }


@pytest.fixture
def local() -> np.ndarray:
    return np.random.default_rng(2).uniform(-20, 20, (500, 3))


def test_e57_scans_are_placed_and_their_invalid_points_counted(local: np.ndarray, tmp_path: Path) -> None:
    path = tmp_path / "two.e57"
    state = np.random.default_rng(3).integers(0, 3, 500).astype(np.int8)
    light = np.random.default_rng(4).uniform(0, 1, 500)
    far = np.array([5e5, 5.6e6, 120.0])
    columns = {**cartesian(local), "cartesianInvalidState": state, "intensity": light}
    write_e57(
        path,
        [
            {"columns": columns, "rotation": TURN, "translation": far},
            {"columns": cartesian(local), "translation": -far},
        ],
    )
    first, second = open_scans(path)
    assert (first.index, second.index) == (0, 1)
    assert first.declared_count == second.declared_count == 500
    assert np.array_equal(first.pose[:3, :3], TURNED) and np.array_equal(first.pose[:3, 3], far)
    for block_points in (7, 1000):
        blocks = list(first.blocks(block_points))
        valid = state == 0
        assert np.array_equal(np.concatenate([block.xyz for block in blocks]), local[valid] @ TURNED.T + far)
        assert np.array_equal(
            np.concatenate([block.intensity for block in blocks]), light[valid].astype(np.float32)
        )
        assert first.dropped == {"invalid state": 500 - np.count_nonzero(valid)}
        blocks = list(second.blocks(block_points))
        assert np.array_equal(np.concatenate([block.xyz for block in blocks]), local - far)
        assert all(block.intensity is None for block in blocks) and second.dropped == {}


def test_e57_pose_is_applied_alike_in_blocks_of_any_size(local: np.ndarray, tmp_path: Path) -> None:
    path = tmp_path / "turned.e57"
    turn = np.array([0.9, -0.1, 0.3, 0.2])
    write_e57(path, [{"columns": cartesian(local), "rotation": turn / np.linalg.norm(turn)}])
    small, large = read_all(path, block_points=7), read_all(path)
    assert np.array_equal(small.view(np.uint64), large.view(np.uint64))
    assert np.allclose(np.linalg.norm(large, axis=1), np.linalg.norm(local, axis=1), rtol=1e-15)


def test_e57_spherical_coordinates_become_cartesian(local: np.ndarray, tmp_path: Path) -> None:
    path = tmp_path / "spherical.e57"
    distance = np.linalg.norm(local, axis=1)
    columns = {
        "sphericalRange": distance,
        "sphericalAzimuth": np.arctan2(local[:, 1], local[:, 0]),
        "sphericalElevation": np.arcsin(local[:, 2] / distance),
        "sphericalInvalidState": (np.arange(500) % 5 == 0).astype(np.int8),
    }
    write_e57(path, [{"columns": columns, "translation": np.array([1.0, 2.0, 3.0])}])
    kept = np.arange(500) % 5 != 0
    assert np.abs(read_all(path) - (local[kept] + [1.0, 2.0, 3.0])).max() < 1e-12
    assert np.array_equal(read_all(path, block_points=7), read_all(path))


@pytest.mark.parametrize(
    ("pose", "message"),
    [
        ({"rotation": np.array([1.01, 0, 0, 0])}, "quaternion of length 1.01"),
        ({"rotation": np.zeros(4)}, "quaternion of length 0"),
    ],
)
def test_an_e57_pose_that_is_not_rigid_is_refused(pose: dict, message: str, tmp_path: Path) -> None:
    path = tmp_path / "bent.e57"
    write_e57(path, [{"columns": cartesian(np.ones((3, 3))), **pose}])
    with pytest.raises(ScanError, match=message):
        open_scans(path)


def test_e57_bounds_hold_the_scan_wherever_its_pose_puts_it(local: np.ndarray, tmp_path: Path) -> None:
    path = tmp_path / "bounds.e57"
    box = np.stack([local.min(axis=0), local.max(axis=0)])
    moved = {
        "columns": cartesian(local),
        "bounds": box,
        "rotation": TURN,
        "translation": np.array([9.0, 8, 7]),
    }
    write_e57(path, [{"columns": cartesian(local), "bounds": box}, moved])
    first, second = open_scans(path)
    assert np.array_equal(first.bounds, box)
    xyz = np.concatenate([block.xyz for block in second.blocks()])
    assert (second.bounds[0] <= xyz.min(axis=0)).all() and (second.bounds[1] >= xyz.max(axis=0)).all()
    both = [np.minimum(first.bounds[0], second.bounds[0]), np.maximum(first.bounds[1], second.bounds[1])]
    assert np.array_equal(header_bounds(path), both)


def test_bounds_of_a_broken_e57_are_those_of_its_header(local: np.ndarray, tmp_path: Path) -> None:
    path = tmp_path / "broken.e57"
    write_e57(path, [{"columns": cartesian(local), "bounds": [[-1, -2, -3], [4, 5, 6]]}])
    data = bytearray(path.read_bytes())
    data[2500] ^= 0x10  # in the points
    path.write_bytes(data)
    with pytest.raises(ScanError, match="ErrorBadChecksum"):
        read_all(path)
    assert np.array_equal(header_bounds(path), [[-1, -2, -3], [4, 5, 6]])


def test_bounds_of_an_e57_are_unknown_where_one_scan_states_none(local: np.ndarray, tmp_path: Path) -> None:
    path = tmp_path / "one.e57"
    columns = cartesian(local)
    write_e57(path, [{"columns": columns, "bounds": [[-1, -2, -3], [4, 5, 6]]}, {"columns": columns}])
    assert header_bounds(path) is None


# --- PLY -------------------------------------------------------------------------------------------------

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


# --- text ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "text", "expected", "intensity"),
    [
        ("a.pts", "2\n1 2 3 -4\n5 6 7 -8\n", [[1, 2, 3], [5, 6, 7]], [-4, -8]),
        ("a.pts", "1\n1 2 3 4 255 0 0\n", [[1, 2, 3]], [4]),
        ("a.pts", "1\n1 2 3 255 0 0\n", [[1, 2, 3]], None),  # the fourth of six is red
        ("a.pts", "1 2 3\n", [[1, 2, 3]], None),
        ("a.xyz", "1 2 3 4\n", [[1, 2, 3]], None),  # a fourth column may mean anything
        ("a.xyz", "1 2 3", [[1, 2, 3]], None),
        ("a.csv", "intensity;Z;Y;X\n9;3;2;1\n", [[1, 2, 3]], [9]),
        ("a.csv", "\ufeffx, y, z\n1, 2, 3\n\n4, 5, 6\n", [[1, 2, 3], [4, 5, 6]], None),
        ("a.txt", "//X Y Z Scalar_Intensity\n1 2 3 4\n", [[1, 2, 3]], [4]),
        (
            "a.txt",
            "# by hand\n\n# y x z\n2 1 3\n#\n5 4 6 # end\n",
            [[1, 2, 3], [4, 5, 6]],
            None,
        ),
        ("a.txt", "# of x, y and z\n1 2 3\n", [[1, 2, 3]], None),  # a sentence, no header
        ("a.txt", "nan 1e999 -3\n", [[np.nan, np.inf, -3]], None),  # counted by the caller
        ("a.txt", "# nothing\n\n", [], None),
        ("a.pts", "0\n", [], None),
    ],
)
def test_text_layouts(
    name: str, text: str, expected: list, intensity: list[float] | None, tmp_path: Path
) -> None:
    path = tmp_path / name
    path.write_text(text, encoding="utf-8")
    assert np.array_equal(read_all(path), np.reshape(expected, (-1, 3)), equal_nan=True)
    if expected:
        assert intensities(path) == intensity


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("1 2 3\n4 5 6\n7 8\n", "line 3 is '7 8', expected 3 numbers"),
        ("1 2 3\n\n# c\n4 5 6 7\n", "line 4 is '4 5 6 7'"),
        ("1 2 3\n4 5 x6\n", "line 2 is '4 5 x6'"),
        ("1,2,3\n4,,6\n", "line 2 is '4,,6'"),
        ("1,2,3\n4 5 6\n", "line 2"),
        ("1;2;3\n4,5;6;7\n", "line 2 is '4,5;6;7'"),  # a decimal comma
        ("1 2\n3 4\n", "line 1 is '1 2', expected at least three numbers"),
        ("1 2 z\n", "line 1"),
        ("x y z\nx y z\n1 2 3\n", "line 2 is 'x y z'"),
        ("x y\n1 2 3\n", "line 1 names the columns 'x y'"),
        ("x y x\n1 2 3\n", "x, y and z once each"),
        ("x y z\n", "no rows of numbers"),
        ("3\n1 2 3\n4 5 6\n", "2 points, expected the 3"),
        ("1\n1 2 3\n4 5 6\n", "2 points, expected the 1"),
        ("5\n", "no rows of numbers"),
        ("a chapter\n" * 3, "line 2"),
        ("1 2 3\n4 5\0 6\n", "line 2 holds a zero byte"),
        ("1 2 3\n" + "1" * (6 * LONGEST_LINE), "line 2 is longer than"),
    ],
)
def test_broken_text_is_refused_with_its_line(text: str, message: str, tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    path.write_text(text)
    with pytest.raises(ScanError, match=message):
        read_all(path)


def test_text_is_read_right_across_chunks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.xyz"
    xyz = np.random.default_rng(5).normal(size=(300, 3)).round(6)
    lines = [f"{x} {y} {z}" for x, y, z in xyz.tolist()]
    path.write_text("\n".join(lines))
    monkeypatch.setattr("solidcloud.builder.sources.rows.CHUNK_BYTES", 100)
    assert np.array_equal(read_all(path), xyz)
    lines[222] = "1 2"
    path.write_text("\n".join(lines))
    with pytest.raises(ScanError, match="line 223 is '1 2'"):
        read_all(path)


# --- OBJ and STL -----------------------------------------------------------------------------------------


def write_square(path: Path, side: float) -> None:
    """A square in the plane z = 1, cut into two triangles; another file is named that must not be opened."""
    corners = [(0, 0), (side, 0), (side, side), (0, side)]
    vertices = "".join(f"v {x} {y} 1 0.5 0.5 0.5\n" for x, y in corners)
    path.write_text(f"mtllib ../secret.mtl\n{vertices}v 99 99 99\nf 1 2 3\nf 1 3 4\n")


def test_obj_vertices_come_as_they_stand_in_the_file(tmp_path: Path) -> None:
    path = tmp_path / "a.obj"
    path.write_text("v 1 2 3\nv 1 2 3 1.0\n  v\t4 5 6 255 0 0\r\nvt 7 7\nvn 8 8 8\no v 9 9 9\nf 1 2 3\n")
    assert read_all(path).tolist() == [[1, 2, 3], [1, 2, 3], [4, 5, 6]]


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


def test_samples_fall_on_triangles_by_their_area(tmp_path: Path) -> None:
    path = tmp_path / "a.obj"
    path.write_text(
        "v 0 0 0\nv 3 0 0\nv 0 3 0\nv 0 0 9\nv 1 0 9\nv 0 1 9\nv 5 5 5\nf 1 2 3\nf 4 5 6\nf 7 7 7\n"
    )
    xyz = read_all(path, spacing=0.05)
    assert len(xyz) == 2000
    assert np.count_nonzero(xyz[:, 2] == 9) == pytest.approx(200, abs=1)
    assert not (xyz == 5).any()


def test_spacing_samples_a_ply_with_faces_and_leaves_scans_alone(tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    faces = "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
    path.write_text(PLY.format(3) + faces + "0 0 0\n2 0 0\n0 2 0\n3 0 1 2\n")
    assert len(read_all(path)) == 3
    assert len(read_all(path, spacing=0.1)) == 200
    scan = tmp_path / "a.xyz"
    scan.write_text("1 2 3\n")
    assert read_all(scan, spacing=0.1).tolist() == [[1, 2, 3]]


def test_a_mesh_without_faces_cannot_be_sampled(tmp_path: Path) -> None:
    path = tmp_path / "a.obj"
    path.write_text("v 1 2 3\nv 4 5 6\nv 7 8 8\n")
    with pytest.raises(ScanError, match="build it without --spacing"):
        read_all(path, spacing=0.1)


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
