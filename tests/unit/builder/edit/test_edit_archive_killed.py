"""Changes of an archive that end before they are done: it is the old one or the new one, whenever."""

import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from archive_edits import EVERYTHING, A, B, Build, Files, refused, snapshot
from archive_edits import built as built  # the fixtures
from archive_edits import files as files
from sample_sizes import sample
from solidcloud.builder.edit import rebuild_voxels as rebuild_module
from solidcloud.builder.edit.archive_change import delete_orphans
from solidcloud.builder.edit.edit_archive import add_scans, remove_scans
from solidcloud.builder.edit.rebuild_voxels import ChangeSummary
from solidcloud.builder.passes.level_pass import write_level
from solidcloud.builder.passes.preview import write_preview
from solidcloud.builder.passes.verify import verify_archive
from solidcloud.schemas.archive.archive import Archive
from solidcloud.schemas.archive.index import INDEX_NAME, SHARD_FOLDER
from solidcloud.schemas.archive.level import LEVEL_FOLDER
from solidcloud.schemas.archive.vtkhdf import PREVIEW_NAME
from solidcloud.schemas.errors import SolidcloudError

# What changes files, all of which a change goes through by name.
STEPS = ("replace", "rename", "unlink", "fsync", "link", "symlink", "mkdir", "rmdir")


def of_level(files: dict[str, bytes], *, remove: bool = False) -> dict[str, bytes]:
    """Return the files of the level among those of an archive, and remove them from the others."""
    level = {name: held for name, held in files.items() if name.startswith(f"{LEVEL_FOLDER}/")}
    if remove:
        for name in level:
            del files[name]
    return level


def run_killed(change: Callable[[], object], step: int | None) -> list[str]:
    """Run a change in a process of its own that ends without a word before file operation number `step`.

    Returns the names of all of them where it is not killed, for None.
    """
    reading, writing = os.pipe()
    child = os.fork()
    if child == 0:
        done: list[str] = []
        kept = {name: getattr(os, name) for name in STEPS}

        def counted(name: str) -> Callable[..., Any]:
            def call(*what: Any, **more: Any) -> Any:
                if len(done) == step:
                    os._exit(9)
                done.append(name)
                return kept[name](*what, **more)

            return call

        try:
            for name in STEPS:
                setattr(os, name, counted(name))
            change()
            os.write(writing, " ".join(done).encode())
        finally:
            os._exit(0)
    os.close(writing)
    with open(reading, "rb") as pipe:
        told = pipe.read()
    _, status = os.waitpid(child, 0)
    assert os.waitstatus_to_exitcode(status) == (0 if step is None else 9)
    return told.decode().split()


def changes(files: Files) -> dict[str, Callable[[Path], object]]:
    """What is killed."""
    return {
        "add": lambda target: add_scans(target, [files.b], jobs=1),
        "remove": lambda target: remove_scans(target, [str(files.a)], jobs=1),
    }


@pytest.mark.parametrize("what", ["add", "remove"])
def test_killed_anywhere_it_is_the_old_archive_or_the_new_one(
    built: Build, files: Files, tmp_path: Path, what: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "fsync", lambda _: None)  # the power stays on in this test
    change = changes(files)[what]
    begin = built(tmp_path / "begin", "ac", keep=EVERYTHING)
    # Once before: what is compiled on first use is written to numba's cache, and would be counted among the steps.
    shutil.copytree(begin, tmp_path / "warm" / "hall")
    change(tmp_path / "warm" / "hall")
    undisturbed = tmp_path / "there" / "hall"
    shutil.copytree(begin, undisturbed)
    steps = run_killed(lambda: change(undisturbed), None)
    old, new = snapshot(begin), snapshot(undisturbed)
    assert old != new
    # Each renaming and what comes next, and of the others some.
    renamed = {n for n, name in enumerate(steps) if name in ("rename", "replace")}
    assert len(renamed) > 5
    seen = set()
    places = sorted(renamed | {n + 1 for n in renamed if n + 1 < len(steps)} | set(range(0, len(steps), 40)))
    for step in places[:: sample(5, 1)]:
        place = tmp_path / f"at{step}"
        target = place / "hall"
        shutil.copytree(begin, target)
        run_killed(lambda target=target: change(target), step)
        assert not verify_archive(target).faults
        found = snapshot(target)
        is_new = found[INDEX_NAME] == new[INDEX_NAME]
        seen.add(is_new)
        preview, level = found.pop(PREVIEW_NAME), of_level(found, remove=True)
        assert level in ({}, of_level(old)) or (is_new and level == of_level(new)), "old, new or none"
        assert preview == old[PREVIEW_NAME] or (is_new and preview == new[PREVIEW_NAME])
        whole = dict(new if is_new else old)
        del whole[PREVIEW_NAME]
        of_level(whole, remove=True)
        assert whole.items() <= found.items(), "what the index names is there, byte for byte"
        if not is_new:
            change(target)
            assert snapshot(target) == new, "what a killed run left is gone, and nothing else is different"
        else:
            with Archive(target) as archive:
                delete_orphans(target, {name for name, _ in archive.shards()})
            write_preview(target)
            write_level(target)
            assert snapshot(target) == new
        shutil.rmtree(place)
    assert seen == {False, True}


