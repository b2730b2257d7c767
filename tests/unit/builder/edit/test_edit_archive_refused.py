"""Changes of an archive that are refused, and leave it as it is."""

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import synthetic_scans
from archive_edits import (
    EVERYTHING,
    OPTIONS,
    A,
    B,
    Build,
    Files,
    all_points,
    refused,
    same_scene,
    sort_points,
)
from archive_edits import built as built  # the fixtures
from archive_edits import files as files
from solidcloud.builder.config import BuildConfig
from solidcloud.builder.edit import added_scans as added_module
from solidcloud.builder.edit import edit_archive as generation_module
from solidcloud.builder.edit import rebuild_voxels as rebuild_module
from solidcloud.builder.edit.edit_archive import add_scans, remove_scans
from solidcloud.builder.passes.verify import verify_archive
from solidcloud.builder.pipeline import build_archive
from solidcloud.builder.resume.lock import locked
from solidcloud.schemas.archive.archive import Archive
from solidcloud.schemas.archive.index import SHARD_FOLDER
from solidcloud.schemas.errors import BadRequestError, CorruptError, FormatError, ScanError, SolidcloudError


def test_a_scan_that_is_in_is_refused_unless_again(built: Build, files: Files, tmp_path: Path) -> None:
    target = built(tmp_path / "x", "ab", keep=EVERYTHING)
    copy = shutil.copy(files.b, tmp_path / "copy.ply")
    for path in (files.b, Path(copy)):
        refused(
            target,
            BadRequestError,
            r"is already in the archive, as .*b\.ply\[0\]",
            lambda p=path: add_scans(target, [p], jobs=1),
        )
    other = Path(shutil.copy(files.c, tmp_path / "other.ply"))
    refused(
        target,
        BadRequestError,
        "is already in the archive",
        lambda: add_scans(target, [files.c, other], jobs=1),
    )
    refused(target, BadRequestError, "named twice", lambda: add_scans(target, [files.c, files.c], jobs=1))
    add_scans(target, [files.b], again=True, jobs=1)
    assert np.array_equal(all_points(target), sort_points(A, B, B))
    remove_scans(target, ["2"], jobs=1)
    same_scene(target, built(tmp_path / "ab", "ab", keep=EVERYTHING))


