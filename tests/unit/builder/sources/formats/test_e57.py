"""Test E57: poses, invalid records, spherical coordinates, and bounds of sound and damaged files."""

import struct
from pathlib import Path

import numpy as np
import pytest
from broken_scans import with_checksums
from scan_cases import read_all
from scan_formats import cartesian, write_e57
from solidcloud.builder.sources.scan_files import header_bounds, inspect_scans, open_scans
from solidcloud.schemas.errors import ScanError

TURN = np.array([0.5, 0.5, -0.5, 0.5])  # w, x, y, z: a third of a turn about a diagonal, exact in float64
TURNED = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])


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
        ({"rotation": np.array([1e-9, 0, 0, 0])}, "quaternion of length 1e-09"),
    ],
)
def test_an_e57_pose_that_is_not_rigid_is_refused(pose: dict, message: str, tmp_path: Path) -> None:
    path = tmp_path / "bent.e57"
    write_e57(path, [{"columns": cartesian(np.ones((3, 3))), **pose}])
    with pytest.raises(ScanError, match=message):
        open_scans(path)


@pytest.mark.parametrize("name", ["Süd — ✓", "S\udcfcd", "a\x01b", "a\udced\udca0\udc80b", "<\uffff"])
def test_letters_of_e57_names_stop_nothing(name: str, local: np.ndarray, tmp_path: Path) -> None:
    """Issue 35: names in another encoding than UTF-8, and letters that XML does not allow."""
    path, letters = tmp_path / "named.e57", name.encode("utf-8", "surrogateescape").replace(b"<", b"&lt;")
    write_e57(path, [{"columns": cartesian(local)}], crs="N" * len(letters))
    path.write_bytes(with_checksums(path.read_bytes().replace(b"N" * len(letters), letters)))
    assert np.array_equal(read_all(path), local)
    assert "S?d" in open_scans(path)[0].crs or name != "S\udcfcd"
    # A damaged page is not repaired.
    path.write_bytes(path.read_bytes().replace(letters, letters[:-1] + b"!"))
    with pytest.raises(ScanError, match="checksum"):
        read_all(path)


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


def test_a_byte_changed_in_any_page_is_found_by_its_checksum(tmp_path: Path) -> None:
    """Every page ends in a checksum; headers, XML, index and points lie in pages alike."""
    rng = np.random.default_rng(4)
    scans = [{"columns": cartesian(rng.uniform(-5, 5, (count, 3)))} for count in (100, 60)]
    path = write_e57(tmp_path / "a.e57", scans)
    whole = path.read_bytes()
    pages = len(whole) // 1024
    assert pages > 5 and len(read_all(path)) == 160
    for page in range(pages):
        data = bytearray(whole)
        data[1024 * page + int(rng.integers(48, 1024))] ^= 1 << int(rng.integers(8))
        path.write_bytes(data)
        with pytest.raises(ScanError, match="checksum"):
            read_all(path)


def test_a_scan_whose_pose_is_none_does_not_keep_others_from_being_read(tmp_path: Path) -> None:
    good, bad = np.arange(30.0).reshape(10, 3), {"rotation": np.array([1.0, 1, 0, 0])}
    scans = [
        {"columns": cartesian(good)},
        {"columns": cartesian(good), **bad},
        {"columns": cartesian(good + 1)},
    ]
    path = write_e57(tmp_path / "a.e57", scans)
    first, broken, last = open_scans(path)
    assert np.array_equal(
        np.concatenate([b.xyz for s in (first, last) for b in s.blocks()]), [*good, *(good + 1)]
    )
    assert broken.index == 1 and "scan 1 with a rotation quaternion of length 1.41" in broken.fault
    with pytest.raises(ScanError, match="quaternion of length"):
        list(broken.blocks())
    assert [entry.fault for entry in inspect_scans([path])] == ["", broken.fault, ""]
    write_e57(path, [{"columns": cartesian(good), **bad}] * 2)
    with pytest.raises(ScanError, match="scan 0 with a rotation quaternion"):
        open_scans(path)


