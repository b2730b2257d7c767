"""Test LAS and LAZ: exact coordinates, inconsistent headers, and chunks of every kind."""

import struct
from pathlib import Path

import laspy
import numpy as np
import pytest
from broken_scans import SEEDS
from solidcloud.builder.sources.common.scan import SourceLattice
from solidcloud.builder.sources.scan_files import header_bounds, open_scans
from solidcloud.schemas.errors import ScanError


def read_all(path: Path, spacing: float | None = None, block_points: int = 1 << 18) -> np.ndarray:
    """The points of all scans of a file, (n, 3)."""
    blocks = [block.xyz for scan in open_scans(path, spacing=spacing) for block in scan.blocks(block_points)]
    return np.concatenate([np.empty((0, 3)), *blocks])


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
    assert scan.lattice == SourceLattice((0.01, 0.02, 0.005), (2322968.4731, 4770131.8677, 290.1455))
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


@pytest.mark.parametrize("point_format", [3, 6])
def test_a_range_of_a_laz_is_found_by_its_chunks(point_format: int, tmp_path: Path) -> None:
    path = tmp_path / "a.laz"
    xyz = write_laz(path, 120_001, point_format)
    (scan,) = open_scans(path)
    for start, stop in ((0, 10), (49_999, 50_001), (50_000, 100_000), (77_777, 120_001), (120_000, None)):
        found = np.concatenate([block.xyz for block in scan.blocks(20_011, start, stop)])
        assert np.array_equal(found, xyz[start:stop])


def test_a_range_of_chunks_that_differ_in_size_is_found(tmp_path: Path) -> None:
    """As COPC has them; lazrs's own seek delivers other points there (0.8.2)."""
    xyz = np.random.default_rng(3).uniform(-5, 5, (60, 3)).round(3)
    SEEDS["variable.laz"](tmp_path / "a.laz", xyz)
    (scan,) = open_scans(tmp_path / "a.laz")
    whole = read_all(tmp_path / "a.laz")
    assert np.abs(whole - xyz - [1000, 2000, 3]).max() < 1e-9
    for start in range(60):
        for stop in (start + 1, min(start + 9, 60), 60):
            found = np.concatenate([block.xyz for block in scan.blocks(5, start, stop)])
            assert np.array_equal(found, whole[start:stop])


def test_layers_that_are_not_read_change_nothing(tmp_path: Path) -> None:
    """Of a layered chunk only coordinates and intensities are decompressed."""
    path = tmp_path / "a.laz"
    header = laspy.LasHeader(version="1.4", point_format=7)
    header.scales, header.offsets = [0.001] * 3, [0.0] * 3
    las = laspy.LasData(header)
    rng = np.random.default_rng(8)
    las.X, las.Y, las.Z = rng.integers(-(2**31), 2**31, (3, 1000))
    las.intensity, las.red = rng.integers(0, 65536, (2, 1000))
    las.return_number, las.number_of_returns = rng.integers(1, 6, (2, 1000))
    las.scanner_channel, las.gps_time = rng.integers(0, 4, 1000), rng.uniform(0, 1e9, 1000)
    las.write(path, laz_backend=laspy.LazBackend.Lazrs)
    (block,) = open_scans(path)[0].blocks()
    judge = laspy.read(path)
    assert np.array_equal(block.xyz, np.column_stack([judge.x, judge.y, judge.z]))
    assert np.array_equal(block.intensity, judge.intensity)


def test_a_laz_that_claims_more_points_than_its_chunks_hold_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.laz"
    write_laz(path, 100, 3)
    data = bytearray(path.read_bytes())
    struct.pack_into("<Q", data, 247, 50_001)
    path.write_bytes(data)
    with pytest.raises(ScanError, match="50001 points in 1 chunks of 50000"):
        open_scans(path)


def test_a_laz_of_more_chunks_than_its_bytes_hold_is_refused(tmp_path: Path) -> None:
    """Room is made for all that the table claims."""
    header = laspy.LasHeader(version="1.2", point_format=0)
    las = laspy.LasData(header)
    las.X = las.Y = las.Z = np.arange(300) * 7919 % 50_000
    path = tmp_path / "a.laz"
    las.write(path, laz_backend=laspy.LazBackend.Lazrs)
    data = bytearray(path.read_bytes())
    start = struct.unpack_from("<I", data, 96)[0]
    table = struct.unpack_from("<q", data, start)[0]
    held = (table - start - 8) // 20
    assert struct.unpack_from("<I", data, table + 4) == (1,) and held > 2
    struct.pack_into("<I", data, table + 4, held + 2)
    path.write_bytes(data)
    with pytest.raises(
        ScanError, match=rf"{held + 2} chunks in .* bytes, expected a point of 20 bytes in each"
    ):
        open_scans(path)


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
