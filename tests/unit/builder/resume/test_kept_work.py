"""The hidden folder of a build: what each failure leaves in it, its publication, and its journal."""

from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
from solidcloud.builder.resume.kept_work import (
    BuildDirectory,
    build_directory,
    building_folder,
    remove_finished_work,
)
from solidcloud.schemas.errors import BadRequestError, CorruptError, ScanError, SolidcloudError

WHAT: dict[str, Any] = {"software": {"resume": 1}, "options": {"voxel": 8.0}, "inputs": []}


def failed(target: Path, error: BaseException, *, surveyed: bool, fresh: bool = False) -> bool:
    """Whether something was there already in a build that fails so; what it wrote stays if its folder does."""
    with pytest.raises(type(error)), build_directory(target, WHAT, fresh=fresh) as build_dir:
        found = (build_dir.folder / "survey").exists()
        build_dir.journal.write_entry("survey/1", {})
        (build_dir.archive / "half.tmp").write_bytes(b"half")
        build_dir.surveyed = surveyed
        raise error
    assert not list(target.parent.rglob("*.tmp"))
    return found


@pytest.mark.parametrize("surveyed", [False, True])
@pytest.mark.parametrize(
    "error", [KeyboardInterrupt(), OSError(28, "full"), SolidcloudError("a worker died")]
)
def test_what_is_done_outlives_an_interruption(error: BaseException, surveyed: bool, tmp_path: Path) -> None:
    assert not failed(tmp_path / "hall", error, surveyed=surveyed)
    assert failed(tmp_path / "hall", error, surveyed=surveyed)
    assert not failed(tmp_path / "hall", error, surveyed=surveyed, fresh=True)


FAULTS = [BadRequestError("too far"), ScanError("bad"), CorruptError("not what was written")]


@pytest.mark.parametrize("error", FAULTS[:2])
def test_what_the_survey_of_a_new_build_refuses_leaves_nothing(error: BaseException, tmp_path: Path) -> None:
    assert not failed(tmp_path / "hall", error, surveyed=False)
    assert not list(tmp_path.iterdir())


def test_what_a_finished_build_left_is_forgotten_and_what_another_left_is_not(tmp_path: Path) -> None:
    failed(tmp_path / "hall", KeyboardInterrupt(), surveyed=True)
    remove_finished_work(tmp_path / "hall", {**WHAT, "options": {}})
    assert building_folder(tmp_path / "hall").exists()
    remove_finished_work(tmp_path / "hall", WHAT)
    assert not list(tmp_path.iterdir())
    building_folder(tmp_path / "hall").mkdir()  # killed between its last two deeds
    remove_finished_work(tmp_path / "hall", WHAT)
    assert not list(tmp_path.iterdir())


def began(target: Path, *, fresh: bool = False) -> BuildDirectory:
    """What a build begins with that is interrupted at once."""
    with suppress(KeyboardInterrupt), build_directory(target, WHAT, fresh=fresh) as build_dir:
        raise KeyboardInterrupt
    return build_dir


@pytest.mark.parametrize("parted", [False, True])
def test_what_comes_of_points_that_are_not_believed_finds_no_folder(parted: bool, tmp_path: Path) -> None:
    build_dir = began(tmp_path / "hall")
    late = build_dir.journal
    late.write_entry("survey/1", {"count": 7})
    late.write_entry("spool/1", {"runs": {}})
    late.write_entry("done/1", {"name": "0-1.h5"})
    build_dir.discard(build_dir.folder / "spool")
    for name in ("survey/2", "spool/2", "done/2"):
        with pytest.raises(FileNotFoundError):
            late.write_entry(name, {})
    if parted:  # killed before it could remove what was there
        late.folder.mkdir()
    again = began(tmp_path / "hall")
    assert again.folder == build_dir.folder != late.folder
    assert [p for p in again.hidden.iterdir() if p.is_dir()] == [again.folder]
    assert again.journal.read_entry("survey/1") == {"count": 7}
    assert again.journal.read_entry("spool/1") is again.journal.read_entry("done/1") is None
