"""Test PCD: fields of every type, missing returns, the pose, inconsistent headers, LZF in small pieces."""

import struct
from pathlib import Path

import numpy as np
import pytest
from scan_formats import lzf, write_pcd
from solidcloud.builder.sources.formats.pcd_lzf import LzfStream
from solidcloud.builder.sources.scan_files import open_scans
from solidcloud.schemas.errors import ScanError

KINDS = ["ascii", "binary", "binary_compressed"]


def points(count: int = 500) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(3)
    return rng.uniform(-5, 5, (count, 3)).round(3), rng.integers(0, 256, count).astype(np.float32)


def read(path: Path, block_points: int = 1 << 18) -> tuple[np.ndarray, dict]:
    (scan,) = open_scans(path)
    blocks = [block.xyz for block in scan.blocks(block_points)]
    return np.concatenate([np.empty((0, 3)), *blocks]), scan.dropped


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("real", ["<f4", "<f8"])
def test_points_that_are_no_number_are_left_out_and_counted(kind: str, real: str, tmp_path: Path) -> None:
    xyz, light = points()
    xyz = xyz.astype(real).astype(np.float64)
    xyz[100:110, 1] = np.nan
    path = write_pcd(tmp_path / "a.pcd", xyz, light, kind, real=real)
    found, dropped = read(path, 37)
    assert np.array_equal(found, np.delete(xyz, np.s_[100:110], axis=0))
    assert dropped == {"no return": 10}
    (scan,) = open_scans(path)
    kept = np.concatenate([block.intensity for block in scan.blocks(37)])
    assert np.array_equal(kept, np.delete(light, np.s_[100:110]))


@pytest.mark.parametrize("kind", KINDS)
def test_the_viewpoint_is_the_pose(kind: str, tmp_path: Path) -> None:
    xyz, light = points()
    path = write_pcd(tmp_path / "a.pcd", xyz, light, kind, viewpoint="1 2 3 0 0 0 1")  # half a turn about z
    found, _ = read(path)
    assert np.abs(found - (xyz * [-1, -1, 1] + [1, 2, 3])).max() < 1e-12
    assert open_scans(path)[0].pose[:3, 3].tolist() == [1, 2, 3]


def test_whole_numbers_and_capitals_are_fields_too(tmp_path: Path) -> None:
    path = tmp_path / "a.pcd"
    record = np.zeros(3, [("Z", "<i2"), ("Y", "<u1"), ("X", "<i4")])
    record["X"], record["Y"], record["Z"] = [-70000, 2, 3], [4, 5, 255], [-7, 8, 9]
    head = "FIELDS Z Y X\nSIZE 2 1 4\nTYPE I U I\nWIDTH 3\nHEIGHT 1\nDATA binary\n"
    path.write_bytes(head.encode() + record.tobytes())
    assert read(path)[0].tolist() == [[-70000, 4, -7], [2, 5, 8], [3, 255, 9]]


@pytest.mark.parametrize(
    "head",
    [
        "VERSION .5\nCOLUMNS x y z\nDATA ascii\n",
        "# .PCD v.5\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nPOINTS 2\nDATA ascii\n",
        "FIELDS x y z\nWIDTH 2\nDATA ASCII\n",
        "FIELDS x y z\nHEIGHT 2\nPOINTS 2\nDATA ascii\n",
        "FIELDS x y z\nSIZE 8 8 8\nTYPE F F F\nDATA binary\n",
        "FIELDS x y z\nSIZE 8 8 8\nTYPE F F F\nPOINTS 2\nDATA binary\n",
        "FIELDS x y z\nSIZE 8 8 8\nTYPE F F F\nHEIGHT 2\nWIDTH 1\nDATA binary\n",
    ],
)
def test_what_old_headers_leave_out_has_its_usual_value(head: str, tmp_path: Path) -> None:
    """Issue 35."""
    path = tmp_path / "a.pcd"
    xyz = np.array([[1.5, 2, 3], [4, 5, 6.25]])
    rows = xyz.astype("<f8").tobytes() if "binary" in head else b"1.5 2 3\n4 5 6.25\n"
    path.write_bytes(head.encode() + rows)
    assert np.array_equal(read(path)[0], xyz)
    assert open_scans(path)[0].declared_count in (2, None)
    if "binary" in head:
        path.write_bytes(head.encode().replace(b"SIZE", b"#SIZE") + rows)
        with pytest.raises(ScanError, match="SIZE missing, expected 3 whole numbers"):
            open_scans(path)
    if "POINTS" not in head and "WIDTH" not in head and "binary" in head:
        path.write_bytes(head.encode() + rows[:-1])
        with pytest.raises(ScanError, match="POINTS missing, expected the number of points"):
            open_scans(path)


