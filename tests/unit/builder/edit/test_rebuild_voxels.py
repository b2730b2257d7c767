"""What is built anew holds the points that were stored and those that were read, or the archive stays what it was."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import synthetic_scans
from archive_edits import EVERYTHING, A, B, Build, Files, refused
from archive_edits import built as built  # the fixtures
from archive_edits import files as files
from solidcloud.builder.edit import rebuild_voxels as rebuild_module
from solidcloud.builder.edit.archive_change import Change
from solidcloud.builder.edit.edit_archive import add_scans, remove_scans
from solidcloud.schemas.archive.archive import Archive
from solidcloud.schemas.archive.index import SHARD_FOLDER
from solidcloud.schemas.errors import CorruptError

ADVICE = "the data read back differ from the data written: check disk and memory.*the archive is what it was"
OTHERS = f"the points built anew are not those that were stored and read: {ADVICE}"
# The bits of a coordinate: the least moves a point in its voxel, a high one out of it.
BITS = [(0, OTHERS), (20, rf"(shards/1-000000|index)\.h5: .*voxel .*: {ADVICE}")]


def flip_before_building(monkeypatch: pytest.MonkeyPatch, runs: str, bit: int) -> list[Path]:
    """Flip a bit of the last row's x in the first run of that pattern, once all is spooled; the runs that were hit."""
    build, hit = rebuild_module._build, []

    def flipped(change: Change, *given: Any) -> Any:
        path = min((change.folder / "spool").glob(runs))
        rows = np.fromfile(path, change.dtype)
        rows["local"][-1, 0] ^= 1 << bit
        rows.tofile(path)
        hit.append(path)
        return build(change, *given)

    monkeypatch.setattr(rebuild_module, "_build", flipped)
    return hit


@pytest.mark.parametrize(
    ("keep", "runs", "bit", "said"),
    [(EVERYTHING, "new-*.run", *BITS[0]), (frozenset(), "old-*.run", *BITS[1])],
    ids=["near", "far"],
)
def test_a_flipped_bit_in_a_run_is_found_when_scans_are_added(
    built: Build,
    files: Files,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    runs: str,
    keep: frozenset[str],
    bit: int,
    said: str,
) -> None:
    target = built(tmp_path / "there" / "x", "a", keep=keep)
    with monkeypatch.context() as patch:
        hit = flip_before_building(patch, runs, bit)
        refused(target, CorruptError, said, lambda: add_scans(target, [files.b], jobs=1))
    assert len(hit) == 1
    assert add_scans(target, [files.b], jobs=1).points == len(A) + len(B)


def test_a_flipped_bit_in_a_run_is_found_when_scans_are_removed(
    built: Build, files: Files, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    target = built(tmp_path / "there" / "x", "ab", keep=EVERYTHING)
    with monkeypatch.context() as patch:
        hit = flip_before_building(patch, "old-*.run", 0)
        refused(target, CorruptError, OTHERS, lambda: remove_scans(target, [str(files.b)], jobs=1))
    assert len(hit) == 1
    assert remove_scans(target, [str(files.b)], jobs=1).points == len(A)


def test_a_damaged_record_that_stays_is_named_where_it_lies(
    built: Build, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    target = built(tmp_path / "there" / "x", "a")
    far = synthetic_scans.write_ply(tmp_path / "far.ply", np.array([[0.0, 0, 0], [3.1, 3.1, 3.1]]))
    shard = target / SHARD_FOLDER / "0-000000.h5"
    with Archive(target) as archive:
        offset, size = (int(archive.voxels[-1][name][2]) for name in ("frame_offset", "frame_bytes"))
    held = bytearray(shard.read_bytes())
    held[offset + size // 2] ^= 1
    shard.write_bytes(held)
    refused(
        target,
        CorruptError,
        rf"^{shard}: voxel .*: restore the shard or rebuild the archive$",
        lambda: add_scans(target, [far], jobs=1),
    )


def test_what_is_left_out_of_added_scans_is_said(built: Build, tmp_path: Path) -> None:
    target = built(tmp_path / "x", "a")
    some = B.copy()
    some[[3, 5]] = np.nan
    path = synthetic_scans.write_ply(tmp_path / "holes.ply", some)
    added = add_scans(target, [path], jobs=1)
    assert added.skipped == {"not finite": 2} and added.points == len(A) + len(B) - 2
    with Archive(target) as archive:
        assert archive.header.sources[-1].skipped == added.skipped
    assert add_scans(target, [synthetic_scans.write_ply(tmp_path / "b.ply", B)], jobs=1).skipped == {}
