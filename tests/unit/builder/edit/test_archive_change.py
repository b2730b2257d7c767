"""A change holds what `--memory` allows, or is refused before anything is changed, in the words of a build."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import synthetic_scans
from archive_edits import OPTIONS, A, Build, Files, refused
from archive_edits import built as built  # the fixtures
from archive_edits import files as files
from solidcloud.builder import build_limits as memory
from solidcloud.builder.config import BuildConfig
from solidcloud.builder.edit import rebuild_voxels as rebuild_module
from solidcloud.builder.edit.edit_archive import add_scans
from solidcloud.builder.pipeline import build_archive
from solidcloud.schemas.archive.archive import Archive
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
