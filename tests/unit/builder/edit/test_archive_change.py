"""A change holds what `--memory` allows, or is refused before anything is changed, in the words of a build."""

import re
import shutil
import tracemalloc
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import synthetic_scans
from archive_edits import EVERYTHING, OPTIONS, A, Build, Files, refused
from archive_edits import built as built  # the fixtures
from archive_edits import files as files
from dense_voxels import KEY, rows_of, spooled
from solidcloud.builder import build_limits as memory
from solidcloud.builder.build_limits import SCRATCH_BYTES_A_POINT
from solidcloud.builder.config import BuildConfig
from solidcloud.builder.edit import added_scans as added_module
from solidcloud.builder.edit import rebuild_voxels as rebuild_module
from solidcloud.builder.edit import removed_scans as removed_module
from solidcloud.builder.edit.archive_change import Change
from solidcloud.builder.edit.edit_archive import add_scans, remove_scans
from solidcloud.builder.pipeline import build_archive
from solidcloud.builder.resume import transaction
from solidcloud.builder.run.executor import ProcessExecutor
from solidcloud.schemas.archive.archive import Archive
from solidcloud.schemas.archive.level import LEVEL_FOLDER
from solidcloud.schemas.archive.voxel_grid import voxel_coordinates
from solidcloud.schemas.archive.vtkhdf import PREVIEW_NAME
from solidcloud.schemas.errors import SolidcloudError

ADVICE = r"give --memory \d+MB, or build again with a smaller --voxel; the archive is what it was$"
LEAST = 64 << 20


def largest(target: Path) -> int:
    """The points of the largest voxel."""
    with Archive(target) as archive:
        return int(archive.voxels["rows"][:, 2].max())


