"""Test archives of LAS files that state units, hold points to leave out, or declare too few points (issue 35)."""

import json
import struct
from pathlib import Path

import laspy
import numpy as np
import pytest
from scan_campaign import edit_list
from solidcloud.builder.config import BuildConfig
from solidcloud.builder.edit.edit_archive import add_scans
from solidcloud.builder.pipeline import build_archive
from solidcloud.builder.sources import class_counts
from solidcloud.builder.sources.scan_list import read_scan_list
from solidcloud.schemas.archive.archive import Archive
from solidcloud.schemas.archive.index import Header
from solidcloud.schemas.errors import ScanError
from solidcloud.server.cli.main import run
from synthetic_scans import write_xyz

FOOT = 1200 / 3937
# A room of 4 x 5 x 2.5 m, in steps of 1/1000 of a US survey foot.
ROOM = np.random.default_rng(5).integers(
    0, 1 + np.rint(np.array([4, 5, 2.5]) / FOOT * 1000).astype(int), (3000, 3)
)
US_FEET = [1, 1, 0, 2, 1024, 0, 1, 1, 3076, 0, 1, 9003]
DEGREES = [1, 1, 0, 1, 1024, 0, 1, 2]


def write(path: Path, raw: np.ndarray, keys: list[int] | None = None, **more: object) -> Path:
    """Write a LAS or LAZ file with a step of 0.001 and GeoTIFF keys. more: attributes of LasData."""
    header = laspy.LasHeader(version="1.2", point_format=1)
    header.scales = [0.001] * 3
    las = laspy.LasData(header)
    las.X, las.Y, las.Z = raw.astype(np.int32).T
    for name, value in more.items():
        setattr(las, name, value)
    if keys:
        las.header.vlrs.append(laspy.VLR("LASF_Projection", 34735, "", np.array(keys, "<u2").tobytes()))
    las.write(path, laz_backend=laspy.LazBackend.Lazrs)
    return path


def header_of(target: Path) -> Header:
    with Archive(target) as archive:
        return archive.header


def built(tmp_path: Path, *paths: Path, **options: object) -> Header:
    build_archive(paths, tmp_path / "archive", BuildConfig(jobs=1, overwrite=True, **options))
    return header_of(tmp_path / "archive")


@pytest.fixture(autouse=True)
def _here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