NAMESPACE = "http://www.astm.org/COMMIT/E57/2010-e57-v1.0"


def write_xml(path: Path, inner: str, before: str = "") -> None:
    """An E57 file of XML alone, `inner` where its scans are, `before` in front of the root; checksums that fit."""
    xml = (
        f'<?xml version="1.0" encoding="UTF-8"?>{before}<e57Root type="Structure" xmlns="{NAMESPACE}">'
        '<formatName type="String">ASTM E57 3D Imaging Data File</formatName><guid type="String">{1}</guid>'
        '<versionMajor type="Integer">1</versionMajor><versionMinor type="Integer">0</versionMinor>'
        f'<data3D type="Vector" allowHeterogeneousChildren="1">{inner}</data3D></e57Root>'
    ).encode()
    logical = bytes(48) + xml
    pages = [logical[k : k + 1020].ljust(1020, b"\0") + bytes(4) for k in range(0, len(logical), 1020)]
    raw = bytearray(b"".join(pages))
    struct.pack_into("<8sIIQQQQ", raw, 0, b"ASTM-E57", 1, 0, len(raw), 48, len(xml), 1024)
    path.write_bytes(with_checksums(bytes(raw)))


def nested(depth: int) -> str:
    return (
        "<vectorChild type='Structure'>" + '<a type="Structure">' * depth + "</a>" * depth + "</vectorChild>"
    )


XML_LIES = {
    "deep": (nested(1000), "", "nested over 64 deep"),
    "deep, and then broken": (nested(1000) + "<", "", "nested over 64 deep"),
    "many": ("<vectorChild type='Structure'/>" * (1 << 18), "", "over 262144 elements"),
    "an entity": ("<a>&x;</a>", f'<!DOCTYPE e57Root [<!ENTITY x "{"y" * 9}">]>', "with a document type"),
    "another file": (
        "<a>&x;</a>",
        '<!DOCTYPE e57Root [<!ENTITY x SYSTEM "/etc/hostname">]>',
        "with a document type",
    ),
}


@pytest.mark.parametrize("lie", XML_LIES)
def test_xml_that_no_scan_needs_is_refused_before_the_library_sees_it(lie: str, tmp_path: Path) -> None:
    inner, before, message = XML_LIES[lie]
    path = tmp_path / "a.e57"
    write_xml(path, "")
    assert open_scans(path) == []
    write_xml(path, inner, before)
    with pytest.raises(ScanError, match=message):
        open_scans(path)
    assert header_bounds(path) is None


@pytest.mark.parametrize(
    ("at", "value", "message"),
    [
        (16, 4096, "4096 bytes declared"),
        (24, 1 << 40, "from byte 1099511627776 on"),
        (32, 1 << 40, "1099511627776 of XML"),
        (40, 512, "pages of 512 bytes"),
    ],
)
def test_an_e57_header_that_lies_is_refused(at: int, value: int, message: str, tmp_path: Path) -> None:
    path = tmp_path / "a.e57"
    write_xml(path, "")
    data = bytearray(path.read_bytes())
    struct.pack_into("<Q", data, at, value)
    path.write_bytes(with_checksums(bytes(data)))
    with pytest.raises(ScanError, match=message):
        open_scans(path)


def test_more_records_than_bits_are_refused(tmp_path: Path) -> None:
    """A record of constants takes none: such a file may claim any number of them, and deliver it."""
    path = tmp_path / "a.e57"
    axes = "".join(
        f'<cartesian{axis} type="Integer" minimum="5" maximum="5">5</cartesian{axis}>' for axis in "XYZ"
    )
    points = (
        '<vectorChild type="Structure"><points type="CompressedVector" fileOffset="48" recordCount="{}">'
        f'<prototype type="Structure">{axes}</prototype><codecs type="Vector" allowHeterogeneousChildren="1"/>'
        "</points></vectorChild>"
    )
    write_xml(path, points.format(100))
    assert open_scans(path)[0].declared_count == 100
    write_xml(path, points.format(10**13))
    with pytest.raises(ScanError, match=f"scan 0 of {10**13} records, expected at most the"):
        open_scans(path)
