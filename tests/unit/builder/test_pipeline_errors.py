"""What a build says when it cannot be, each error by name, and that nothing is left behind."""

import shutil
from pathlib import Path

import laspy
import numpy as np
import pytest
import solidcloud.builder.build_limits as build_limits
import solidcloud.builder.passes.build_shards as build_shards
import solidcloud.builder.passes.spool_pass as spool_pass
import solidcloud.builder.pipeline as pipeline
from small_builds import build, content, six_files
from solidcloud.builder.config import BuildConfig
from solidcloud.builder.passes.verify import verify_archive
from solidcloud.schemas.archive.archive import Archive
from solidcloud.schemas.errors import BadRequestError, CorruptError, ScanError, SolidcloudError
from synthetic_scans import make_scan, write_las, write_ply, write_xyz


@pytest.fixture
def scans(tmp_path: Path) -> list[Path]:
    """Six scans as text."""
    return six_files(tmp_path)


@pytest.fixture
def out(tmp_path: Path) -> Path:
    """An empty folder for archives."""
    folder = tmp_path / "out"
    folder.mkdir()
    return folder


def broken_las(path: Path) -> Path:
    """A LAS whose header is whole and whose points end early."""
    write_las(path, np.random.default_rng(2).integers(3000, 5000, (200, 3)))
    path.write_bytes(path.read_bytes()[:-1000])
    return path


def test_a_broken_scan_among_good_ones_stops_the_build(scans: list[Path], out: Path, tmp_path: Path) -> None:
    bad = broken_las(tmp_path / "bad.las")
    with pytest.raises(ScanError, match=r"bad\.las: .*--skip-bad leaves such scans out") as caught:
        build([*scans, bad], out / "a")
    assert caught.value.exit_code == 3
    assert not list(out.iterdir())


def test_every_broken_scan_is_named(scans: list[Path], out: Path, tmp_path: Path) -> None:
    for name in ("one.las", "two.ply", "three.e57"):
        (tmp_path / name).write_bytes(b"not a scan")
    with pytest.raises(ScanError) as caught:
        build([*scans, tmp_path / "one.las", tmp_path / "two.ply", tmp_path / "three.e57"], out / "a")
    assert all(name in str(caught.value) for name in ("one.las", "two.ply", "three.e57"))


def test_skip_bad_leaves_a_scan_out_and_marks_where_it_may_have_been(
    scans: list[Path], out: Path, tmp_path: Path
) -> None:
    bad = broken_las(tmp_path / "bad.las")
    summary = build([*scans, bad], out / "a", skip_bad=True)
    assert len(summary.faults) == 1
    assert str(bad) in summary.faults[0]
    with Archive(out / "a") as archive:
        header = archive.header
        assert header.points == 5 * 150 + 1
        assert not header.unknown_everywhere
        (box,) = header.unknown
        source = header.sources[-1]
        assert (source.path, source.count) == (str(bad), 0)
        assert source.fault == summary.faults[0]
        # All points that were lost lie in the box.
        with laspy.open(bad) as file:
            corners = np.array([file.header.mins, file.header.maxs])
        lattice = header.lattice.to_lattice(corners)
        assert (box[0] <= lattice[0]).all()
        assert (lattice[1] <= box[1]).all()
        # It is larger by a centimetre, because bounds may be rounded.
        assert np.abs(box - lattice).max() <= 2 + 0.01 / header.lattice.step


def test_skip_bad_knows_nothing_free_where_bounds_are_lost(
    scans: list[Path], out: Path, tmp_path: Path
) -> None:
    (tmp_path / "bad.ply").write_bytes(b"ply\nformat ascii 1.0\nelement vertex 3\n")
    summary = build([*scans, tmp_path / "bad.ply"], out / "a", skip_bad=True)
    assert "bad.ply" in summary.faults[0]
    with Archive(out / "a") as archive:
        assert archive.header.unknown_everywhere
        assert archive.header.unknown.shape == (0, 2, 3)


