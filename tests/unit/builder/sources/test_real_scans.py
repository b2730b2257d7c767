"""Test the readers on real scans, samples and malformed files. MANIFEST gives the origin of the figures."""

import os
from collections.abc import Iterator
from pathlib import Path

import laspy
import numpy as np
import plyfile
import pye57
import pytest
from solidcloud.builder.sources.scan_files import find_scan_files, open_scans
from solidcloud.schemas.errors import ScanError

FOLDER = os.environ.get("SOLIDCLOUD_SCANS")
pytestmark = pytest.mark.skipif(
    not FOLDER, reason="SOLIDCLOUD_SCANS is not set: it names the folder of real scans"
)


@pytest.fixture
def folder() -> Iterator[Path]:
    path = Path(FOLDER or "")
    if not (path / "MANIFEST.md").exists():
        pytest.fail(f"SOLIDCLOUD_SCANS is {path}, expected a folder with a MANIFEST.md")
    yield path


def read_all(path: Path, block_points: int = 1 << 18) -> np.ndarray:
    """The points of all scans of a file, (n, 3)."""
    blocks = [block.xyz for scan in open_scans(path) for block in scan.blocks(block_points)]
    return np.concatenate([np.empty((0, 3)), *blocks])


# name, points, bounds as the MANIFEST prints them, half a unit of their last digit
SCANS = [
    ("indoor_atrium.laz", 808_042, [-22.99, -1.97, -7.90], [5.63, 7.55, 12.36], 0.005),
    ("pumpA.e57", 155_201, [-2.90, -5.30, -1.90], [1.72, -0.79, 1.84], 0.005),
    ("octomap_hall.xyz", 88_206, [-0.08, -15.10, -1.04], [27.16, 16.46, 10.11], 0.005),
    (
        "lone_star.copc.laz",
        518_862,
        [515368.60, 4918340.36, 2322.90],
        [515401.04, 4918381.12, 2338.58],
        0.005,
    ),
    ("avatar/al.obj", 3_618, [-2.712, -3.294, -1.112], [2.712, 2.598, 1.112], 0.0005),
    ("avatar/cesium_man.obj", 3_273, [-0.13, -0.57, 0], [0.18, 0.57, 1.51], 0.005),
    ("campus_scan_a.ply", 69_088, [-23.3, -74.7, -3.0], [19.0, 8.9, 10.8], 0.05),
    ("campus_scan_b.ply", 69_792, None, None, 0.0),
]


@pytest.mark.parametrize(("name", "count", "low", "high", "slack"), SCANS, ids=[scan[0] for scan in SCANS])
def test_real_scans_have_the_counts_and_bounds_that_are_known(
    name: str, count: int, low: list | None, high: list | None, slack: float, folder: Path
) -> None:
    (scan,) = open_scans(folder / name)
    xyz = read_all(folder / name)
    assert len(xyz) == count
    assert scan.declared_count in (None, count)
    if low is not None:
        assert np.abs(xyz.min(axis=0) - low).max() <= slack + 1e-9
        assert np.abs(xyz.max(axis=0) - high).max() <= slack + 1e-9
    if scan.bounds is not None:
        assert (scan.bounds[0] <= xyz.min(axis=0) + 1e-6).all()
        assert (scan.bounds[1] >= xyz.max(axis=0) - 1e-6).all()


def test_the_dome_in_six_files_keeps_its_map_coordinates(folder: Path) -> None:
    files = find_scan_files([folder / "cupola_las"])
    assert [path.name for path in files] == ["r.las", "r0.las", "r1.las", "r2.las", "r3.las", "r4.las"]
    xyz = np.concatenate([read_all(path) for path in files])
    assert len(xyz) == 107_935
    assert np.abs(xyz.min(axis=0) - [2322968.55, 4770131.88, 290.19]).max() <= 0.005 + 1e-9
    assert np.abs(xyz.max(axis=0) - [2322997.37, 4770162.70, 342.37]).max() <= 0.005 + 1e-9


@pytest.mark.parametrize("name", ["lone_star.copc.laz", "cupola_las/r0.las", "malformed/las_lots_of_vlr.las"])
def test_real_las_equals_what_laspy_reads_at_once(name: str, folder: Path) -> None:
    judge = laspy.read(folder / name)
    assert np.array_equal(read_all(folder / name, 10_007), np.column_stack([judge.x, judge.y, judge.z]))


@pytest.mark.parametrize("name", ["lone_star.copc.laz", "indoor_atrium.laz"])
def test_a_range_of_a_real_laz_is_that_of_a_run_through(name: str, folder: Path) -> None:
    """COPC has chunks of all sizes, an octree node each."""
    (scan,) = open_scans(folder / name)
    xyz = read_all(folder / name)
    rng = np.random.default_rng(5)
    for start in rng.integers(0, len(xyz) - 1000, 5):
        found = np.concatenate([block.xyz for block in scan.blocks(300, int(start), int(start) + 1000)])
        assert np.array_equal(found, xyz[start : start + 1000])


