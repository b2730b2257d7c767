"""The hidden folder of a build: what stays in it after which failure, and what it becomes."""

from pathlib import Path
from typing import Any

import pytest
from solidcloud.builder.workplace import (
    building_folder,
    forget_finished,
    remove_building,
    workplace,
)
from solidcloud.schemas.errors import BadRequestError, CorruptError, ScanError, SolidcloudError

WHAT: dict[str, Any] = {"software": {"resume": 1}, "options": {"voxel": 8.0}, "inputs": []}


def failed(target: Path, error: BaseException, *, surveyed: bool, fresh: bool = False) -> bool:
    """Whether something was there already in a build that fails so; what it wrote stays if its folder does."""
    with pytest.raises(type(error)), workplace(target, WHAT, fresh=fresh) as place:
        found = (place.folder / "survey").exists()
        place.journal.note("survey/1", {})
        (place.archive / "half.tmp").write_bytes(b"half")
        place.surveyed = surveyed
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


@pytest.mark.parametrize("error", FAULTS)
def test_what_is_found_later_or_by_a_later_command_removes_nothing(
    error: BaseException, tmp_path: Path
) -> None:
    failed(tmp_path / "hall", error, surveyed=True)
    assert failed(tmp_path / "hall", error, surveyed=False)
    assert failed(tmp_path / "hall", KeyboardInterrupt(), surveyed=True)


def test_a_build_of_something_else_is_left_as_it_is(tmp_path: Path) -> None:
    failed(tmp_path / "hall", KeyboardInterrupt(), surveyed=True)
    other = {**WHAT, "options": {"voxel": 4.0}}
    with (
        pytest.raises(BadRequestError, match=r"--voxel was 8\.0, is 4\.0"),
        workplace(tmp_path / "hall", other, fresh=False),
    ):
        pytest.fail("went on")
    assert failed(tmp_path / "hall", KeyboardInterrupt(), surveyed=True)


def test_a_folder_that_does_not_say_what_it_is_is_not_believed(tmp_path: Path) -> None:
    failed(tmp_path / "hall", KeyboardInterrupt(), surveyed=True)
    (building_folder(tmp_path / "hall") / "build.json").write_bytes(b"{")
    assert not failed(tmp_path / "hall", KeyboardInterrupt(), surveyed=True)


def test_the_folder_goes_when_all_is_done(tmp_path: Path) -> None:
    with workplace(tmp_path / "hall", WHAT, fresh=False) as place:
        assert place.folder == building_folder(tmp_path / "hall")
        assert {p.name for p in place.folder.iterdir()} == {"build.json", "spool", "archive"}
    assert not list(tmp_path.iterdir())


def test_what_a_finished_build_left_is_forgotten_and_what_another_left_is_not(tmp_path: Path) -> None:
    failed(tmp_path / "hall", KeyboardInterrupt(), surveyed=True)
    forget_finished(tmp_path / "hall", {**WHAT, "options": {}})
    assert building_folder(tmp_path / "hall").exists()
    forget_finished(tmp_path / "hall", WHAT)
    assert not list(tmp_path.iterdir())
    building_folder(tmp_path / "hall").mkdir()  # killed between its last two deeds
    forget_finished(tmp_path / "hall", WHAT)
    assert not list(tmp_path.iterdir())


def test_the_note_of_what_it_is_is_removed_last(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    failed(tmp_path / "hall", KeyboardInterrupt(), surveyed=True)
    folder = building_folder(tmp_path / "hall")
    seen: list[bool] = []
    monkeypatch.setattr(
        "solidcloud.builder.workplace.shutil.rmtree",
        lambda path, **_: seen.append((folder / "build.json").exists() and path != folder),
    )
    remove_building(folder)
    assert seen == [True] * 3 + [False]