LIES = {
    "points that are not the grid": (
        "POINTS 500",
        "POINTS 499",
        "POINTS 499, expected WIDTH times HEIGHT, 500",
    ),
    "more points": ("WIDTH 500", "WIDTH 99999999", "expected"),
    "a field without size": ("SIZE 4 8", "SIZE 8", "SIZE 8 8 1 8 4, expected 6 whole numbers"),
    "a size of no type": ("SIZE 4 8 8", "SIZE 4 8 2", "TYPE F F F U F F, expected F of 4 or 8 bytes"),
    "no x": ("FIELDS normal x", "FIELDS normal u", "expected x, y and z once each"),
    "x twice": ("FIELDS normal x", "FIELDS x x", "expected x, y and z once each"),
    "three x": ("COUNT 3 1", "COUNT 3 3", "expected 1 of x, y and z"),
    "records of a gigabyte": ("COUNT 3 1", "COUNT 299999999 1", "expected records of at most"),
    "another kind": ("DATA ", "DATA zipped_", "expected ascii or binary or binary_compressed"),
    "a viewpoint that stretches": ("VIEWPOINT 0 0 0 1", "VIEWPOINT 0 0 0 1.1", "quaternion of length"),
    "a viewpoint of six": ("VIEWPOINT 0 ", "VIEWPOINT ", "expected seven numbers"),
}


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("lie", LIES)
def test_a_pcd_header_that_lies_is_refused(lie: str, kind: str, tmp_path: Path) -> None:
    true, false, message = LIES[lie]
    path = write_pcd(tmp_path / "a.pcd", *points(), kind)
    assert true.encode() in path.read_bytes()
    path.write_bytes(path.read_bytes().replace(true.encode(), false.encode(), 1))
    with pytest.raises(ScanError, match=message):
        open_scans(path)


def test_compressed_sizes_that_lie_are_refused(tmp_path: Path) -> None:
    path = write_pcd(tmp_path / "a.pcd", *points(), "binary_compressed")
    whole = path.read_bytes()
    at = whole.index(b"DATA binary_compressed\n") + 23
    packed, unpacked = struct.unpack_from("<II", whole, at)
    for sizes in ((packed + 1, unpacked), (packed, unpacked + 1), (unpacked // 89, unpacked)):
        path.write_bytes(whole[:at] + struct.pack("<II", *sizes) + whole[at + 8 :])
        with pytest.raises(ScanError, match="truncated or damaged"):
            open_scans(path)


@pytest.mark.parametrize("piece", [400, 1000, 1 << 18])
def test_lzf_is_decoded_in_pieces_and_side_by_side(
    piece: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("solidcloud.builder.sources.formats.pcd_lzf.PIECE_BYTES", piece)
    rng = np.random.default_rng(1)
    # Runs, repeats from far back and noise: references of both lengths, that overlap themselves, and literals.
    parts = [bytes([7]) * 700, rng.bytes(3000), bytes(range(256)) * 30, rng.bytes(5000)]
    data = b"".join(parts) + parts[1] + b"".join(parts)
    path = tmp_path / "a"
    packed = lzf(data)
    path.write_bytes(b"before" + packed + b"behind")
    with path.open("rb") as file:
        stream = LzfStream(path, 6, 6 + len(packed))
        stream.skip(file, 3001)
        other = stream.fork()
        other.skip(file, 9999)
        for begin in range(3001, 12000, 333):
            assert stream.read(file, 333).tobytes() == data[begin : begin + 333]
            assert other.read(file, 333).tobytes() == data[begin + 9999 : begin + 9999 + 333]
        whole = LzfStream(path, 6, 6 + len(packed))
        assert whole.read(file, len(data)).tobytes() == data
        with pytest.raises(ScanError, match="ends too soon"):
            whole.read(file, 1)


@pytest.mark.parametrize("packed", [b"\x20\x00", b"\x01ab\x20\x02", b"\x05abc", b"\xe0\x05", b""])
def test_broken_lzf_is_refused(packed: bytes, tmp_path: Path) -> None:
    path = tmp_path / "a"
    path.write_bytes(packed)
    with path.open("rb") as file, pytest.raises(ScanError, match="ends too soon, or refers"):
        LzfStream(path, 0, len(packed)).read(file, 50)