@pytest.mark.parametrize("name", ["pumpA.e57", "format_samples/translationWithoutRotation.e57"])
def test_real_e57_equals_what_pye57_reads_at_once(name: str, folder: Path) -> None:
    with pye57.E57(str(folder / name)) as file:
        judge = file.read_scan(0, ignore_missing_fields=True)
    expected = np.column_stack([judge[f"cartesian{axis}"] for axis in "XYZ"])
    assert np.array_equal(read_all(folder / name, 10_007), expected)


def test_real_ply_equals_what_plyfile_reads_at_once(folder: Path) -> None:
    judge = plyfile.PlyData.read(folder / "campus_scan_a.ply")["vertex"]
    assert np.array_equal(
        read_all(folder / "campus_scan_a.ply", 10_007), np.column_stack([judge[a] for a in "xyz"])
    )
    (scan,) = open_scans(folder / "campus_scan_a.ply")
    light = np.concatenate([block.intensity for block in scan.blocks()])
    assert np.array_equal(light, judge["scalar_intensity"])


# name, points, points dropped, whether there is intensity
READABLE = [
    ("format_samples/A_moved_B.e57", 6, 0, True),
    ("format_samples/translationWithoutRotation.e57", 4, 0, False),
    ("format_samples/autzen.pts", 10, 0, True),
    ("format_samples/site_56_8.pts", 8, 0, True),
    ("format_samples/test.pts", 19, 0, True),
    ("format_samples/1.2-with-color.ptx", 1065, 0, True),
    ("format_samples/no-color.ptx", 15, 0, True),
    ("format_samples/complex-transform.ptx", 4, 8, True),
    ("format_samples/multiple-and-transform.ptx", 8, 0, True),
    ("format_samples/autzen-utm.pcd", 1065, 0, True),
    ("format_samples/simple_binary.ply", 3, 0, False),
    ("format_samples/simple_with_page.copc.laz", 1_065, 0, True),
    ("format_samples/utm17_1.txt", 10, 0, False),
    ("malformed/e57_ZeroPoints.e57", 0, 0, False),
    ("malformed/e57_InvalidCVHeader.e57", 0, 0, False),
    ("malformed/e57_empty.e57", 0, 0, False),
    ("malformed/e57_tiny_spherical.e57", 180, 180, False),
    ("malformed/e57_cartesian_invalid_state_single.e57", 1, 2, False),
    ("malformed/las_bad_vlr_count.las", 10, 0, True),
    ("malformed/las_bad-geotiff-keys.las", 10, 0, True),
    ("malformed/las_lots_of_vlr.las", 1, 0, True),
    ("malformed/las_gps-time-nan.las", 1, 0, True),
    ("malformed/las_no-points.las", 0, 0, False),
    ("malformed/ply_simple_text.ply", 3, 0, False),
    ("malformed/txt_missingheader.txt", 5, 0, False),
    ("malformed/txt_crlf_test.txt", 10, 0, True),
]


@pytest.mark.parametrize(
    ("name", "count", "dropped", "intensity"), READABLE, ids=[case[0] for case in READABLE]
)
def test_odd_files_that_are_valid_are_read(
    name: str, count: int, dropped: int, intensity: bool, folder: Path
) -> None:
    scans = open_scans(folder / name)
    blocks = [block for scan in scans for block in scan.blocks(7)]
    assert sum(len(block.xyz) for block in blocks) == count
    assert sum(sum(scan.dropped.values()) for scan in scans) == dropped
    assert all((block.intensity is not None) == intensity for block in blocks)
    assert all(np.isfinite(block.xyz).all() for block in blocks)


REFUSED = [
    ("malformed/las_garbage_nVariableLength.las", "719 points declared, expected at most the 718"),
    ("malformed/e57_bad-crc.e57", "ErrorBadChecksum"),
    ("malformed/ply_no_vertex.ply", "expected an element 'vertex'"),
    ("malformed/txt_badheader.txt", "x, y and z once each"),
]


@pytest.mark.parametrize(("name", "message"), REFUSED, ids=[case[0] for case in REFUSED])
def test_broken_files_are_refused(name: str, message: str, folder: Path) -> None:
    with pytest.raises(ScanError, match=message):
        read_all(folder / name)


def test_every_scan_of_a_ptx_is_where_its_own_matrix_puts_it(folder: Path) -> None:
    """The second scan of the sample is the first, written in the world's coordinates; z of the first is halved."""
    first, second = open_scans(folder / "format_samples/multiple-and-transform.ptx")
    assert first.pose[:3, 3].tolist() == [600000, 800000, 400]
    found = [np.concatenate([block.xyz for block in scan.blocks()]) for scan in (first, second)]
    assert np.abs(found[0] - found[1]).max() < 1e-9
    turned = read_all(folder / "format_samples/complex-transform.ptx")
    assert np.abs(turned[0] - [-3.03440738, -3.17378104, -1.82375004]).max() < 1e-8
