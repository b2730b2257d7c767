"""A build does not resume with other options, scans or software; the error says what to give."""

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import solidcloud.builder.pipeline as pipeline
from interrupted_builds import build, content, interrupted
from solidcloud.builder.config import BuildConfig
from solidcloud.builder.resume.build_identity import check_same, describe_build
from solidcloud.builder.resume.kept_work import building_folder
from solidcloud.builder.run.software_versions import software_versions
from solidcloud.builder.sources.scan_files import InputFile, inspect_scans, open_input_files
from solidcloud.builder.sources.scan_list import write_scan_list
from solidcloud.schemas.errors import BadRequestError
from synthetic_scans import make_scan, write_las, write_xyz

OTHER = {
    "voxel": (4.0, "--voxel was 0.9, is 4.0: give --voxel 0.9 to resume it, or --fresh to start over"),
    "strict": (True, "--strict was not given, is given: give no --strict to resume it"),
    "models": (frozenset({"mean", "local"}), "--radius was not given, is mean,local"),
}


@pytest.mark.parametrize("name", OTHER)
def test_other_options_are_refused_by_name(
    name: str, scans: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    interrupted(tmp_path / "hall", scans, monkeypatch)
    value, expected = OTHER[name]
    before = content(building_folder(tmp_path / "hall"))
    with pytest.raises(BadRequestError) as caught:
        build(tmp_path / "hall", scans, **{name: value})
    assert expected in str(caught.value)
    assert content(building_folder(tmp_path / "hall")) == before
    build(tmp_path / "hall", scans, **{name: value, "fresh": True, "resolution": 0.01})
    assert not building_folder(tmp_path / "hall").exists()


def test_other_scans_are_refused_by_name(
    scans: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    interrupted(tmp_path / "hall", scans, monkeypatch)
    more = write_xyz(tmp_path / "c.xyz", make_scan("plane", 4, 20))
    cases: list[tuple[list[Path], str]] = [(scans[:1], "b.xyz is missing"), ([*scans, more], "c.xyz is new")]
    for paths, expected in cases:
        with pytest.raises(BadRequestError, match=expected):
            build(tmp_path / "hall", paths)
    was = scans[1].stat()
    os.utime(scans[1], ns=(was.st_atime_ns, was.st_mtime_ns + 1))
    with pytest.raises(BadRequestError, match=r"b\.xyz has another time: give the same scans as they were"):
        build(tmp_path / "hall", scans)
    scans[1].write_text("1 2 3\n")
    with pytest.raises(BadRequestError, match=rf"b\.xyz had {was.st_size} bytes, has 6"):
        build(tmp_path / "hall", scans)


def test_other_software_is_refused(
    scans: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    interrupted(tmp_path / "hall", scans, monkeypatch)
    other = {**software_versions(), "h5py": "0.1"}
    monkeypatch.setattr("solidcloud.builder.resume.build_identity.software_versions", lambda: other)
    expected = rf"begun with other software: h5py {software_versions()['h5py']}, now 0\.1: use .*--fresh to start over"
    with pytest.raises(BadRequestError, match=expected):
        build(tmp_path / "hall", scans)


def test_a_pose_and_a_file_that_cannot_be_opened_are_part_of_what_is_built(scans: list[Path]) -> None:
    opened = open_input_files(scans)
    what = describe_build(opened, BuildConfig())
    opened[0].scans[0].pose = np.diag([-1.0, -1, 1, 1])
    with pytest.raises(BadRequestError, match=r"a\.las has another pose"):
        check_same(Path("hall"), what, describe_build(opened, BuildConfig()))
    opened[0].scans[0].pose, opened[0].scans[0].crs, opened[0].scans[0].up = np.eye(4), "EPSG:25832", "y"
    with pytest.raises(BadRequestError, match=r"a\.las has another coordinate system and direction up"):
        check_same(Path("hall"), what, describe_build(opened, BuildConfig()))
    gone = [InputFile(scans[0].with_name("gone.las"), [], "no such file"), opened[1]]
    (entry, _) = describe_build(gone, BuildConfig())["inputs"][::-1]
    assert (Path(entry["path"]).name, entry["bytes"], entry["pose"]) == ("gone.las", -1, "")


def test_the_same_command_after_success_does_nothing(
    scans: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = build(tmp_path / "hall", scans)
    before = content(tmp_path / "hall")
    monkeypatch.setattr(pipeline, "_build", lambda *_: pytest.fail("built again"))
    again = build(tmp_path / "hall", scans[::-1], jobs=2, memory_bytes=100 << 20)
    assert (first.already, again.already) == (False, True)
    shared = ("archive", "points", "voxels", "shards", "bytes", "radius", "moved_max", "skipped", "faults")
    assert [getattr(again, name) for name in shared] == [getattr(first, name) for name in shared]
    assert content(tmp_path / "hall") == before


def test_an_archive_of_anything_else_is_in_the_way(scans: list[Path], tmp_path: Path) -> None:
    build(tmp_path / "hall", scans)
    with pytest.raises(BadRequestError, match="an archive is here already"):
        build(tmp_path / "hall", scans, degree=5)
    with pytest.raises(BadRequestError, match="an archive is here already"):
        build(tmp_path / "hall", scans[:1])
    raw = np.random.default_rng(3).integers(-1500, 1500, (250, 3))
    write_las(scans[0], raw)  # the same name, other points
    with pytest.raises(BadRequestError, match="an archive is here already"):
        build(tmp_path / "hall", scans)
    assert not building_folder(tmp_path / "hall").exists()


@pytest.mark.parametrize("elsewhere", [{"crs": "EPSG:25832"}, {"up": "y"}])
def test_an_archive_of_scans_that_stand_elsewhere_is_in_the_way(
    elsewhere: dict[str, str], scans: list[Path], tmp_path: Path
) -> None:
    entries = inspect_scans([scans[1]])
    write_scan_list(tmp_path / "scans.toml", entries)
    build(tmp_path / "hall", [tmp_path / "scans.toml"])
    assert build(tmp_path / "hall", [tmp_path / "scans.toml"]).already
    write_scan_list(tmp_path / "scans.toml", [replace(entry, **elsewhere) for entry in entries])
    with pytest.raises(BadRequestError, match="an archive is here already"):
        build(tmp_path / "hall", [tmp_path / "scans.toml"])
