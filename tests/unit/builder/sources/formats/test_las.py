"""Test LAS and LAZ: exact coordinates, inconsistent headers, and chunks of every kind."""

import struct
from pathlib import Path

import laspy
import numpy as np
import pytest
from broken_scans import SEEDS
from scan_cases import read_all
from solidcloud.builder.sources.common.scan import SourceLattice
from solidcloud.builder.sources.placed_scan import place_scan
from solidcloud.builder.sources.scan_files import header_bounds, open_scans
from solidcloud.schemas.errors import ScanError


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
    "scale without value": (139, "<d", float("nan"), "scale"),
    "infinite offset": (155, "<d", float("inf"), "offset"),
}


@pytest.mark.parametrize("lie", LAS_LIES)
def test_a_las_header_that_lies_is_refused(lie: str, las: Path) -> None:
    at, code, value, message = LAS_LIES[lie]
    data = bytearray(las.read_bytes())
    struct.pack_into(code, data, at, value)
    las.write_bytes(data)
    with pytest.raises(ScanError, match=message) as caught:
        read_all(las)
    assert ("truncated" in str(caught.value)) == lie.startswith("points ")


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


@pytest.mark.parametrize("point_format", [0, 3, 6, 8])
@pytest.mark.parametrize("count", [1, 50_001])
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


def test_bounds_of_a_truncated_las_are_those_of_its_header(las: Path) -> None:
    whole = open_scans(las)[0].bounds
    las.write_bytes(las.read_bytes()[:1000])
    with pytest.raises(ScanError):
        open_scans(las)
    assert np.array_equal(header_bounds(las), whole)


XYZ = np.random.default_rng(35).integers(-5000, 5000, (200, 3)) * 0.001
KINDS = [("1.2", 0, False), ("1.4", 6, False), ("1.2", 0, True), ("1.4", 7, True)]


def made(
    path: Path,
    version: str = "1.2",
    point_format: int = 0,
    laz: bool = False,
    count: int = 200,
    **more: object,
) -> bytearray:
    """Write a LAS or LAZ file of the first points of XYZ; return its bytes. more: attributes of LasData."""
    header = laspy.LasHeader(version=version, point_format=point_format)
    header.scales = [0.001] * 3
    las = laspy.LasData(header)
    las.x, las.y, las.z = XYZ[:count].T
    for name, value in more.items():
        setattr(las, name, value)
    las.write(path, do_compress=laz, laz_backend=laspy.LazBackend.Lazrs if laz else None)
    return bytearray(path.read_bytes())


@pytest.mark.parametrize(("version", "point_format", "laz"), KINDS)
@pytest.mark.parametrize("count", [0, 1, 150, 199])
def test_a_count_with_points_behind_it_is_damage_and_keeps_its_bounds(
    count: int, version: str, point_format: int, laz: bool, tmp_path: Path
) -> None:
    """Issue 35, row 1: the file counted as valid, and the places of its points as free."""
    path = tmp_path / ("a.laz" if laz else "a.las")
    data = made(path, version, point_format, laz)
    whole = header_bounds(path)
    struct.pack_into("<I", data, 107, count)
    if version == "1.4":
        struct.pack_into("<Q", data, 247, count)
    path.write_bytes(data)
    with pytest.raises(ScanError, match=r"points behind them|further points|200 points in 1 chunks"):
        read_all(path)
    assert whole is not None and np.array_equal(header_bounds(path), whole)


def test_bounds_that_the_first_points_contradict_are_not_believed(tmp_path: Path) -> None:
    data = made(tmp_path / "a.las")
    struct.pack_into("<6d", data, 179, *(90.0, 80.0) * 3)
    struct.pack_into("<I", data, 107, 0)
    (tmp_path / "a.las").write_bytes(data)
    assert header_bounds(tmp_path / "a.las") is None


def test_the_count_of_older_versions_is_used_where_the_newer_one_is_zero(tmp_path: Path) -> None:
    """Issue 35, row 1."""
    data = made(tmp_path / "a.las", "1.4", 3)
    struct.pack_into("<Q", data, 247, 0)
    struct.pack_into("<I", data, 107, 200)
    (tmp_path / "a.las").write_bytes(data)
    assert np.array_equal(read_all(tmp_path / "a.las"), XYZ)


@pytest.mark.parametrize("count", [0, 200])
@pytest.mark.parametrize("laz", [False, True])
def test_what_may_follow_the_points_is_no_damage(laz: bool, count: int, tmp_path: Path) -> None:
    """Records, bytes of 0 that fill a block, and bytes that are no points within the bounds."""
    path = tmp_path / ("a.laz" if laz else "a.las")
    record = laspy.VLR("LASF_Spec", 4, "", b"notes" * 100)
    made(path, "1.4", 6, laz, count, evlrs=laspy.vlrs.vlrlist.VLRList([record]))
    assert len(read_all(path)) == count
    for more in (b"\0" * 300, b"unlike points" * 30)[: 0 if laz else 2 if count else 0]:
        data = made(path, "1.2", 1, laz, count)
        path.write_bytes(data + more)
        assert len(read_all(path)) == count


def negative(data: bytearray) -> None:
    struct.pack_into("<d", data, 147, -0.001)
    struct.pack_into("<2d", data, 211, *struct.unpack_from("<2d", data, 211)[::-1])  # as laspy does