def most_points(monkeypatch: pytest.MonkeyPatch, points: int, jobs: int = 1, given: int = LEAST) -> None:
    """Have records so large that one of so many points is just read back, and none of more."""
    room = memory._room(jobs, BuildConfig(memory_bytes=given)) - memory.RECORD_BYTES
    monkeypatch.setattr(memory, "record_bytes_a_point", lambda config: room // points)


def never(*_: Any) -> Any:
    """What must not be called."""
    raise AssertionError("called")


def denser(target: Path, path: Path) -> Path:
    """A scan of as many points more in the largest voxel of an archive of A."""
    of = np.floor(A / OPTIONS["voxel"] + 1e-9).astype(int)
    voxels, counts = np.unique(of, axis=0, return_counts=True)
    assert counts.max() == largest(target)
    inside = (voxels[counts.argmax()] + np.array([0.25, 0.25, 0.25])) * OPTIONS["voxel"]
    rng = np.random.default_rng(1)
    return synthetic_scans.write_ply(path, np.round(inside + rng.uniform(0, 0.2, (counts.max(), 3)), 3))


def test_a_voxel_that_gets_too_large_is_refused_as_in_a_build(
    built: Build, files: Files, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    target = built(tmp_path / "there" / "x", "a")
    more = denser(target, tmp_path / "more.ply")
    most = 2 * largest(target)
    said = []
    with monkeypatch.context() as patch:
        most_points(patch, most - 1)
        patch.setattr(rebuild_module, "gather", never)
        options: dict[str, Any] = {**OPTIONS, "memory_bytes": LEAST}
        with pytest.raises(SolidcloudError, match=f"{most} points") as error:
            build_archive([files.a, more], tmp_path / "y", BuildConfig(**options))
        said.append(str(error.value))
        refused(
            target,
            SolidcloudError,
            rf"^a voxel holds {most} points, and to read its record back takes \d+ MB: {ADVICE}",
            lambda: add_scans(target, [more], jobs=1, memory_bytes=LEAST),
        )
        with pytest.raises(SolidcloudError) as error:
            add_scans(target, [more], jobs=1, memory_bytes=LEAST)
        said.append(str(error.value))
    both = [re.split(r"(?<=\dMB)", text)[0] for text in said]
    assert both[0] == both[1] and both[0].endswith("MB")
    most_points(monkeypatch, most)
    assert add_scans(target, [more], jobs=1, memory_bytes=LEAST).points == len(A) + most // 2


def test_what_is_too_large_already_is_refused_before_a_scan_or_a_record_is_read(
    built: Build, files: Files, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    target = built(tmp_path / "there" / "x", "ab", keep=EVERYTHING)
    most_points(monkeypatch, largest(target) - 1)
    monkeypatch.setattr(added_module, "survey_range", never)
    monkeypatch.setattr(removed_module, "find_scans", never)
    for change in (
        lambda: add_scans(target, [files.c], jobs=1, memory_bytes=LEAST),
        lambda: remove_scans(target, [str(files.b)], jobs=1, memory_bytes=LEAST),
    ):
        refused(target, SolidcloudError, ADVICE, change)


def test_a_voxel_that_nobody_reads_may_be_as_large_as_it_is(
    built: Build, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With a given radius, no preview and no level, only what is touched is read."""
    target = built(tmp_path / "x", "a", radius=0.01)
    far = synthetic_scans.write_ply(tmp_path / "far.ply", np.array([[3.1, 3.1, 3.1]]))
    most_points(monkeypatch, largest(target) - 1)
    with pytest.raises(SolidcloudError, match=ADVICE):
        add_scans(target, [far], jobs=1, memory_bytes=LEAST)
    (target / PREVIEW_NAME).unlink()
    shutil.rmtree(target / LEVEL_FOLDER)
    assert add_scans(target, [far], jobs=1, memory_bytes=LEAST).built == 1
    more = denser(target, tmp_path / "more.ply")
    with pytest.raises(SolidcloudError, match=ADVICE):
        add_scans(target, [more], jobs=1, memory_bytes=LEAST)


def test_no_more_jobs_read_than_hold_the_largest_voxels(
    built: Build, files: Files, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    at_once = defaultdict(set)

    class Noted(ProcessExecutor):
        """Two jobs in this process, and which of them were allowed for what."""

        def __init__(self, *_: Any) -> None:
            super().__init__(1)
            self.jobs = self.at_once = 2

        def map(self, function: Any, *given: Any) -> Any:
            at_once[function.__name__].add(self.at_once)
            return super().map(function, *given)

    monkeypatch.setattr(transaction, "make_executor", lambda *_: Noted())
    target = built(tmp_path / "x", "ab", keep=EVERYTHING)
    given = 512 << 20
    most_points(monkeypatch, largest(target) + 1, 2, given)
    remove_scans(target, [str(files.b)], jobs=2, memory_bytes=given)
    assert at_once.pop("find_scans") == at_once.pop("gather") == {1}
    assert at_once.pop("build_shard") == {2}
    at_once.clear()
    add_scans(target, [files.b], jobs=2, memory_bytes=given)
    assert at_once["_own_sums"] == at_once["_read_back"] == at_once["_choose"] == {1}
    assert at_once["build_shard"] == at_once["spool_range"] == {2}


def test_out_of_memory_says_what_the_archive_is_and_what_to_do(
    built: Build, files: Files, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: Any) -> Any:
        raise MemoryError("Unable to allocate 3 GiB")

    target = built(tmp_path / "there" / "x", "a")
    monkeypatch.setattr(rebuild_module, "_build", fail)
    refused(
        target,
        SolidcloudError,
        rf"^{target}: out of memory \(Unable to allocate 3 GiB\): give fewer --jobs or a smaller --memory, or stop "
        "other programs; the archive is what it was$",
        lambda: add_scans(target, [files.b], jobs=1),
    )


def test_room_is_asked_for_what_dense_voxels_take_meanwhile(
    built: Build, files: Files, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[int] = []
    monkeypatch.setattr(Change, "check_space", lambda change, needed: asked.append(needed))
    for dense, name in ((1 << 20, "x"), (10, "y")):
        target = built(tmp_path / name, "ab", keep=EVERYTHING)
        monkeypatch.setattr(rebuild_module, "DENSE_POINTS", dense)
        add_scans(target, [files.a], again=True, jobs=1)
    with Archive(target) as archive:
        most = int(archive.voxels["rows"][:, 2].max())
    (_, without, _, with_it) = asked
    assert with_it - without == most * SCRATCH_BYTES_A_POINT


def test_the_box_of_a_voxel_is_found_a_few_rows_at_a_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rng = np.random.default_rng(2)
    points = rng.integers(3, 900, (300_000, 3)).astype(np.int32)
    spool = spooled(tmp_path / "spool", rows_of(points, "scan_index"), 1000, [100_000, 250_000])
    corner = voxel_coordinates(np.array([KEY], np.uint64))[0] * 1000
    expected = (np.stack([points.min(axis=0), points.max(axis=0)]) + corner).tolist()
    assert added_module.box_of(KEY, spool).tolist() == expected
    monkeypatch.setattr(added_module, "BOX_POINTS", 1 << 12)
    tracemalloc.start()
    try:
        assert added_module.box_of(KEY, spool).tolist() == expected
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < 1 << 20, "rows are 4.2 MB"