def test_an_empty_scan_is_an_error_and_left_out_without_a_trace(
    scans: list[Path], out: Path, tmp_path: Path
) -> None:
    write_ply(tmp_path / "empty.ply", make_scan("none", 1))
    with pytest.raises(ScanError, match=r"empty\.ply: .*holds no usable point, expected at least one"):
        build([*scans, tmp_path / "empty.ply"], out / "a")
    assert not list(out.iterdir())
    build([*scans, tmp_path / "empty.ply"], out / "a", skip_bad=True)
    with Archive(out / "a") as archive:
        assert not archive.header.unknown_everywhere
        assert archive.header.unknown.shape == (0, 2, 3)
    with pytest.raises(ScanError, match="no usable scan, expected at least one"):
        build([tmp_path / "empty.ply"], out / "b", skip_bad=True)
    assert [p.name for p in out.iterdir()] == ["a"]


def test_an_existing_target_is_refused(scans: list[Path], out: Path) -> None:
    (out / "a").mkdir()
    (out / "a" / "letter.txt").write_text("dear archive")
    with pytest.raises(BadRequestError, match="exists and is not an archive"):
        build(scans, out / "a", overwrite=True)
    (out / "b").write_text("a file")
    with pytest.raises(BadRequestError, match="exists and is not an archive"):
        build(scans, out / "b")
    build(scans, out / "c")
    before = content(out / "c")
    with pytest.raises(BadRequestError, match="an archive is here already: give another -o, or --overwrite"):
        build(scans, out / "c", degree=5)
    assert content(out / "c") == before
    assert sorted(p.name for p in out.iterdir()) == ["a", "b", "c"]


def test_what_no_note_vouches_for_is_removed(scans: list[Path], out: Path) -> None:
    left = out / ".a.building" / "archive" / "shards"
    left.mkdir(parents=True)
    (left / "0-000000.h5").write_bytes(b"half a shard")
    build(scans, out / "a")
    assert verify_archive(out / "a", deep=True).faults == ()
    assert [p.name for p in out.iterdir()] == ["a"]


@pytest.mark.parametrize("stage", ["spool_scans", "publish_folder"])
def test_a_full_disk_is_named_and_the_same_command_goes_on(
    stage: str, scans: list[Path], out: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object, **__: object) -> None:
        (out / ".a.building" / "half.tmp").write_bytes(b"half")
        raise OSError(28, "No space left on device", "some.file")

    build(scans, out / "b")
    with monkeypatch.context() as full:
        full.setattr(pipeline, stage, fail)
        with pytest.raises(SolidcloudError, match=r"no space left on the disk.*same command again") as caught:
            build(scans, out / "a")
    assert str(caught.value).startswith(str(out))
    assert caught.value.exit_code == 1
    assert sorted(p.name for p in out.iterdir()) == [".a.building", "b"]
    assert not list(out.rglob("*.tmp"))
    build(scans, out / "a")
    assert content(out / "a") == content(out / "b")
    assert sorted(p.name for p in out.iterdir()) == ["a", "b"]