def flat(data: bytearray) -> None:
    """Make all z the offset, with raw values of 0."""
    struct.pack_into("<d", data, 147, 0.0)
    for k in range(200):
        struct.pack_into("<i", data, len(data) - 20 * (200 - k) + 8, 0)


def flat_by_bounds(data: bytearray) -> None:
    struct.pack_into("<d", data, 147, 0.0)
    struct.pack_into("<2d", data, 211, 0.0, 0.0)


def large_records(data: bytearray) -> bytes:
    (start,) = struct.unpack_from("<I", data, 96)
    record = struct.pack("<2x16sHH32x", b"some", 1, 65535) + b"\1" * 65535
    struct.pack_into("<II", data, 96, start + 300 * len(record), 300)
    return data[:start] + record * 300 + data[start:]


def header_beyond(data: bytearray) -> None:
    struct.pack_into("<H", data, 94, 40_000)


def flattened(data: bytearray) -> None:
    struct.pack_into("<d", data, 147, 0.0)


READABLE = {
    "negative scale": negative,
    "scale of 0 and other raw values": flattened,
    "scale of 0 and raw values of 0": flat,
    "scale of 0 and flat bounds": flat_by_bounds,
    "more records than there are": lambda data: struct.pack_into("<I", data, 100, 7),
    "19 MB of records": large_records,
    "a header said to be longer than it is": header_beyond,
}


@pytest.mark.parametrize("kind", READABLE)
def test_what_laspy_reads_is_read(kind: str, tmp_path: Path) -> None:
    """Issue 35, row 20: all of them were called truncated."""
    data = made(tmp_path / "a.las")
    (tmp_path / "a.las").write_bytes(READABLE[kind](data) or data)
    judge = laspy.read(tmp_path / "a.las")
    assert np.array_equal(read_all(tmp_path / "a.las"), np.column_stack([judge.x, judge.y, judge.z]))
    (scan,) = open_scans(tmp_path / "a.las")
    assert scan.lattice is not None and min(scan.lattice.scale) > 0
    steps = (read_all(tmp_path / "a.las") - scan.lattice.offset) / scan.lattice.scale
    assert np.abs(steps - np.rint(steps)).max() < 1e-6
    flattens = "scale of 0" in kind and kind != "scale of 0 and flat bounds"
    assert ["scale of 0 for z" in note for note in scan.notes] == [True] * flattens


def test_a_record_that_the_header_does_not_count_is_found(tmp_path: Path) -> None:
    """Without it a LAZ file could not be decompressed, and a unit would be overlooked."""
    data = made(tmp_path / "a.laz", laz=True)
    struct.pack_into("<I", data, 100, 0)
    (tmp_path / "a.laz").write_bytes(data)
    assert np.array_equal(read_all(tmp_path / "a.laz"), XYZ)


@pytest.mark.parametrize(("version", "point_format", "laz"), KINDS)
def test_withheld_points_are_left_out_and_synthetic_ones_and_classes_on_request(
    version: str, point_format: int, laz: bool, tmp_path: Path
) -> None:
    """Issue 35, row 8. Ranges count what they leave out, too."""
    rng = np.random.default_rng(8)
    withheld, synthetic = rng.integers(0, 2, (2, 200)).astype(bool)
    classes = rng.integers(5, 9, 200).astype(np.uint8)
    path = tmp_path / ("a.laz" if laz else "a.las")
    made(path, version, point_format, laz, withheld=withheld, synthetic=synthetic, classification=classes)
    assert np.array_equal(read_all(path), XYZ[~withheld])
    (scan,) = open_scans(path)
    counts = scan.count_classes()
    assert counts["points"] == 200 and counts["class 7"] == (classes == 7).sum()
    assert (counts["withheld"], counts["synthetic"]) == (withheld.sum(), synthetic.sum())
    scan.drop_classes = frozenset({7, 100, "synthetic"})
    moved = place_scan(scan, units="ft")
    moved.drop_classes = scan.drop_classes
    for each, metres in ((scan, 1.0), (moved, 0.3048)):
        xyz = np.concatenate([block.xyz for block in each.blocks(30, 50)])
        gone = withheld | synthetic | (classes == 7)
        assert np.array_equal(xyz, XYZ[50:][~gone[50:]] * metres)
        assert each.dropped == {
            "withheld": withheld[50:].sum(),
            "synthetic": (synthetic & ~withheld)[50:].sum(),
            "class 7": ((classes == 7) & ~synthetic & ~withheld)[50:].sum(),
        }


def test_bounds_on_an_axis_of_negative_scale_may_be_exchanged(tmp_path: Path) -> None:
    header = laspy.LasHeader(version="1.2", point_format=0)
    header.scales = [0.001, 0.001, -0.001]
    las = laspy.LasData(header)
    las.X, las.Y, las.Z = np.rint(XYZ / header.scales).astype(np.int32).T
    las.write(tmp_path / "a.las")
    (scan,) = open_scans(tmp_path / "a.las")
    assert scan.bounds is not None
    assert np.abs(scan.bounds - [XYZ.min(axis=0), XYZ.max(axis=0)]).max() < 1e-6