def test_scans_that_are_in_are_named_or_left_out_before_points_are_read(
    built: Build, files: Files, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    target = built(tmp_path / "x", "ab", keep=EVERYTHING)
    surveyed: list[str] = []
    survey = added_module.survey_range

    def noted(unit: Any) -> Any:
        surveyed.append(unit.scan.path.name)
        return survey(unit)

    monkeypatch.setattr(added_module, "survey_range", noted)
    everything = files.a.parent
    named = (
        r"2 of 3 scans: .*--new.*\n  .*a\.ply\[0\] is already in the archive, as .*a\.ply\[0\]"
        r"\n  .*b\.ply\[0\] is already in the archive"
    )
    refused(target, BadRequestError, named, lambda: add_scans(target, [everything], jobs=1))
    assert not surveyed
    added = add_scans(target, [everything], new_only=True, jobs=1)
    assert [Path(name).name for name in added.scans] == ["c.ply[0]"] and set(surveyed) == {"c.ply"}
    same_scene(target, built(tmp_path / "abc", "abc", keep=EVERYTHING))
    refused(
        target,
        BadRequestError,
        "nothing is new",
        lambda: add_scans(target, [everything], new_only=True, jobs=1),
    )


def test_scans_that_cannot_be_used_are_refused(built: Build, files: Files, tmp_path: Path) -> None:
    target = built(tmp_path / "x", "a")
    bad = tmp_path / "bad.ply"
    bad.write_bytes(files.b.read_bytes()[:-7])
    refused(target, ScanError, r"bad\.ply", lambda: add_scans(target, [files.c, bad], jobs=1))
    refused(target, ScanError, r"none\.ply", lambda: add_scans(target, [tmp_path / "none.ply"], jobs=1))


def test_a_scan_that_was_left_out_and_is_added_is_unknown_no_more(files: Files, tmp_path: Path) -> None:
    """Where it may have been is known again; the others' regions stay theirs."""
    rng = np.random.default_rng(4)
    whole = {name: tmp_path / f"{name}.las" for name in "mno"}
    for place, path in enumerate(whole.values()):
        synthetic_scans.write_las(path, rng.integers(0, 1000, (90, 3)) + 2000 * place)
    bytes_of = {name: path.read_bytes() for name, path in whole.items()}
    (lost := tmp_path / "p.ply").write_bytes(b"no scan")
    for path in whole.values():
        path.write_bytes(path.read_bytes()[:-40])
    target = tmp_path / "x"
    build_archive([files.a, *whole.values(), lost], target, BuildConfig(**OPTIONS, skip_bad=True))

    def unknown() -> tuple[dict[str, list[Any]], bool]:
        with Archive(target) as archive:
            header = archive.header
        held = {Path(s.path).name: s.unknown for s in header.sources if s.unknown is not None}
        assert sorted(row for row in held.values() if row >= 0) == list(range(len(header.unknown)))
        boxes = {name: header.unknown[row].tolist() if row >= 0 else [] for name, row in held.items()}
        return boxes, header.unknown_everywhere

    before, everywhere = unknown()
    assert everywhere and set(before) == {"m.las", "n.las", "o.las", "p.ply"}
    assert all(low[0] < high[0] for low, high in (before[f"{name}.las"] for name in "mno"))
    whole["n"].write_bytes(bytes_of["n"])
    add_scans(target, [whole["n"]], jobs=1)
    assert unknown() == ({name: box for name, box in before.items() if name != "n.las"}, True)
    shutil.copy(files.b, lost)
    add_scans(target, [lost, files.c], jobs=1)
    assert unknown() == ({name: before[name] for name in ("m.las", "o.las")}, False)
    for name in "mo":
        whole[name].write_bytes(bytes_of[name])
    add_scans(target, [whole["m"], whole["o"]], jobs=1)
    assert unknown() == ({}, False) and not verify_archive(target).faults


@pytest.mark.parametrize(
    ("module", "stage"), [(generation_module, "spool_added"), (rebuild_module, "verify_new")]
)
def test_a_scan_that_is_written_anew_meanwhile_is_refused(
    built: Build, files: Files, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, module: Any, stage: str
) -> None:
    """Other points would be in under the hash of those that it had, as many as they are."""
    target = built(tmp_path / "there" / "x", "a")
    path = Path(shutil.copy(files.b, tmp_path / "other.ply"))
    work = getattr(module, stage)

    def written_before(*given: Any) -> Any:
        synthetic_scans.write_ply(path, B[::-1].copy(), np.zeros(len(B), np.float32))
        return work(*given)

    with monkeypatch.context() as patch:
        patch.setattr(module, stage, written_before)
        refused(
            target,
            ScanError,
            r"other\.ply .*: changed while it was read.*: add it again",
            lambda: add_scans(target, [path], jobs=1),
        )
    assert add_scans(target, [path], jobs=1).generation == 1


def test_a_scan_too_far_away_is_refused(built: Build, tmp_path: Path) -> None:
    target = built(tmp_path / "x", "a")
    far = synthetic_scans.write_ply(tmp_path / "far.ply", np.array([[9e8, 0.0, 0]]))
    refused(target, BadRequestError, "expected within", lambda: add_scans(target, [far], jobs=1))


def test_removing_needs_scans_and_leaves_one(built: Build, files: Files, tmp_path: Path) -> None:
    plain = built(tmp_path / "p" / "x", "ab") if (tmp_path / "p").mkdir() is None else tmp_path
    refused(plain, BadRequestError, "built without --keep scan", lambda: remove_scans(plain, ["0"], jobs=1))
    target = built(tmp_path / "x", "ab", keep=EVERYTHING)
    for named in ("nothing.ply", "2", "-1", str(files.c)):
        refused(
            target,
            BadRequestError,
            "is not a scan of this archive, which has 0: ",
            lambda n=named: remove_scans(target, [n], jobs=1),
        )
    refused(
        target, BadRequestError, "nothing would be left", lambda: remove_scans(target, ["0", "1"], jobs=1)
    )
    refused(target, BadRequestError, "no scan is named", lambda: remove_scans(target, [], jobs=1))
    remove_scans(target, ["0"], jobs=1)
    refused(target, BadRequestError, "is not a scan", lambda: remove_scans(target, ["0"], jobs=1))
    refused(target, BadRequestError, "nothing would be left", lambda: remove_scans(target, ["1"], jobs=1))


def test_what_is_no_archive_is_refused(files: Files, tmp_path: Path) -> None:
    (tmp_path / "x").mkdir()
    for change in (lambda: add_scans(tmp_path / "x", [files.b]), lambda: remove_scans(tmp_path / "x", ["0"])):
        with pytest.raises(FormatError, match="no archive here"):
            change()


def test_a_second_one_is_refused_while_one_is_at_work(built: Build, files: Files, tmp_path: Path) -> None:
    target = built(tmp_path / "x", "a")
    with locked(target), pytest.raises(BadRequestError, match="another build, add or remove is writing it"):
        add_scans(target, [files.b], jobs=1)


def test_a_damaged_record_stops_it(built: Build, files: Files, tmp_path: Path) -> None:
    target = built(tmp_path / "x", "a", keep=EVERYTHING)
    with Archive(target) as archive:
        at = [(int(r["frame_offset"][2]), int(r["frame_bytes"][2])) for r in archive.voxels]
    with open(target / SHARD_FOLDER / "0-000000.h5", "r+b") as file:
        for offset, size in at:
            file.seek(offset + size // 2)
            byte = file.read(1)[0]
            file.seek(offset + size // 2)
            file.write(bytes([byte ^ 1]))
    refused(target, CorruptError, "voxel", lambda: add_scans(target, [files.b], jobs=1))


def test_out_of_memory_says_what_the_archive_is_and_what_to_do(
    built: Build, files: Files, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: Any) -> Any:
        raise MemoryError("Unable to allocate 3 GiB")

    target = built(tmp_path / "there" / "x", "a")
    monkeypatch.setattr(rebuild_module, "_build", fail)
    said = rf"^{target}: out of memory \(Unable to allocate 3 GiB\): give fewer --jobs.*; the archive is what it was$"
    refused(target, SolidcloudError, said, lambda: add_scans(target, [files.b], jobs=1))