@pytest.mark.parametrize("name", ["a.las", "a.laz"])
def test_a_room_in_feet_is_built_in_metres_on_its_own_lattice(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write(tmp_path / name, ROOM, US_FEET)
    assert run(["inspect", name]) == 0
    assert "US survey feet (us-ft), as GeoTIFF key 3076 = 9003 states: converted" in capsys.readouterr().err
    assert read_scan_list(tmp_path / "scans.toml")[0].units == "us-ft"
    edit_list(tmp_path / "scans.toml", {"units": None})  # a list written by hand
    for scans in (name, "scans.toml"):
        assert run(["build", scans, "-o", "archive", "--jobs", "1", "--overwrite"]) == 0
        assert "US survey feet" in capsys.readouterr().err
        header = header_of(tmp_path / "archive")
        size = (header.high - header.low) * header.lattice.step
        assert np.abs(size - np.ptp(ROOM, axis=0) * 0.001 * FOOT).max() < 1e-9
        assert header.lattice_source == "sources" and header.moved_max < 1e-9
        assert header.sources[0].units == "us-ft"
    write(tmp_path / "b.las", ROOM + 1, US_FEET)
    (warning,) = add_scans(tmp_path / "archive", [tmp_path / "b.las"], jobs=1).warnings
    assert "US survey feet" in warning
    edit_list(tmp_path / "scans.toml", {"units": "m"})
    header = built(tmp_path, tmp_path / "scans.toml")
    assert np.array_equal(header.high - header.low, np.ptp(ROOM, axis=0))


def test_degrees_are_refused_unless_a_list_says_otherwise(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write(tmp_path / "a.las", ROOM, DEGREES)
    assert run(["inspect", "a.las"]) == 3 and run(["build", "a.las", "-o", "archive"]) == 3
    assert (
        capsys.readouterr().err.count("degrees of latitude and longitude, as GeoTIFF key 1024 = 2 states")
        == 2
    )
    assert run(["build", "scans.toml", "-o", "archive"]) == 3
    edit_list(tmp_path / "scans.toml", {"units": "m"})
    assert len(built(tmp_path, tmp_path / "scans.toml").sources) == 1
    write_xyz(tmp_path / "b.xyz", ROOM * 0.001)
    assert built(tmp_path, tmp_path / "a.las", tmp_path / "b.xyz", skip_bad=True).unknown_everywhere


@pytest.mark.parametrize("keys", [None, US_FEET])
def test_the_region_of_a_file_with_a_count_of_zero_is_unknown(keys: list[int] | None, tmp_path: Path) -> None:
    path = write(tmp_path / "a.las", ROOM, keys)
    data = bytearray(path.read_bytes())
    struct.pack_into("<I", data, 107, 0)
    path.write_bytes(data)
    write_xyz(tmp_path / "b.xyz", ROOM * 0.001 + 50)
    with pytest.raises(ScanError, match="0 points declared"):
        built(tmp_path, path, tmp_path / "b.xyz")
    header = built(tmp_path, path, tmp_path / "b.xyz", skip_bad=True)
    low, high = header.lattice.to_lattice(
        np.stack([ROOM.min(axis=0), ROOM.max(axis=0)]) * 0.001 * (FOOT if keys else 1)
    )
    (box,) = header.unknown
    assert not header.unknown_everywhere
    assert (box[0] <= low).all() and (high <= box[1]).all() and (np.abs(box - [low, high]) < 200).all()


def test_classes_are_left_out_by_builds_and_by_what_is_added(tmp_path: Path) -> None:
    classes = np.arange(3000) % 20
    flags = {
        "classification": classes.astype(np.uint8),
        "withheld": classes == 2,
        "synthetic": classes % 5 == 3,
    }
    path = write(tmp_path / "a.las", ROOM, **flags)
    plain = tmp_path / "b.xyz"
    write_xyz(plain, ROOM[:100] * 0.001)
    drop = frozenset({7, 18, "synthetic"})
    header = built(tmp_path, path, plain, drop_classes=drop)
    assert header.options["drop_classes"] == "7,18,synthetic"
    left = {source.path: source.skipped for source in header.sources}
    assert left == {str(path): {"withheld": 150, "class 7": 150, "synthetic": 600}, str(plain): {}}
    assert header.points == 3100 - 900
    write(tmp_path / "c.laz", ROOM + 10, **flags)
    assert add_scans(tmp_path / "archive", [tmp_path / "c.laz"], jobs=1).points == 2200 + 2100
    assert header_of(tmp_path / "archive").sources[-1].skipped == left[str(path)]
    assert "drop_classes" not in BuildConfig().identity()


def test_a_scan_whose_points_are_all_left_out_is_empty_and_no_fault(tmp_path: Path) -> None:
    path = write(tmp_path / "a.las", ROOM, withheld=np.ones(3000, bool))
    write_xyz(tmp_path / "b.xyz", ROOM[:100] * 0.001)
    header = built(tmp_path, path, tmp_path / "b.xyz")
    assert header.points == 100 and not header.unknown_everywhere and not len(header.unknown)
    assert {s.path: (s.count, s.skipped, s.fault) for s in header.sources}[str(path)] == (
        0,
        {"withheld": 3000},
        "",
    )
    with pytest.raises(ScanError, match="no usable scan"):
        built(tmp_path, path)
    with pytest.raises(ScanError, match="no usable point"):
        add_scans(tmp_path / "archive", [path], again=True, jobs=1)


def test_inspect_counts_what_may_be_left_out(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    noise = np.where(np.arange(3000) % 10 == 0, 7, 2).astype(np.uint8)
    write(tmp_path / "a.laz", ROOM, classification=noise, withheld=noise == 7)
    assert run(["inspect", "a.laz"]) == 0
    assert (
        "a.laz: 300 points withheld, which a build leaves out; 300 of class 7: `build --drop-classes 7` leaves"
        in capsys.readouterr().out
    )
    monkeypatch.setattr(class_counts, "COUNTED_POINTS", 400)
    monkeypatch.setattr(class_counts, "LEAST_COUNTED", 1)
    assert run(["inspect", "a.laz", "--json"]) == 0
    (found,) = json.loads(capsys.readouterr().out)
    assert found["flagged"] == {
        "exact": False,
        "withheld": 300,
        "class 7": 300,
        "class 18": 0,
        "synthetic": 0,
    }
    assert run(["build", "a.laz", "-o", "archive", "--drop-classes", "7,noise"]) == 2
