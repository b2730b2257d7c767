"""A change holds what `--memory` allows, or is refused before anything is changed, in the words of a build."""

from pathlib import Path
from typing import Any

import pytest
from archive_edits import Build, Files, refused
from archive_edits import built as built  # the fixtures
from archive_edits import files as files
from solidcloud.builder.edit import rebuild_voxels as rebuild_module
from solidcloud.builder.edit.edit_archive import add_scans
from solidcloud.schemas.errors import SolidcloudError


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