def test_a_failure_leaves_the_old_archive_and_nothing_else(
    built: Build, files: Files, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    target = built(tmp_path / "x", "a")

    def broken(*_: object) -> Iterator[None]:
        raise OSError(28, "No space left on device")

    for name in ("gather", "build_shard", "archive_mean", "write_index", "verify_new"):
        with monkeypatch.context() as patch:
            patch.setattr(rebuild_module, name, broken)
            refused(
                target,
                SolidcloudError,
                "no space left.*: make room; the archive is what it was",
                lambda: add_scans(target, [files.b], jobs=1),
            )
    rename = os.replace

    def broken_index(source: Path, to: Path) -> None:
        if Path(to) == target / INDEX_NAME:
            broken()
        rename(source, to)

    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", broken_index)
        refused(
            target,
            SolidcloudError,
            "no space left.*: make room; the archive is what it was",
            lambda: add_scans(target, [files.b], jobs=1),
        )
    assert add_scans(target, [files.b], jobs=1).generation == 1


@pytest.mark.parametrize("error", [KeyboardInterrupt(), OSError(5, "Input/output error")])
def test_an_error_told_once_the_index_is_renamed_leaves_the_new_archive(
    built: Build, files: Files, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: BaseException
) -> None:
    """As an interruption during the call is told after it, and some file servers tell an error of what they did."""
    target = built(tmp_path / "x", "a")
    rename = os.replace

    def renamed_and_broken(source: Path, to: Path) -> None:
        rename(source, to)
        if Path(to) == target / INDEX_NAME:
            raise error

    told = "input/output.*; the archive is changed nevertheless" if isinstance(error, OSError) else None
    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", renamed_and_broken)
        expected = SolidcloudError if told else KeyboardInterrupt
        with pytest.raises(expected, match=told):
            add_scans(target, [files.b], jobs=1)
    report = verify_archive(target)
    assert not report.faults and report.points == len(A) + len(B)
    with Archive(target) as archive:
        assert archive.header.generation == 1
    assert add_scans(target, [files.c], jobs=1).generation == 2


@pytest.mark.parametrize("keep", [frozenset({"scan"}), frozenset()])
def test_a_disk_without_room_is_told_before_it_is_full(
    built: Build, files: Files, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, keep: frozenset[str]
) -> None:
    """First for the new points, then with those that are read again and built."""
    target = built(tmp_path / "there" / "x", "ac", keep=keep)
    row = 12 + 2 * ("scan" in keep)
    with Archive(target) as archive:
        held = archive.header.points
    free = 0

    def usage(_: Path) -> Any:
        return shutil._ntuple_diskusage(1 << 40, 0, free)

    def too_little(bytes_: int, change: Callable[[], ChangeSummary]) -> int:
        nonlocal free
        free = bytes_
        with pytest.raises(SolidcloudError, match=f"{free} bytes free, the change needs about") as told:
            refused(target, SolidcloudError, "make room; the archive is what it was", change)
            change()
        return int(str(told.value).split("about ")[1].split(":")[0])

    monkeypatch.setattr(shutil, "disk_usage", usage)
    needed = too_little(len(B) * row, lambda: add_scans(target, [files.b], jobs=1))
    assert len(B) * row < needed < len(B) * (row + 20)
    needed = too_little(needed, lambda: add_scans(target, [files.b], jobs=1))
    assert needed > 100 * row
    free = needed
    assert add_scans(target, [files.b], jobs=1).points == held + len(B)
    if keep:
        needed = too_little(0, lambda: remove_scans(target, [str(files.b)], jobs=1))
        free = needed
        assert remove_scans(target, [str(files.b)], jobs=1).points == held


def test_shards_that_no_voxel_refers_to_are_deleted(built: Build, files: Files, tmp_path: Path) -> None:
    target = built(tmp_path / "x", "ab", keep=EVERYTHING)
    keep = target / SHARD_FOLDER / "notes.txt"
    keep.write_text("not ours")
    for number in range(2):
        add_scans(target, [files.c], again=True, jobs=1)
        remove_scans(target, [str(files.c)], jobs=1)
        with Archive(target) as archive:
            named = {name for name, _ in archive.shards()}
        assert {p.name for p in keep.parent.iterdir()} == named | {"notes.txt"}
        assert archive.header.generation == 2 * number + 2