def test_a_record_that_does_not_read_back_fails_the_build_and_is_made_again(
    scans: list[Path], out: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(build_limits, "SHARD_POINTS", 1000)
    measure = pipeline._measure_radius

    def damage(header: object, built: object, folder: Path, *rest: object) -> object:
        result = measure(header, built, folder, *rest)
        with Archive(folder) as archive:
            at = int(archive.voxels["frame_offset"][0, 2]) + 20
            path = archive.shard_path(0)
        data = bytearray(path.read_bytes())
        data[at] ^= 0xFF
        path.write_bytes(data)
        return result

    with monkeypatch.context() as patch:
        patch.setattr(pipeline, "_measure_radius", damage)
        with pytest.raises(
            CorruptError, match="read back differ from the data written: check disk and memory"
        ):
            build(scans, out / "a")
    assert not (out / "a").exists()
    # Of several shards only the one that is damaged is made again.
    made: list[object] = []
    build_shard = build_shards.build_shard
    monkeypatch.setattr(build_shards, "build_shard", lambda unit: made.append(unit) or build_shard(unit))
    monkeypatch.setattr(spool_pass, "spool_range", lambda _: pytest.fail("spooled again"))
    build(scans, out / "a")
    assert len(made) == 1
    assert len(list((out / "a" / "shards").iterdir())) > 1
    assert verify_archive(out / "a", deep=True).faults == ()


def test_a_build_that_cannot_fit_the_disk_is_refused(
    scans: list[Path], out: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    usage = shutil.disk_usage(out)._replace(free=1000)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage)
    with pytest.raises(SolidcloudError, match="1000 bytes free, the build needs about"):
        build(scans, out / "a")
    assert not list(out.rglob("*.run"))


BAD_OPTIONS = [
    {"degree": 1}, {"degree": 17}, {"leaf": 0}, {"leaf": 33}, {"cell_points": 0}, {"voxel": 0.0},
    {"voxel": float("nan")}, {"resolution": 0.0}, {"resolution": -1.0}, {"spacing": 0.0}, {"radius": -0.1},
    {"radius": float("nan")}, {"jobs": -1}, {"memory_bytes": 1 << 20}, {"keep": frozenset({"colour"})},
]  # fmt: skip


@pytest.mark.parametrize("options", BAD_OPTIONS, ids=str)
def test_impossible_options_are_refused(options: dict[str, object]) -> None:
    with pytest.raises(BadRequestError, match="expected"):
        BuildConfig(**options)


def test_a_build_killed_between_its_two_renames_is_finished(tmp_path: Path) -> None:
    scan = tmp_path / "scan.xyz"
    write_xyz(scan, make_scan("plane", 5, 200))
    target = tmp_path / "hall"
    build([scan], target)
    target.rename(tmp_path / ".hall.old")  # what --overwrite does first, and then it was killed
    assert build([scan], target).already
    assert sorted(path.name for path in tmp_path.iterdir()) == ["hall", "scan.xyz"]
    assert verify_archive(target).faults == ()


def test_overwrite_deletes_nothing_that_is_no_part_of_an_archive(tmp_path: Path) -> None:
    scan = tmp_path / "scan.xyz"
    write_xyz(scan, make_scan("plane", 5, 200))
    build([scan], tmp_path / "hall")
    for stranger in ("notes.txt", "shards/notes.txt"):
        (tmp_path / "hall" / stranger).write_text("mine")
        with pytest.raises(BadRequestError, match=r"notes\.txt: not part of an archive"):
            build([scan], tmp_path / "hall", overwrite=True)
        assert (tmp_path / "hall" / stranger).read_text() == "mine"
        (tmp_path / "hall" / stranger).unlink()
    build([scan], tmp_path / "hall", overwrite=True)


def test_a_failed_build_removes_the_folders_it_made(tmp_path: Path) -> None:
    empty = tmp_path / "empty.xyz"
    empty.write_text("nan nan nan\n")
    for paths in ([tmp_path / "nothere.las"], [empty]):
        with pytest.raises(ScanError):
            build(paths, tmp_path / "new" / "deeper" / "hall")
    assert [p.name for p in tmp_path.iterdir()] == ["empty.xyz"]


def test_a_header_that_cannot_be_right_leaves_all_unknown(tmp_path: Path) -> None:
    good = tmp_path / "good.xyz"
    write_xyz(good, make_scan("plane", 5, 200))
    raw = np.random.default_rng(1).integers(0, 1000, (500, 3))
    # Bounds of zeros, as writers leave them that do not know; and a damaged scale, by which no point is finite
    # though the bounds look right. (Bounds that points read refute: test_spool_pass.py.)
    for name, patch in (("zero", (179, np.zeros(6))), ("scale", (131, np.full(3, 1e308)))):
        bad = tmp_path / f"{name}.las"
        write_las(bad, raw, scale=0.01, offset=(100.0, 100, 0))
        data = bytearray(bad.read_bytes())
        data[patch[0] : patch[0] + patch[1].nbytes] = patch[1].tobytes()
        bad.write_bytes(data if name == "scale" else data[:-20])
        build([good, bad], tmp_path / name, skip_bad=True)
        with Archive(tmp_path / name) as archive:
            assert archive.header.unknown_everywhere or len(archive.header.unknown) == 1
            if name == "zero":
                assert archive.header.unknown_everywhere
            for low, high in archive.header.unknown:
                lost = archive.header.lattice.to_lattice(raw * 0.01 + [100.0, 100, 0])
                assert ((lost >= low) & (lost <= high)).all()


def test_text_in_a_folder_is_read_only_when_named(tmp_path: Path) -> None:
    folder = tmp_path / "scans"
    folder.mkdir()
    write_xyz(folder / "scan.xyz", make_scan("plane", 5, 200))
    (folder / "README.txt").write_text("notes, no points")
    assert build([folder], tmp_path / "hall").points == 200
    with pytest.raises(ScanError, match="README"):
        build([folder, folder / "README.txt"], tmp_path / "other")
